"""Scores of predicted cells and maneuvers, and the learning curve of the forest.

Columns of cells are those of a model's own places, or the forest's; rows are those of the model's places. True
places and labels come from the future: predictions are compared with them and grouped by them. Models and the forest
read only what `training.data.observed` holds.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from tracklake.schemas.arrays import Bytes, Flags, Floats, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.lane_forest import ALL, FEATURE_NUMBER, CellScore, GridScores, LearningPoint, ManeuverScore
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import require_samples
from tracklake.training.evaluation.guard import refuse_future
from tracklake.training.lane_changes.cells import OUTSIDE, Codes, find_columns, find_rows, measure_rows, number_cells
from tracklake.training.lane_changes.examples import (
    LaneForestSettings,
    Targets,
    draw_balanced,
    gather_examples,
    label_samples,
    read_targets,
)
from tracklake.training.lane_changes.forest import LaneForest, decide_classes, fit_examples
from tracklake.training.models.motion import ConstantVelocity
from tracklake.training.models.prediction import NotFiniteError
from tracklake.training.runs.forecasters import Forecaster
from tracklake.training.runs.run_folder import refuse_leak

COLUMNS = np.array([{"keep": 0, "left": -1, "right": 1}[name] for name in LATERAL_MANEUVERS], dtype=np.int8)
"""Column of each class of the forest."""
MOST = 200_000
"""Largest number of samples that are scored; of a larger part, so many are drawn."""
SIZES = (250, 500, 1000, 2000, 4000)
"""Numbers of examples drawn, before augmentation."""
MOST_SCORED = 20_000
"""Largest number of samples that each forest is scored on."""


def evaluate_grid(
    folder: TensorFolder,
    models: Iterable[Forecaster],
    forest: LaneForest,
    *,
    part: str = "eval",
    most: int = MOST,
    seed: int = 0,
    on_skip: Callable[[str, str], None] | None = None,
) -> GridScores:
    """Score models by the cells of their predicted places, at every horizon of the forest.

    Each model is scored twice: with the columns of its own places, and with the forest's. Samples are those of
    `examples.label_samples`, with the forest's T_d; of more than `most`, so many are drawn. `on_skip` is called with
    the name of a model that cannot be scored, and the reason; where it is None, the first refusal is raised.

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
        refuse_future(Forecaster("lane-forest", forest, "scene"), folder, part)
    targets = read_targets(folder, samples.sample, ticks)
    straight = Forecaster("straight", ConstantVelocity(folder.protocol))
    straight_m = predict_places(straight, folder, samples.sample, ticks)
    true = find_cells(targets.place_m, straight_m, targets)
    decided = decide_classes(forest.predict_proba(targets.feature))  # (S, 1 + T)
    forest_column = COLUMNS[decided[:, 1:]]
    strata = samples.find_strata()
    cells: list[CellScore] = []
    for model in models if len(samples) else ():
        try:
            refuse_future(model, folder, part)
            place_m = predict_places(model, folder, samples.sample, ticks)
        except (TracklakeError, ValueError) as refused:
            if on_skip is None:
                raise
            on_skip(model.name, str(refused))
            continue
        own = find_cells(place_m, straight_m, targets)
        joined = np.stack([forest_column, own[..., 1]], axis=-1)
        for source, predicted in (("place", own), ("forest", joined)):
            cells += score_cells(model.name, source, predicted, true, forest.horizons_s, strata)
    maneuvers = [score_maneuvers(name, decided[of, 0], samples.maneuver[of]) for name, of in strata.items()]
    return GridScores(cells, maneuvers, found.left_out, found.reasons)


def predict_places(model: Forecaster, folder: TensorFolder, sample: Integers, ticks: Sequence[int]) -> Singles:
    """Predict the places of samples (S,) at some ticks ahead (T,): (S, T, 2).

    Raises:
        NotFiniteError: places are not finite numbers.
        TracklakeError: places are not of the horizon's shape.
    """
    place_m: Singles = np.empty((len(sample), len(ticks), 2), dtype=np.float32)
    for chosen, prediction, _ in model.predict(folder, sample):
        if not np.isfinite(prediction.position_m).all():
            raise NotFiniteError(model.name, "positions")
        place_m[chosen] = prediction.position_m[:, np.subtract(ticks, 1)]
    return place_m


def find_cells(place_m: Singles, straight_m: Singles, targets: Targets) -> Codes:
    """Find the columns and rows (S, T, 2) of places (S, T, 2), from constant-velocity places and observed targets."""
    speed_mps, ego = (targets.feature[:, FEATURE_NUMBER[name]] for name in ("relative_speed_mps", "ego"))
    column = find_columns(place_m[..., 1], targets.lanes)
    row = find_rows(place_m[..., 0], straight_m[..., 0], measure_rows(speed_mps, ego))
    return np.stack([column, row], axis=-1)


def score_maneuvers(stratum: str, decided: Bytes, label: Bytes) -> ManeuverScore:
    """Compare predicted maneuvers (B,) with labels (B,)."""
    right, of_class = decided == label, {name: label == code for code, name in enumerate(LATERAL_MANEUVERS)}
    recall = {name: _mean(right[of]) for name, of in of_class.items()}
    found = [share for share in recall.values() if share is not None]
    balanced = sum(found) / len(found) if found else None
    majority = max(float(of.mean()) for of in of_class.values()) if len(label) else None
    return ManeuverScore(stratum, len(label), _mean(right), recall, balanced, majority)


