"""Training tensors: flat arrays over a protocol's clock, and their index."""
