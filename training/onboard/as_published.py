"""Choi et al. (2021) as published, on overhead tracks, beside our forest on the same vehicles.

As published: a forest by information gain whose trees vote on the maneuver, which gives the column at every horizon; a
decoder that is fed with its own output and predicts places; twelve features, standardised on the training part; 70 % of
the vehicles train. Our forest predicts the lane at each horizon, from 21 features of its own.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Flags, Floats, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.lane_forest import CellScore, ManeuverScore
from tracklake.schemas.protocols import V2V
from tracklake.training.comparison.bootstrap import estimate_differences, estimate_shares
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.cells import OUTSIDE, number_cells
from tracklake.training.lane_changes.examples import (
    LabelledSamples,
    LaneForestSettings,
    draw_balanced,
    gather_examples,
    label_samples,
    read_targets,
)
from tracklake.training.lane_changes.forest import decide_classes, fit_examples
from tracklake.training.lane_changes.scores import COLUMNS, compare_with_rest, score_cells, score_maneuvers
from tracklake.training.onboard.maneuvers import AT, fit_forest
from tracklake.training.onboard.models import CTRV, predict_turns
from tracklake.training.onboard.overhead import OverheadSamples, build_overhead, find_road_cells
from tracklake.training.onboard.samples import Parts, Samples, split_samples
from tracklake.training.onboard.scores import OnboardLearningPoint, group_samples, learn_curve
from tracklake.training.onboard.training import Watch, run_network, train_network
from tracklake.training.runs.config import TrainConfig

MOST = 50_000
"""Largest number of samples, drawn from all parts of the split."""
GRIDS = {"around the place now": True, "around constant velocity": False}
"""Grids by what their rows lie around, and whether that is the place now, relative to the vehicle behind."""
DECODER = "lstm-encoder-decoder"
"""Network of the publication, by its name in `models.NETWORKS`."""
HELD_BACK, PATIENCE = 1 / 8, 3
"""Share of the training vehicles that end the decoder's training, and epochs without a smaller loss on them."""
PUBLISHED, OURS, DIFFERENCE = "as published", "ours", "difference"
"""Names of the two forests, and of the first minus the second."""
CONSTANT = "always the commonest"
"""Name of the answer that is the same for all samples: the commonest maneuver or cell."""
SHARES = ("maneuver", *LATERAL_MANEUVERS, "cell", "cell_clipped", "one_against_rest")
"""Shares with intervals: right maneuvers, of all samples and of each true maneuver; of cells as in `CellScore`."""


@dataclass(frozen=True)
class PlaceError:
    """Mean distance of a model's places from the true ones at one horizon, over n samples."""

    model: str
    seconds: float
    n: int
    mae_m: float


@dataclass(frozen=True)
class ShareScore:
    """A share of n samples of some vehicles, or the difference of both forests, with its 95 % interval over vehicles.

    `figure` is one of SHARES, `grid` one of GRIDS, `forest` PUBLISHED, OURS, DIFFERENCE or CONSTANT. Rows of cells
    are those of a model's places, columns the forest's. Of maneuvers, `model`, `grid` and `seconds` are null.
    """

    figure: str
    model: str | None
    grid: str | None
    seconds: float | None
    forest: str
    n: int
    vehicles: int
    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class DecoderCourse:
    """Course of the decoder's training: losses by epoch, and the epoch, from 0, whose weights were kept.

    `converged` tells whether PATIENCE epochs brought no smaller loss on the vehicles that were held back.
    """

    best: int
    converged: bool
    losses: list[float]
    validation_losses: list[float]


@dataclass(frozen=True)
class PublishedScores:
    """Scores of the arm as published and of our forest, on the vehicles that do not train.

    `samples` and `vehicles` are counts by part, `train` and `eval`. `cells` are by grid, see GRIDS, `maneuvers` by
    forest, PUBLISHED and OURS; `shares` are the same with intervals. `left_out` counts samples without a vehicle
    behind. `decoder` is null where it was not trained.
    """

    samples: dict[str, int]
    vehicles: dict[str, int]
    left_out: int
    features: list[str]
    cells: dict[str, list[CellScore]]
    maneuvers: dict[str, list[ManeuverScore]]
    shares: list[ShareScore]
    decoder: DecoderCourse | None
    errors: list[PlaceError]
    learning_curve: list[OnboardLearningPoint]


