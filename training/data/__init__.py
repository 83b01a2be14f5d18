"""Tensor folders from within: opened, checked, drawn from, and gathered as their rows lie."""
