"""Data-quality rules, and the report of their findings."""