def score_published(
    folder: TensorFolder,
    settings: LaneForestSettings,
    seed: int,
    *,
    epochs: int = 0,
    with_curve: bool = False,
    progress: Callable[[float, float], None] | None = None,
) -> PublishedScores:
    """Fit the forest as published and ours on 70 % of all vehicles, and score both on the others.

    The parts of the folder's split are put together and divided again, by vehicle: vehicles of both parts drive beside
    each other, as in the publication. With `epochs`, the decoder is trained, too, until it converges
    (`DecoderCourse`), or for so many epochs.

    Raises:
        TracklakeError: the folder's ticks are not those of the publication; there are too few vehicles, or all keep
            their lanes.
    """
    everything = build_overhead(folder, label_samples(folder, None, settings).draw(MOST, seed))
    parts = split_samples(everything.samples, seed)
    is_train = np.isin(everything.samples.vehicle, np.unique(parts.train.vehicle))
    forest = fit_forest(parts.train, seed, settings.examples, maneuver_alone=True)
    held_out = everything.select(np.flatnonzero(~is_train))
    columns = {PUBLISHED: forest.decide(parts.eval)}
    columns[OURS] = _decide_ours(folder, everything.select(np.flatnonzero(is_train)), held_out, settings, seed)
    predicted, course = {CTRV: predict_turns(parts.eval)}, None
    if epochs:
        places, course = _train_decoder(parts, settings.examples, TrainConfig(epochs=epochs, seed=seed), progress)
        predicted[DECODER] = places
    return PublishedScores(
        samples={"train": len(parts.train), "eval": len(parts.eval)},
        vehicles={name: len(np.unique(own.vehicle)) for name, own in (("train", parts.train), ("eval", parts.eval))},
        left_out=everything.without_ego,
        features=[row.feature for row in forest.coefficients if row.chosen],
        cells={name: list(_score_grid(held_out, predicted, columns, around_now=now)) for name, now in GRIDS.items()},
        maneuvers={name: _score_maneuvers(parts.eval, decided[:, 0]) for name, decided in columns.items()},
        shares=list(compare_forests(held_out, predicted, columns)),
        decoder=course,
        errors=list(_measure_errors(parts.eval, predicted)),
        learning_curve=learn_curve(parts, seed, maneuver_alone=True) if with_curve else [],
    )


def _train_decoder(
    parts: Parts, examples: int, config: TrainConfig, progress: Callable[[float, float], None] | None
) -> tuple[Singles, DecoderCourse]:
    """Train the decoder until the loss on HELD_BACK of the training vehicles stops falling; places (B, F, 2) of `eval`.

    It learns from as many examples of the other training vehicles as the forest does.
    """
    random = np.random.default_rng(config.seed)
    vehicles = np.unique(parts.train.vehicle)
    held_back = np.isin(parts.train.vehicle, random.permutation(vehicles)[: math.ceil(HELD_BACK * (len(vehicles) - 1))])
    rest = parts.train.select(np.flatnonzero(~held_back))
    learned = rest.select(draw_balanced(rest.stratum, examples, random))
    watch = Watch(parts.train.select(np.flatnonzero(held_back)), PATIENCE)
    network = train_network(DECODER, parts._replace(train=learned), config, progress, anchored=False, watch=watch)
    losses, validation_losses = map(list, zip(*watch.losses, strict=True))
    return run_network(network, parts.eval), DecoderCourse(watch.best, watch.is_over, losses, validation_losses)


def _decide_ours(
    folder: TensorFolder, train: OverheadSamples, held_out: OverheadSamples, settings: LaneForestSettings, seed: int
) -> Bytes:
    """Fit our forest on the same vehicles, and decide maneuver and lane at each horizon of the others: (B, 1 + T)."""
    own = train.samples
    drawn = draw_balanced(own.stratum, settings.examples, np.random.default_rng(seed))
    labelled = LabelledSamples(train.number[drawn], own.maneuver[drawn], own.stratum[drawn], {}, 0)
    forest = fit_examples(gather_examples(folder, labelled), settings, seed, protocol=folder.protocol)
    targets = read_targets(folder, held_out.number, V2V.scored_ticks)
    return decide_classes(forest.predict_proba(targets.feature))


def _score_grid(
    held_out: OverheadSamples, predicted: Mapping[str, Singles], decided: Mapping[str, Bytes], *, around_now: bool
) -> Iterator[CellScore]:
    """Score places (B, F, 2) by model, with their own columns and with those of each forest."""
    samples, groups = held_out.samples, group_samples(held_out.samples)
    true = find_road_cells(held_out, samples.place_m, around_now=around_now)
    # One maneuver is the column at every horizon; else the lane at each horizon is.
    columns = {name: COLUMNS[own[:, 1:] if own.shape[1] > 1 else own] for name, own in decided.items()}
    for model, place_m in predicted.items():
        cells = find_road_cells(held_out, place_m, around_now=around_now)
        yield from score_cells(model, "place", cells, true, V2V.scored_s, groups)
        for name, column in columns.items():
            joined = np.stack([np.broadcast_to(column, cells.shape[:2]), cells[..., 1]], axis=-1)
            yield from score_cells(model, f"forest {name}", joined, true, V2V.scored_s, groups)


