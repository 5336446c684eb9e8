"""The study recomputed: every table, every figure its data allow, every conclusion judged (`froude study`)."""
