"""Runs and models by name, scored on tensors as `tracklake evaluate` scores them."""

from pathlib import Path

from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import measure_errors
from tracklake.training.runs.forecasters import open_forecaster


def evaluate(name, tensors, models, part="eval", **options):
    """Scores of a run in the folder `models`, or of a model that is no network, on tensors opened or not."""
    folder = tensors if isinstance(tensors, TensorFolder) else TensorFolder.open(tensors)
    return measure_errors(open_forecaster(name, folder, Path(models), frozenset({part})), folder, part, **options)
