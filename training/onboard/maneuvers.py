"""Random forest of Choi et al. (2021) that predicts lane changes: information gain, and a majority of the trees' votes.

Each sample is described by every feature now and by its change over the history; those that correlate with the maneuver
and not with each other are read, as for `lane_changes`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from tracklake.schemas.arrays import Bytes, Floats, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.lane_forest import Coefficient
from tracklake.schemas.protocols import V2V
from tracklake.training.lane_changes.cells import Codes, find_columns, find_rows, measure_rows
from tracklake.training.lane_changes.examples import KEEP, LEFT, RIGHT, draw_balanced
from tracklake.training.lane_changes.features import choose_features, standardise_columns
from tracklake.training.onboard.models import predict_straight
from tracklake.training.onboard.samples import FEATURE_NUMBER, FEATURES, Samples, augment_samples

NAMES = (*FEATURES, *(f"change of {name}" for name in FEATURES))
"""Descriptions of a sample: each feature now, and now minus at the history's beginning."""
CORRELATED = (*NAMES, *LATERAL_MANEUVERS)
"""Rows and columns of the correlation matrix."""
TREES, LEAF = 100, 5
"""Number of trees, and least number of examples in a leaf."""
MOST_EXAMPLES = 10_000
"""Largest number of examples drawn from the training part, evenly from the four groups, before augmentation."""
LEAST_CORRELATION, MOST_CORRELATION = 0.02, 0.95
COLUMNS = np.array([{"keep": 0, "left": -1, "right": 1}[name] for name in LATERAL_MANEUVERS], dtype=np.int8)
"""Column of each maneuver."""
AT = np.array(V2V.scored_ticks) - 1
"""Positions of the scored ticks among those ahead."""


@dataclass(frozen=True)
class ManeuverForest:
    """Forest with 1 + T outputs, the maneuver within the horizon and the column at each scored tick.

    Where it learned the maneuver alone, there is one output. `chosen` are positions in NAMES, `coefficients` those of
    all features with the maneuvers on the training part, and `matrix` those of all of CORRELATED with each other.
    """

    classifier: Any  # scikit-learn's RandomForestClassifier, whose import takes a second
    chosen: Integers
    coefficients: list[Coefficient]
    matrix: Floats
    examples: int

    def count_votes(self, samples: Samples) -> Integers:
        """Count the trees that vote for keep, left and right: (B, 1 + T, 3), or (B, 1, 3)."""
        given, outputs = describe_samples(samples)[:, self.chosen], self.classifier.n_outputs_
        known = self.classifier.classes_ if outputs > 1 else [self.classifier.classes_]
        votes = np.zeros((len(samples), outputs, len(LATERAL_MANEUVERS)), dtype=np.int64)
        for tree in self.classifier.estimators_ if len(samples) else ():
            decided = tree.predict(given).astype(np.intp).reshape(-1, outputs)  # positions in the forest's classes
            for output, classes in enumerate(known):
                votes[np.arange(len(samples)), output, classes[decided[:, output]].astype(np.intp)] += 1
        return votes

    def decide(self, samples: Samples) -> Bytes:
        """Decide by majority: (B, 1 + T) or (B, 1); of equally many votes the first of keep, left and right counts."""
        decided: Bytes = self.count_votes(samples).argmax(axis=-1).astype(np.uint8)
        return decided


def describe_samples(samples: Samples) -> Singles:
    """Describe samples by NAMES: (B, 24)."""
    now, then = samples.feature[:, -1], samples.feature[:, 0]
    return np.concatenate([now, now - then], axis=1)


def correlate_features(samples: Samples) -> list[Coefficient]:
    """Correlate all descriptions with keep, left and right, and choose those that a forest reads."""
    described = describe_samples(samples)
    return choose_features(described, samples.maneuver, least=LEAST_CORRELATION, most=MOST_CORRELATION, names=NAMES)


def correlate_pairs(samples: Samples) -> Floats:
    """Correlate all descriptions and maneuvers with each other: (27, 27), as CORRELATED; 0 where one does not vary."""
    maneuvers = samples.maneuver[:, None] == np.arange(len(LATERAL_MANEUVERS))
    values = standardise_columns(np.column_stack([describe_samples(samples), maneuvers]))
    matrix: Floats = np.clip(values.T @ values, -1, 1)
    return matrix


def fit_forest(
    samples: Samples, seed: int, examples: int = MOST_EXAMPLES, *, maneuver_alone: bool = False
) -> ManeuverForest:
    """Fit a forest on samples of the training part: drawn evenly from the four groups, mirrored and shifted.

    It learns the maneuver and the column at each scored tick, or the `maneuver_alone`.

    Raises:
        TracklakeError: all samples have the same maneuver, or nothing correlates with it.
    """
    random = np.random.default_rng(seed)
    drawn = samples.select(draw_balanced(samples.stratum, examples, random))
    table = correlate_features(drawn) if len(np.unique(drawn.maneuver)) > 1 else []
    numbers = {name: number for number, name in enumerate(NAMES)}
    chosen = np.array([numbers[row.feature] for row in table if row.chosen], dtype=np.int64)
    if not len(chosen):
        raise TracklakeError(
            f"a forest of maneuvers needs training samples that keep their lane and some that change it; got "
            f"{np.bincount(samples.maneuver, minlength=3).tolist()} that keep, go left, go right, of "
            f"{len(np.unique(samples.trajectory))} trajectories. It needs longer or more drives"
        )
    from sklearn.ensemble import RandomForestClassifier

    larger = augment_samples(drawn, random)
    learned = larger.maneuver
    if not maneuver_alone:
        column = np.clip(find_cells(larger, larger.place_m)[..., 0], -1, 1)
        learned = np.column_stack([learned, np.where(column == 0, KEEP, np.where(column < 0, LEFT, RIGHT))])
    classifier = RandomForestClassifier(
        n_estimators=TREES, criterion="entropy", min_samples_leaf=LEAF, random_state=seed, n_jobs=1
    )
    classifier.fit(describe_samples(larger)[:, chosen], learned)
    return ManeuverForest(classifier, chosen, table, correlate_pairs(drawn), len(drawn))


def find_cells(samples: Samples, place_m: Singles) -> Codes:
    """Find column and row (B, T, 2) of places (B, F, 2) at the scored ticks, relative to the ego.

    Cells are one lane wide and as long as vehicle and ego approach in a second, around the vehicle's column now and
    its place at constant velocity.
    """
    no_lanes = np.zeros((len(samples), 3, 3), dtype=np.float32)
    straight_m = predict_straight(samples, V2V.horizon_ticks)[:, AT]
    side = place_m[:, AT, 1] - samples.feature[:, -1:, FEATURE_NUMBER["rel_y_m"]]
    rows = measure_rows(samples.velocity_mps[:, 0], np.ones(len(samples)))
    return np.stack([find_columns(side, no_lanes), find_rows(place_m[:, AT, 0], straight_m[..., 0], rows)], axis=-1)
