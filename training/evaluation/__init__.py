"""Scores of predictions: errors and NLL, the check for future inputs that comes before them, and latency."""
