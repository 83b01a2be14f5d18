"""Evidence for or against a model: intervals of differences between models."""
