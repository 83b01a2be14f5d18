"""Data-quality rules: declarations, derived columns, evaluation, findings and scores."""
