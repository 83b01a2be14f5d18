"""Training tensors: flat arrays on a protocol's clock, and their index."""
