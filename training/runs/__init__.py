"""What a training stands on: its settings, batches, logs and checkpoints, and the run that is left of it."""
