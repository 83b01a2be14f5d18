"""Fitting a lane-change forest with scikit-learn: draw, augment, choose features, grow, keep the arrays."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes
from tracklake.schemas.arrays import Singles as Floats
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.choice import choose_features
from tracklake.training.lane_changes.examples import (
    STRATA,
    Examples,
    augment,
    draw_balanced,
    gather_examples,
    judge_samples,
)
from tracklake.training.lane_changes.features import NUMBER
from tracklake.training.lane_changes.forest import LaneForest
from tracklake.training.lane_changes.settings import LaneForestSettings

if TYPE_CHECKING:
    from sklearn.ensemble import RandomForestClassifier


def fit_lane_forest(folder: TensorFolder, seed: int, settings: LaneForestSettings | None = None) -> LaneForest:
    """Fit a forest on a folder's training part.

    Args:
        folder: of any protocol; the horizons are those it scores.
        seed: of the draw, the shifts and the trees: same seed, same forest.
        settings: None: as they are by themselves.

    Raises:
        TracklakeError: the training part has no sample that keeps its lane, or none that changes it.
    """
    settings = settings or LaneForestSettings()
    judged = judge_samples(folder, "train", settings)
    drawn = judged.take(draw_balanced(judged.stratum, settings.examples, np.random.default_rng(seed)))
    facts = {
        "protocol": folder.index["protocol"],
        "split": folder.split,
        "blocks": folder.index["blocks"],
        "train_subsets": sorted(folder.subsets_of("train")),
        "lane_changes": judged.changes,
        "left_out": judged.left_out,
        "left_out_by_reason": judged.reasons,
        "samples_by_stratum": dict(zip(STRATA, judged.count_strata().tolist(), strict=True)),
        "drawn_by_stratum": dict(zip(STRATA, drawn.count_strata().tolist(), strict=True)),
    }
    if len(np.unique(drawn.maneuver)) < 2:
        raise TracklakeError(
            f"{folder.path}: a lane-change forest needs samples of the training part that keep their lane and some "
            f"that change it; got {facts['samples_by_stratum']} ({judged.changes} lane changes in all). It needs "
            "recordings with lanes, longer or more of them"
        )
    examples = gather_examples(folder, drawn)
    rate_hz = folder.protocol.rate_hz
    horizons_s = tuple(tick / rate_hz for tick in folder.protocol.scored_ticks)
    return grow(examples, settings, seed, rate_hz=rate_hz, horizons_s=horizons_s, facts=facts)


def grow(
    examples: Examples,
    settings: LaneForestSettings,
    seed: int,
    *,
    rate_hz: int,
    horizons_s: tuple[float, ...],
    facts: dict[str, Any] | None = None,
) -> LaneForest:
    """Augment examples, choose features, and fit the trees.

    One forest says everything: each tree is grown on the maneuver and on the lanes at all horizons together, so that a
    leaf knows both which maneuver is under way and how far it will have come at each horizon.

    Args:
        examples: drawn.
        settings: see there.
        seed: of the shifts and of the trees.
        rate_hz: of the examples' histories.
        horizons_s: of the examples' lanes ahead.
        facts: kept with the forest, beside the settings, the seed and the coefficients.

    Raises:
        TracklakeError: no feature correlates enough with the maneuver.
    """
    augmented = augment(examples, settings, np.random.default_rng([seed, 1]))
    table = choose_features(
        augmented.feature,
        augmented.maneuver,
        least=settings.least_correlation,
        most=settings.most_correlation,
    )
    names = tuple(row.feature for row in table if row.chosen)
    if not names:
        raise TracklakeError(
            f"no feature correlates with the maneuver by {settings.least_correlation:g} or more (the best, "
            f"{table[0].feature}, by {table[0].strength:.3f}): set `least_correlation` lower"
        )
    given = augmented.feature[:, [NUMBER[name] for name in names]]
    classes = np.concatenate([augmented.maneuver[:, None], augmented.ahead], axis=1)
    arrays = to_arrays(fit_trees(given, classes, settings, seed))
    known = {
        **(facts or {}),
        "settings": {**asdict(settings), "augmentation": list(settings.augmentation)},
        "seed": seed,
        "examples": len(augmented),
        "coefficients": [row.to_dict() for row in table],
    }
    return LaneForest(names, rate_hz, horizons_s, known, **arrays)


def fit_trees(given: Floats, classes: Bytes, settings: LaneForestSettings, seed: int) -> "RandomForestClassifier":
    """A `RandomForestClassifier` on (B, features) and (B, outputs) codes of LATERAL_MANEUVERS."""
    from sklearn.ensemble import RandomForestClassifier

    forest = RandomForestClassifier(
        n_estimators=settings.trees, min_samples_leaf=settings.leaf, random_state=seed, n_jobs=1
    )
    return forest.fit(given, classes)


def to_arrays(fitted: "RandomForestClassifier") -> dict[str, npt.NDArray[Any]]:
    """The trees of a fitted forest of several outputs as the arrays of `LaneForest`."""
    trees = [tree.tree_ for tree in fitted.estimators_]
    nodes = np.array([tree.node_count for tree in trees])
    root = (np.cumsum(nodes) - nodes).astype(np.int32)

    def join(name: str, offset: npt.NDArray[np.int32] | int) -> npt.NDArray[Any]:
        values = np.concatenate([getattr(tree, name) for tree in trees])
        return np.where(leaf, -1, values + offset).astype(np.int32)

    leaf = np.concatenate([tree.children_left for tree in trees]) < 0
    value = np.concatenate([tree.value for tree in trees])[leaf]  # (A, outputs, classes found)
    odds = np.zeros((len(value), len(fitted.classes_), len(LATERAL_MANEUVERS)))
    for output, found in enumerate(fitted.classes_):  # which classes an output has seen
        odds[:, output, found.astype(np.intp)] = value[:, output, : len(found)]
    offset = np.repeat(root, nodes)
    return {
        "root": root,
        "left": join("children_left", offset),
        "right": join("children_right", offset),
        "feature": join("feature", 0),
        "threshold": np.where(leaf, 0.0, np.concatenate([tree.threshold for tree in trees])),
        "leaf_odds": odds,
    }
