"""Settings, progress and checkpoints of a training, the run that it writes, and runs opened to predict."""
