"""Drawings of samples with predictions, of attention weights, and of errors over the horizon."""
