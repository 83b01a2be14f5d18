"""Models, training and evaluation on the tensors of a lake. Of our own packages only `schemas` is imported.

- `training.data.tensor_folder`: open a tensor folder, gather batches of samples or of whole scenes by vectorised
  indexing.
- `training.data.torch_batches`: the same as torch tensors: streamed, by a sampler, or gathered on a device; and
  `training.data.torch_nearest_vehicles`: samples with those around them, gathered on a device.
- `training.data.augmentation`: the road mirrored, positions shifted.
- `training.models`: the registry of models, one file each.
- `training.train`: train a model into a run's folder.
- `training.evaluation.evaluate`: the errors of a model or run at each horizon, in many groups.
- `training.lane_changes`: a random forest that foretells lane changes, and the cells of a grid around a vehicle.

Behind these: `mapped` (tensor folders from within), `running` (what a training stands on), `scoring` (errors,
densities, and the guard that comes before them), `pictures` (samples, attention and errors drawn).

Nothing imports torch before `training.data.torch_batches` or a model that needs it is asked for.
"""
