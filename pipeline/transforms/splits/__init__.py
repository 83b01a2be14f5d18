"""Splits: the assignment of subsets to train, val and eval."""
