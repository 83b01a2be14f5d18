"""Settings, data loader, logs and checkpoints of a training, and the run that it writes."""
