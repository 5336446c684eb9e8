"""Sweeps: thousands of gain sets judged by the batch over uncertain models, kept as a dataset, resumable."""
