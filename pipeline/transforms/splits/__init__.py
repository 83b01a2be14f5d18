"""Which subsets train, validate and evaluate."""
