"""Learning curve: how the forest's scores grow with the examples it is given, with and without augmentation."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tracklake.schemas.arrays import Bytes
from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.examples import Examples, Judged, draw_balanced, gather_examples, judge_samples
from tracklake.training.lane_changes.fitting import grow
from tracklake.training.lane_changes.forest import decide
from tracklake.training.lane_changes.grid import score_maneuvers
from tracklake.training.lane_changes.settings import LaneForestSettings

SIZES = (250, 500, 1000, 2000, 4000)
MOST_SCORED = 20_000


@dataclass(frozen=True)
class LearningPoint:
    """A forest of one size and seed, scored on the evaluation part.

    Args:
        drawn: examples before augmentation.
        augmented: whether mirrored and shifted copies were added.
        seed: of the draw and the trees.
        n: samples scored.
        accuracy: of the maneuver.
        balanced: mean of the recalls of the maneuvers.
        lane: share of samples whose lane at the last horizon is right.
        majority: share of the most frequent maneuver among those scored.
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
        """As plain values."""
        return asdict(self)


def learn_curve(
    folder: TensorFolder,
    *,
    sizes: Sequence[int] = SIZES,
    seeds: Sequence[int] = (0, 1, 2),
    settings: LaneForestSettings | None = None,
) -> list[LearningPoint]:
    """Fit forests on more and more of the training part, score each on the evaluation part.

    All points of a curve are of the same mix, as many examples of each stratum, or the curve would show how the mix
    changes. So it ends where the smallest stratum is used up: at 4 times its samples (of fewer strata, where some are
    empty, as many times). Sizes beyond are that size, once. The larger draws of a seed hold the smaller ones.

    Args:
        folder: with a training and an evaluation part.
        sizes: examples drawn, before augmentation; each at most.
        seeds: each gives a curve.
        settings: of the forests; `examples` is taken from `sizes`, and augmentation is on (as it is set) and off.

    Raises:
        TracklakeError: one of the parts has no samples, or none whose maneuver is known; or see `fitting.grow`.
    """
    settings = settings or LaneForestSettings()
    pools = {part: judge_samples(folder, part, settings) for part in ("train", "eval")}
    empty = [part for part, pool in pools.items() if not len(pool.sample)]
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
    pool, scored = pools["train"], pools["eval"]
    if len(scored.sample) > MOST_SCORED:
        drawn = np.random.default_rng(0).permutation(len(scored.sample))[:MOST_SCORED]
        scored = scored.take(np.sort(drawn))
    most = count_even(pool)
    sizes = sorted({min(size, most) for size in sizes})
    # Read once what any of the draws may need.
    largest = {seed: draw_balanced(pool.stratum, sizes[-1], np.random.default_rng(seed)) for seed in seeds}
    needed = np.unique(np.concatenate(list(largest.values())))
    examples, truth = gather_examples(folder, pool.take(needed)), gather_examples(folder, scored)
    points = []
    for seed in seeds:
        own = np.searchsorted(needed, largest[seed])
        stratum = pool.stratum[largest[seed]]
        for size in sizes:
            drawn = own[draw_balanced(stratum, size, np.random.default_rng(seed))]
            for augmentation in dict.fromkeys([(), settings.augmentation]):
                changed = replace(settings, augmentation=augmentation, examples=size)
                point = _fit_and_score(folder, examples.take(drawn), truth, changed, seed)
                if point is not None:
                    points.append(point)
    return points


def count_even(pool: Judged) -> int:
    """How many samples can be drawn with as many of each stratum that is not empty."""
    counts = pool.count_strata()
    counts = counts[counts > 0]
    return int(len(counts) * counts.min())


def _fit_and_score(
    folder: TensorFolder, examples: Examples, truth: Examples, settings: LaneForestSettings, seed: int
) -> LearningPoint | None:
    """A point of the curve; None where the draw holds one class only, so that there is nothing to learn."""
    if len(np.unique(examples.maneuver)) < 2:
        return None
    horizons_s = tuple(tick / folder.protocol.rate_hz for tick in folder.protocol.scored_ticks)
    forest = grow(examples, settings, seed, rate_hz=folder.protocol.rate_hz, horizons_s=horizons_s)
    decided: Bytes = decide(forest.predict_proba(truth.feature))
    score = score_maneuvers("all", decided[:, 0], truth.maneuver)
    return LearningPoint(
        drawn=len(examples),
        augmented=bool(settings.augmentation),
        seed=seed,
        n=score.n,
        accuracy=score.accuracy,
        balanced=score.balanced,
        lane=float((decided[:, -1] == truth.ahead[:, -1]).mean()),
        majority=score.majority,
    )
