"""The wire: links, MAVLink framing and services, both faces."""
