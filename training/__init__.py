"""Models, training and evaluation on the tensors of a lake. Of our own packages only `schemas` is imported.

- `training.tensors`: open a tensor folder, gather batches by vectorised indexing.
- `training.models`: the registry of models, one file each.
- `training.train`: train a model into a run's folder.
- `training.evaluate`: the errors of a model or run at 1 to 5 s.

Nothing here imports torch before a model is asked for that needs it.
"""
