"""Scores of predictions: errors and NLL, the check that comes before them, latency, and published figures."""
