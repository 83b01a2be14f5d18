"""Data-quality rules, and the report that shows what they found."""
