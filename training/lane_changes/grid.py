"""Scores of predicted cells: columns from a model's own places or from the forest, rows from the model's places.

True places and labels come from the future: predictions are compared with them and grouped by them. Models and the
forest read only what `training.data.observed` holds.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tracklake.schemas.arrays import Bytes, Flags, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.observed import FutureInputError, ObservedScene
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import BATCH_SIZE
from tracklake.training.evaluation.guard import refuse_future
from tracklake.training.lane_changes.cells import OUTSIDE, Codes, find_columns, find_rows, measure_rows, number_cells
from tracklake.training.lane_changes.examples import (
    Targets,
    cut_numbers,
    label_samples,
    list_horizons,
    read_targets,
)
from tracklake.training.lane_changes.features import FEATURE_NUMBER
from tracklake.training.lane_changes.forest import LaneForest, decide_classes
from tracklake.training.models import MODELS, Predictor, Reads
from tracklake.training.models.constant_velocity import ConstantVelocity
from tracklake.training.models.inputs import read_samples, truth_of_ego
from tracklake.training.models.prediction import NotFiniteError, Prediction
from tracklake.training.runs.run_folder import refuse_leak

COLUMNS = np.array([{"keep": 0, "left": -1, "right": 1}[name] for name in LATERAL_MANEUVERS], dtype=np.int8)
"""Column of each class of the forest."""
MOST = 200_000
"""Largest number of samples that are scored; of a larger part, so many are drawn."""


@dataclass(frozen=True)
class CellScore:
    """Scores of one model at one horizon, over all samples or one stratum. Shares are None where n is 0.

    Args:
        model: name of the model.
        column: source of the column: `place`, the model's own, or `forest`.
        seconds: horizon, s.
        stratum: name from `examples.STRATA`, or `all`.
        n: number of samples behind each share.
        cell: share of samples in the predicted cell; a true place outside the nine is never right.
        row: the same of rows alone.
        lane: the same of columns alone.
        cell_clipped: as `cell`, if the outer columns and rows had no end.
        majority: share of the most frequent true cell: what a constant prediction of it would reach.
        own_lane: share of true places in the own column.
        outside: share of true places outside the nine cells.
    """

    model: str
    column: str
    seconds: float
    stratum: str
    n: int
    cell: float | None
    row: float | None
    lane: float | None
    cell_clipped: float | None
    majority: float | None
    own_lane: float | None
    outside: float | None


@dataclass(frozen=True)
class ManeuverScore:
    """Scores of the forest's maneuvers, over all samples or one stratum. None: no such sample.

    Args:
        stratum: as in `CellScore`.
        n: number of samples.
        accuracy: share of samples whose most probable maneuver is the label.
        recall: the same of the samples of each label.
        balanced: mean of the recalls that are not None.
        majority: share of the most frequent label.
    """

    stratum: str
    n: int
    accuracy: float | None
    recall: dict[str, float | None]
    balanced: float | None
    majority: float | None


@dataclass(frozen=True)
class GridScores:
    """Scores of cells and maneuvers on one part.

    Args:
        cells: scores by model, column, horizon and stratum.
        maneuvers: scores by stratum.
        left_out: number of the part's samples that are not scored.
        left_out_by_reason: the same by `examples.LEFT_OUT`.
    """

    cells: list[CellScore]
    maneuvers: list[ManeuverScore]
    left_out: int
    left_out_by_reason: dict[str, int]

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values."""
        return asdict(self)


class _ForestPredictor:
    """Forest with the interface of a model, for the guard: all probabilities in one array, and no places."""

    def __init__(self, forest: LaneForest) -> None:
        self._forest = forest

    def predict(self, observed: ObservedScene[Any]) -> Prediction:
        probability = self._forest.predict(observed)
        none = np.zeros((len(probability), 0, 2), dtype=np.float32)
        return Prediction(position_m=none, lateral=probability.reshape(len(probability), -1))


def evaluate_grid(
    folder: TensorFolder,
    predictors: Mapping[str, Predictor],
    forest: LaneForest,
    *,
    part: str = "eval",
    reads: Mapping[str, Reads] | None = None,
    most: int = MOST,
    seed: int = 0,
    on_skip: Callable[[str, str], None] | None = None,
) -> GridScores:
    """Score models by the cells of their predicted places, at every horizon of the forest.

    Each model is scored twice: with the columns of its own places, and with the forest's. Samples are those of
    `examples.label_samples`, with the forest's T_d.

    Args:
        folder: tensors of the protocol that forest and models were made for.
        predictors: models by name.
        forest: fitted forest.
        part: train, val or eval.
        reads: input of each model; by default as in the registry, or else `grid`.
        most: largest number of samples.
        seed: seed of the draw where there are more.
        on_skip: called with the name of a model that cannot be scored, and the reason. None: the first one is raised.

    Raises:
        FutureInputError: the forest or a model sees the future.
        TracklakeError: the forest was fitted on subsets of this part, at another rate, or for horizons that the folder
            does not score; or see `predict_places`.
    """
    ticks = _find_ticks(folder, forest)
    refuse_leak(forest.facts, folder, part)
    found = label_samples(folder, part, forest.settings)
    samples = found.draw(most, seed)
    if len(samples):
        refuse_future(_ForestPredictor(forest), folder, part, name="lane-forest", reads="scene")
    targets = read_targets(folder, samples.sample, ticks)
    straight_m = predict_places(folder, samples.sample, ConstantVelocity(folder.protocol), ticks, name="straight")
    true = find_cells(targets.place_m, straight_m, targets)
    decided = decide_classes(forest.predict_proba(targets.feature))  # (S, 1 + T)
    forest_column = COLUMNS[decided[:, 1:]]
    strata = samples.find_strata()
    inputs = {name: MODELS[name].reads if name in MODELS else "grid" for name in predictors} | dict(reads or {})
    cells: list[CellScore] = []
    for name, predictor in predictors.items() if len(samples) else ():
        try:
            refuse_future(predictor, folder, part, name=name, reads=inputs[name])
            place_m = predict_places(folder, samples.sample, predictor, ticks, name=name, reads=inputs[name])
        except (TracklakeError, FutureInputError, ValueError) as refused:
            if on_skip is None:
                raise
            on_skip(name, str(refused))
            continue
        own = find_cells(place_m, straight_m, targets)
        joined = np.stack([forest_column, own[..., 1]], axis=-1)
        for source, predicted in (("place", own), ("forest", joined)):
            cells += _score_cells(name, source, predicted, true, forest.horizons_s, strata)
    maneuvers = [score_maneuvers(name, decided[of, 0], samples.maneuver[of]) for name, of in strata.items()]
    return GridScores(cells, maneuvers, found.left_out, found.reasons)


