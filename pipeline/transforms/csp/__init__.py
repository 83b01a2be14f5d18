"""Tracks and samples as the script of convolutional social pooling makes them."""
