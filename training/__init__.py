"""Models, their training and their evaluation, on the tensors of a lake. It imports `schemas` and nothing else of ours.

- `training.data`: tensor folders, and batches of samples or whole scenes gathered from them.
- `training.models`: the registry of models, and their modules.
- `training.runs`: settings, data loader, logs and checkpoints of a training, and the finished run.
- `training.evaluation`: the errors of a model or run at each horizon, and the guard against models that see the future.
- `training.lane_changes`: a random forest that predicts lane changes, and a grid of cells around a vehicle.
- `training.plots`: samples, predictions, attention and errors drawn.
- `training.train`: the training loop.

torch is imported only where a model needs it.
"""
