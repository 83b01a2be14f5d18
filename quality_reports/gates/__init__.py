"""Quality gates: metrics of a lake, and the conditions on them at which a pipeline should stop."""
