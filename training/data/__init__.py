"""Tensor folders opened and checked, and batches gathered from them."""