def score_cells(
    model: str, source: str, own: Codes, true: Codes, horizons_s: tuple[float, ...], strata: Mapping[str, Flags]
) -> Iterator[CellScore]:
    """Score predicted columns and rows (S, T, 2): one score for each horizon and stratum."""
    true_cell, own_cell = (number_cells(codes[..., 0], codes[..., 1]) for codes in (true, own))
    right = (own == true) & (np.abs(true) < OUTSIDE)
    figures = {
        "cell": right.all(axis=-1),
        "row": right[..., 1],
        "lane": right[..., 0],
        "cell_clipped": (own.clip(-1, 1) == true.clip(-1, 1)).all(axis=-1),
        "one_against_rest": compare_with_rest(own_cell, true_cell),
        "own_lane": true[..., 0] == 0,
        "outside": true_cell < 0,
    }
    for horizon, seconds in enumerate(horizons_s):
        for stratum, of in strata.items():
            cells = true_cell[of, horizon]
            majority = int(np.bincount(cells[cells >= 0], minlength=9).max()) / len(cells) if len(cells) else None
            shares = {name: _mean(values[of, horizon]) for name, values in figures.items()}
            yield CellScore(model, source, seconds, stratum, len(cells), majority=majority, **shares)


def compare_with_rest(own: Codes, true: Codes) -> Floats:
    """Return of each sample the share of the nine cells that it is rightly said to be in or not: 1 less two ninths."""
    wrong: Floats = (own != true) * ((own >= 0) + (true >= 0).astype(np.float64))
    return 1 - wrong / 9


def _mean(values: Flags | Floats) -> float | None:
    """Compute the mean of values, of flags the share that is set; None where there are none."""
    return float(values.mean()) if len(values) else None


def _find_ticks(folder: TensorFolder, forest: LaneForest) -> tuple[int, ...]:
    """Convert the forest's horizons to ticks ahead (T,); refuse other rates, and horizons the folder does not score."""
    protocol = folder.protocol
    scored = tuple(tick / protocol.rate_hz for tick in protocol.scored_ticks)
    if forest.rate_hz != protocol.rate_hz or not set(forest.horizons_s) <= set(scored):
        raise TracklakeError(
            f"the forest was fitted at {forest.rate_hz} Hz for horizons of {forest.horizons_s} s; {folder.path} is of "
            f"{protocol.name}, {protocol.rate_hz} Hz, scored at {scored} s. Fit it again on these tensors"
        )
    return tuple(round(seconds * protocol.rate_hz) for seconds in forest.horizons_s)


def learn_curve(
    folder: TensorFolder,
    *,
    sizes: Sequence[int] = SIZES,
    seeds: Sequence[int] = (0, 1, 2),
    settings: LaneForestSettings | None = None,
) -> list[LearningPoint]:
    """Fit forests on growing draws from the training part, and score each on the evaluation part.

    All points of a curve have the same mix, equally many examples of each stratum, or the curve would show how the mix
    changes. So it ends where the smallest stratum is used up; larger sizes are cut to that size, once. The larger draws
    of a seed hold the smaller ones. Each draw is fitted with the augmentation of the settings, and without.

    Raises:
        TracklakeError: one of the parts has no samples, or none whose maneuver is known; or see `fit_examples`.
    """
    settings = settings or LaneForestSettings()
    for part in ("train", "eval"):
        require_samples(folder, part)
    pool, scored = (label_samples(folder, part, settings) for part in ("train", "eval"))
    if empty := [part for part, labelled in (("train", pool), ("eval", scored)) if not len(labelled)]:
        raise TracklakeError(
            f"{folder.path}: no sample of {' and '.join(empty)} has a lane and a track that goes on for the horizon "
            f"and {settings.start_s:g} s, so that its maneuver is known; it needs longer recordings"
        )
    counts = pool.count_strata()
    counts = counts[counts > 0]
    most = int(len(counts) * counts.min())
    sizes = sorted({min(size, most) for size in sizes})
    truth = gather_examples(folder, scored.draw(MOST_SCORED, seed=0))
    points: list[LearningPoint] = []
    for seed in seeds:
        largest = pool.select(draw_balanced(pool.stratum, sizes[-1], np.random.default_rng(seed)))
        examples = gather_examples(folder, largest)
        for size in sizes:
            drawn = examples.select(draw_balanced(largest.stratum, size, np.random.default_rng(seed)))
            if len(np.unique(drawn.maneuver)) < 2:  # no forest
                continue
            for augmentation in dict.fromkeys([(), settings.augmentation]):
                changed = replace(settings, augmentation=augmentation, examples=size)
                forest = fit_examples(drawn, changed, seed, protocol=folder.protocol)
                decided = decide_classes(forest.predict_proba(truth.feature))
                own = score_maneuvers(ALL, decided[:, 0], truth.maneuver)
                lane = float((decided[:, -1] == truth.ahead[:, -1]).mean())
                facts = (len(drawn), bool(augmentation), seed, own.n)
                points.append(LearningPoint(*facts, own.accuracy, own.balanced, lane, own.majority))
    return points
