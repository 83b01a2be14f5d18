"""Tracks as convolutional social pooling's own script writes them."""