def compare_forests(
    held_out: OverheadSamples, predicted: Mapping[str, Singles], decided: Mapping[str, Bytes]
) -> Iterator[ShareScore]:
    """Compare both forests with intervals: maneuvers, and cells whose rows are those of places (B, F, 2) by model."""
    samples = held_out.samples
    number = number_vehicles(samples)
    maneuver = samples.maneuver[:, None]
    right = {name: own[:, :1] == maneuver for name, own in decided.items()}
    common = {CONSTANT: maneuver == _find_commonest(maneuver)}
    yield from _compare_values(("maneuver", None, None), [None], right | common, number)
    for code, name in enumerate(LATERAL_MANEUVERS):
        of = np.flatnonzero(samples.maneuver == code)
        if len(of):
            flags = {own: values[of] for own, values in right.items()}
            yield from _compare_values((name, None, None), [None], flags, number[of])
    columns = {name: COLUMNS[own[:, 1:] if own.shape[1] > 1 else own] for name, own in decided.items()}
    for (grid, around_now), (model, place_m) in product(GRIDS.items(), predicted.items()):
        true, rows = (find_road_cells(held_out, own, around_now=around_now) for own in (samples.place_m, place_m))
        cells = {
            name: np.stack([np.broadcast_to(column, true.shape[:2]), rows[..., 1]], axis=-1)
            for name, column in columns.items()
        }
        inside = (np.abs(true) < OUTSIDE).all(axis=-1)
        nine = {name: (own == true).all(axis=-1) & inside for name, own in cells.items()}
        endless = {name: (own.clip(-1, 1) == true.clip(-1, 1)).all(axis=-1) for name, own in cells.items()}
        cell, clipped = (number_cells(own[..., 0], own[..., 1]) for own in (true, true.clip(-1, 1)))
        said = {name: number_cells(own[..., 0], own[..., 1]) for name, own in cells.items()} | {
            CONSTANT: _find_commonest(cell)
        }
        rest = {name: compare_with_rest(own, cell) for name, own in said.items()}
        nine[CONSTANT], endless[CONSTANT] = cell == _find_commonest(cell), clipped == _find_commonest(clipped)
        for figure, values in (("cell", nine), ("cell_clipped", endless), ("one_against_rest", rest)):
            yield from _compare_values((figure, model, grid), list(V2V.scored_s), values, number)


def _find_commonest(codes: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Pick the commonest of codes (B, T) at each horizon: (T,); those below 0 do not count."""
    most = [np.bincount(own[own >= 0], minlength=1).argmax() for own in codes.T]
    return np.array(most, dtype=codes.dtype)


def number_vehicles(samples: Samples) -> Integers:
    """Number the vehicles of samples (B,) by subset and id, so that those of successive ids stand together."""
    subset = np.unique(samples.subset, return_inverse=True)[1].astype(np.int64)
    return subset * (int(samples.vehicle_id.max()) + 1) + samples.vehicle_id


def _compare_values(
    key: tuple[str, str | None, str | None],
    seconds: Sequence[float | None],
    values: Mapping[str, Flags | Floats],
    vehicle: Integers,
) -> Iterator[ShareScore]:
    """Find the means of values (B, T), 0 to 1, by forest, and the difference of both, at each horizon."""
    means = {
        name: estimate_shares(own.astype(np.bool_), vehicle)[:3]
        if own.dtype == np.bool_
        else estimate_differences(own.astype(np.float64), vehicle)
        for name, own in values.items()
    }
    ours, published = (values[name].astype(np.float64) for name in (OURS, PUBLISHED))
    means[DIFFERENCE] = estimate_differences(published - ours, vehicle)
    vehicles = len(np.unique(vehicle))
    for name, figures in means.items():
        for at, (value, low, high) in zip(seconds, np.stack(figures, axis=-1).tolist(), strict=True):
            bounds = (None, None) if math.isnan(low) else (low, high)
            yield ShareScore(*key, at, name, len(vehicle), vehicles, value, *bounds)


def _score_maneuvers(samples: Samples, decided: Bytes) -> list[ManeuverScore]:
    """Score maneuvers (B,) over all samples and each stratum."""
    groups = group_samples(samples)
    return [score_maneuvers(name, decided[of], samples.maneuver[of]) for name, of in groups.items()]


def _measure_errors(samples: Samples, predicted: Mapping[str, Singles]) -> Iterator[PlaceError]:
    """Measure the mean distance of places from the true ones."""
    for model, place_m in predicted.items():
        error_m = place_m[:, AT].astype(np.float64) - samples.place_m[:, AT]
        mae_m = np.hypot(error_m[..., 0], error_m[..., 1]).mean(axis=0)
        yield from (
            PlaceError(model, seconds, len(samples), float(own))
            for seconds, own in zip(V2V.scored_s, mae_m, strict=True)
        )