def predict_places(
    folder: TensorFolder,
    sample: Integers,
    predictor: Predictor,
    ticks: tuple[int, ...],
    *,
    name: str,
    reads: Reads = "grid",
) -> Singles:
    """Predict the places of samples (S,) at some ticks ahead (T,): (S, T, 2).

    Raises:
        NotFiniteError: places are not finite numbers.
        TracklakeError: places are not of the horizon's shape.
    """
    at = np.array(ticks, dtype=np.intp) - 1
    places = []
    for numbers in cut_numbers(sample, BATCH_SIZE):
        observed, truth = read_samples(folder, numbers, reads)
        place_m = predictor.predict(observed).position_m
        expected = truth_of_ego(truth).future.shape
        if place_m.shape != expected:
            raise TracklakeError(f"`{name}`: expected places of shape {expected}, got {place_m.shape}")
        if not np.isfinite(place_m).all():
            raise NotFiniteError(name, "positions")
        places.append(place_m[:, at])
    return np.concatenate(places)


def find_cells(place_m: Singles, straight_m: Singles, targets: Targets) -> Codes:
    """Find the columns and rows of places: (S, T, 2).

    Args:
        place_m: (S, T, 2) places relative to the sample's last position.
        straight_m: (S, T, 2) constant-velocity places.
        targets: S samples as observed; their true places are not used.
    """
    speed_mps, ego = (targets.feature[:, FEATURE_NUMBER[name]] for name in ("relative_speed_mps", "ego"))
    column = find_columns(place_m[..., 1], targets.lanes)
    row = find_rows(place_m[..., 0], straight_m[..., 0], measure_rows(speed_mps, ego))
    return np.stack([column, row], axis=-1)


def score_maneuvers(stratum: str, decided: Bytes, label: Bytes) -> ManeuverScore:
    """Compare predicted maneuvers (B,) with labels (B,)."""
    right, of_class = decided == label, {name: label == code for code, name in enumerate(LATERAL_MANEUVERS)}
    recall = {name: _mean(right[of]) for name, of in of_class.items()}
    found = [share for share in recall.values() if share is not None]
    return ManeuverScore(
        stratum=stratum,
        n=len(label),
        accuracy=_mean(right),
        recall=recall,
        balanced=sum(found) / len(found) if found else None,
        majority=max(float(of.mean()) for of in of_class.values()) if len(label) else None,
    )


def _score_cells(
    model: str, source: str, own: Codes, true: Codes, horizons_s: tuple[float, ...], strata: Mapping[str, Flags]
) -> Iterator[CellScore]:
    """Score predicted columns and rows (S, T, 2): one score for each horizon and stratum."""
    true_cell = number_cells(true[..., 0], true[..., 1])
    right = (own == true) & (np.abs(true) < OUTSIDE)
    clipped = (own.clip(-1, 1) == true.clip(-1, 1)).all(axis=-1)
    for horizon, seconds in enumerate(horizons_s):
        for stratum, of in strata.items():
            cells = true_cell[of, horizon]
            inside = np.bincount(cells[cells >= 0], minlength=9)
            yield CellScore(
                model=model,
                column=source,
                seconds=seconds,
                stratum=stratum,
                n=len(cells),
                cell=_mean(right[of, horizon].all(axis=-1)),
                row=_mean(right[of, horizon, 1]),
                lane=_mean(right[of, horizon, 0]),
                cell_clipped=_mean(clipped[of, horizon]),
                majority=int(inside.max()) / len(cells) if len(cells) else None,
                own_lane=_mean(true[of, horizon, 0] == 0),
                outside=_mean(cells < 0),
            )


def _mean(flags: Flags) -> float | None:
    """Compute the share of flags that are set; None where there are none."""
    return float(flags.mean()) if len(flags) else None


def _find_ticks(folder: TensorFolder, forest: LaneForest) -> tuple[int, ...]:
    """Convert the forest's horizons to ticks ahead: (T,).

    Raises:
        TracklakeError: the forest was fitted at another rate, or for horizons that the folder does not score.
    """
    protocol, scored = folder.protocol, list_horizons(folder.protocol)
    if forest.rate_hz != protocol.rate_hz or not set(forest.horizons_s) <= set(scored):
        raise TracklakeError(
            f"the forest was fitted at {forest.rate_hz} Hz for horizons of {forest.horizons_s} s; {folder.path} is of "
            f"{protocol.name}, {protocol.rate_hz} Hz, scored at {scored} s. Fit it again on these tensors"
        )
    return tuple(round(seconds * protocol.rate_hz) for seconds in forest.horizons_s)
