"""Learning curve: the forest's scores by number of examples, with and without augmentation."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.examples import (
    ALL,
    Examples,
    LabelledSamples,
    draw_balanced,
    gather_examples,
    label_samples,
)
from tracklake.training.lane_changes.forest import decide_classes, fit_examples
from tracklake.training.lane_changes.grid import score_maneuvers
from tracklake.training.lane_changes.settings import LaneForestSettings

SIZES = (250, 500, 1000, 2000, 4000)
"""Numbers of examples drawn, before augmentation."""
MOST_SCORED = 20_000
"""Largest number of samples that each forest is scored on."""


@dataclass(frozen=True)
class LearningPoint:
    """Scores of a forest of one size and seed on the evaluation part.

    Args:
        drawn: number of examples before augmentation.
        augmented: whether mirrored and shifted copies were added.
        seed: seed of the draw and the trees.
        n: number of samples scored.
        accuracy: share of samples whose maneuver is right.
        balanced: mean of the recalls of the maneuvers.
        lane: share of samples whose lane at the last horizon is right.
        majority: share of the most frequent maneuver among the samples scored.
    """

    drawn: int
    augmented: bool
    seed: int
    n: int
    accuracy: float | None
    balanced: float | None
    lane: float
    majority: float | None

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain values."""
        return asdict(self)


def learn_curve(
    folder: TensorFolder,
    *,
    sizes: Sequence[int] = SIZES,
    seeds: Sequence[int] = (0, 1, 2),
    settings: LaneForestSettings | None = None,
) -> list[LearningPoint]:
    """Fit forests on growing draws from the training part, and score each on the evaluation part.

    All points of a curve have the same mix, equally many examples of each stratum, or the curve would show how the mix
    changes. So it ends where the smallest stratum is used up: at its samples times the number of strata that are not
    empty. Larger sizes are cut to that size, once. The larger draws of a seed hold the smaller ones.

    Args:
        folder: tensors with a training and an evaluation part.
        sizes: largest numbers of examples drawn, before augmentation.
        seeds: seeds of the draws and the trees; each gives a curve.
        settings: settings of the forests; `examples` is replaced by the sizes, and augmentation is on (as set) and off.

    Raises:
        TracklakeError: one of the parts has no samples, or none whose maneuver is known; or see
            `forest.fit_examples`.
    """
    settings = settings or LaneForestSettings()
    pool, scored = (label_samples(folder, part, settings) for part in ("train", "eval"))
    _refuse_empty(folder, {"train": pool, "eval": scored}, settings)
    counts = pool.count_strata()
    counts = counts[counts > 0]
    most = int(len(counts) * counts.min())
    sizes = sorted({min(size, most) for size in sizes})
    # Samples that any of the draws needs are read once.
    largest = {seed: draw_balanced(pool.stratum, sizes[-1], np.random.default_rng(seed)) for seed in seeds}
    needed = np.unique(np.concatenate(list(largest.values())))
    examples = gather_examples(folder, pool.select(needed))
    truth = gather_examples(folder, scored.draw(MOST_SCORED, seed=0))
    points: list[LearningPoint] = []
    for seed in seeds:
        own, stratum = np.searchsorted(needed, largest[seed]), pool.stratum[largest[seed]]
        for size in sizes:
            drawn = examples.select(own[draw_balanced(stratum, size, np.random.default_rng(seed))])
            for augmentation in dict.fromkeys([(), settings.augmentation]):
                changed = replace(settings, augmentation=augmentation, examples=size)
                points += _fit_and_score(folder, drawn, truth, changed, seed)
    return points


def _refuse_empty(folder: TensorFolder, pools: dict[str, LabelledSamples], settings: LaneForestSettings) -> None:
    """Refuse parts without samples, or without samples whose maneuver is known.

    Raises:
        TracklakeError: the parts, and what would help.
    """
    empty = [part for part, pool in pools.items() if not len(pool)]
    without = [part for part in empty if not len(folder.samples_of(part))]
    if without:
        raise TracklakeError(
            f"{folder.path}: a learning curve is fitted on `train` and scored on `eval`, and the split "
            f"`{folder.split}` has no samples in {' and '.join(f'`{part}`' for part in without)}; with a single "
            "recording everything trains: add recordings and run `tracklake split`"
        )
    if empty:
        raise TracklakeError(
            f"{folder.path}: no sample of {' and '.join(empty)} has a lane and a track that goes on for the horizon "
            f"and {settings.start_s:g} s, so that its maneuver is known; it needs longer recordings"
        )


def _fit_and_score(
    folder: TensorFolder, examples: Examples, truth: Examples, settings: LaneForestSettings, seed: int
) -> Iterator[LearningPoint]:
    """Fit a forest and score it: a point, or none where all examples are of one class."""
    if len(np.unique(examples.maneuver)) < 2:
        return
    forest = fit_examples(examples, settings, seed, protocol=folder.protocol)
    decided = decide_classes(forest.predict_proba(truth.feature))
    score = score_maneuvers(ALL, decided[:, 0], truth.maneuver)
    yield LearningPoint(
        drawn=len(examples),
        augmented=bool(settings.augmentation),
        seed=seed,
        n=score.n,
        accuracy=score.accuracy,
        balanced=score.balanced,
        lane=float((decided[:, -1] == truth.ahead[:, -1]).mean()),
        majority=score.majority,
    )
