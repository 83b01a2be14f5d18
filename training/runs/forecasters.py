"""Models and runs by name, ready to predict samples of a tensor folder."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tracklake.schemas.arrays import Integers
from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.schemas.run_config import StaleRunError
from tracklake.schemas.text import find_similar
from tracklake.training.data.gathers import NEAREST, read_samples, select_ego_truth
from tracklake.training.data.observed import Reads, Truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import MODELS, Predictor, find_model
from tracklake.training.models.fitting import Fit, fit_model
from tracklake.training.models.prediction import Prediction
from tracklake.training.runs.run_folder import load_run, refuse_leak, refuse_unfinished

BATCH_SIZE = 256
"""Number of samples predicted at once; predictions do not depend on it. With 2,048, the largest network's values leave
the cache, and it takes nearly twice as long."""


class UnknownRunError(UsageError):
    """There is no run, and no model that needs no training, of this name."""


@dataclass(frozen=True)
class Forecaster:
    """A model that is ready to predict: name of the run or model, the model itself, and the kind of its input.

    `config` is the content of the run's `config.json`, empty where the model has no run; `fit` says what was fitted on
    opening it.
    """

    name: str
    predictor: Predictor
    reads: Reads = "grid"
    config: Mapping[str, Any] = field(default_factory=dict, repr=False)
    fit: Fit | None = None

    def predict(
        self, folder: TensorFolder, samples: Integers, *, nearest: int = NEAREST
    ) -> Iterator[tuple[slice, Prediction, Truth[Any]]]:
        """Predict samples (S,) in batches: yield which of them, their prediction, and their own truth.

        Raises:
            TracklakeError: places are not of the truth's shape.
        """
        for start in range(0, len(samples), BATCH_SIZE):
            chosen = slice(start, start + BATCH_SIZE)
            observed, everything = read_samples(folder, samples[chosen], self.reads, nearest=nearest)
            prediction, truth = self.predictor.predict(observed), select_ego_truth(everything)
            wanted, found = truth.future.shape, prediction.position_m.shape
            if found != wanted:
                raise TracklakeError(f"`{self.name}`: expected places of shape {wanted}, got {found}")
            yield chosen, prediction, truth


def open_forecaster(name: str, folder: TensorFolder, models: Path, parts: frozenset[str]) -> Forecaster:
    """Open a trained run in the folder `models`, or a model that needs none, to predict parts of a split.

    A model that is fitted and has no run of its name is fitted on the part `train`.

    Raises:
        StaleRunError: the run was trained for another protocol, or on subsets of these parts (other than `train`); or
            it is unfinished or damaged.
        UnknownRunError: neither a run nor a model of that name, or a model that learns and has no run.
        MissingExtraError: torch is needed and not installed.
    """
    own = MODELS.get(name)
    if own and not own.learns and not own.fitted:
        return Forecaster(name, own.build(folder.protocol), own.reads)
    if Path(name).name == name and (models / name / "config.json").is_file():
        config, predictor = load_run(models / name, folder.protocol)
        model = find_model(config["model"])
        for part in sorted(parts - {"train"}) if model.learns or model.fitted else ():
            refuse_leak(config, folder, part)
        return Forecaster(name, predictor, model.reads, config)
    if own and own.fitted:
        fit = fit_model(own, folder, folder.samples_of("train"), {})
        return Forecaster(name, own.build(folder.protocol, **fit.parameters), own.reads, fit=fit)
    refuse_unfinished(models / name)
    if Path(name).name == name and (models / name / "metrics.json").is_file():
        raise StaleRunError(f"{models / name}: a run without its config.json; train it again")
    if own:
        raise UnknownRunError(f"{models / name}: no trained run; run `tracklake train {name}` first")
    runs = sorted(path.parent.name for path in models.glob("[!.]*/config.json"))
    known = [name for name, model in MODELS.items() if not model.learns]
    similar = find_similar(name, (*runs, *MODELS))
    raise UnknownRunError(
        f"no run or model `{name}`{f' (did you mean {similar}?)' if similar else ''}: expected one of the runs "
        f"{', '.join(runs) or '(none yet)'}, or of the models that "
        f"need no training, {', '.join(known)}; `tracklake train MODEL --name {name}` trains one"
    )
