"""Choi et al. (2021) as published, on overhead tracks, beside our forest on the same vehicles.

As published: a forest by information gain whose trees vote on the maneuver, which gives the column at every horizon; a
decoder that is fed with its own output and predicts places; twelve features, standardised on the training part; 70 % of
the vehicles train. Our forest predicts the lane at each horizon, from 21 features of its own.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Bytes, Singles
from tracklake.schemas.protocols import V2V
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.examples import (
    LabelledSamples,
    LaneForestSettings,
    draw_balanced,
    gather_examples,
    label_samples,
    read_targets,
)
from tracklake.training.lane_changes.forest import decide_classes, fit_examples
from tracklake.training.lane_changes.scores import COLUMNS, CellScore, ManeuverScore, score_cells, score_maneuvers
from tracklake.training.onboard.maneuvers import AT, fit_forest
from tracklake.training.onboard.models import CTRV, predict_turns
from tracklake.training.onboard.overhead import OverheadSamples, build_overhead, find_road_cells
from tracklake.training.onboard.samples import Samples, split_samples
from tracklake.training.onboard.scores import OnboardLearningPoint, group_samples, learn_curve
from tracklake.training.onboard.training import run_network, train_network
from tracklake.training.runs.config import TrainConfig

MOST = 50_000
"""Largest number of samples, drawn from all parts of the split."""
GRIDS = {"around the place now": True, "around constant velocity": False}
"""Grids by what their rows lie around, and whether that is the place now, relative to the vehicle behind."""
DECODER = "lstm-encoder-decoder"
"""Network of the publication, by its name in `models.NETWORKS`."""
PUBLISHED, OURS = "as published", "ours"
"""Names of the two forests."""


@dataclass(frozen=True)
class PlaceError:
    """Mean distance of a model's places from the true ones at one horizon, over n samples."""

    model: str
    seconds: float
    n: int
    mae_m: float


@dataclass(frozen=True)
class PublishedScores:
    """Scores of the arm as published and of our forest, on the vehicles that do not train.

    `samples` and `vehicles` are counts by part, `train` and `eval`. `cells` are by grid, see GRIDS, `maneuvers` by
    forest, PUBLISHED and OURS. `left_out` counts samples without a vehicle behind.
    """

    samples: dict[str, int]
    vehicles: dict[str, int]
    left_out: int
    features: list[str]
    cells: dict[str, list[CellScore]]
    maneuvers: dict[str, list[ManeuverScore]]
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
    each other, as in the publication. With `epochs`, the decoder is trained, too, on the samples that the forest drew
    from.

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
    predicted = {CTRV: predict_turns(parts.eval)}
    if epochs:
        drawn = draw_balanced(parts.train.stratum, settings.examples, np.random.default_rng(seed))
        config = TrainConfig(epochs=epochs, seed=seed)
        network = train_network(
            DECODER, parts._replace(train=parts.train.select(drawn)), config, progress, anchored=False
        )
        predicted[DECODER] = run_network(network, parts.eval)
    return PublishedScores(
        samples={"train": len(parts.train), "eval": len(parts.eval)},
        vehicles={name: len(np.unique(own.vehicle)) for name, own in (("train", parts.train), ("eval", parts.eval))},
        left_out=everything.without_ego,
        features=[row.feature for row in forest.coefficients if row.chosen],
        cells={name: list(_score_grid(held_out, predicted, columns, around_now=now)) for name, now in GRIDS.items()},
        maneuvers={name: _score_maneuvers(parts.eval, decided[:, 0]) for name, decided in columns.items()},
        errors=list(_measure_errors(parts.eval, predicted)),
        learning_curve=learn_curve(parts, seed, maneuver_alone=True) if with_curve else [],
    )


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
