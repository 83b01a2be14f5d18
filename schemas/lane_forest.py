"""Records of `lane_forest.json`: features of a forest that predicts lane changes, and scores of maneuvers and cells."""

from dataclasses import dataclass
from typing import NamedTuple

STRATA = ("accelerating, keeping", "accelerating, changing", "decelerating, keeping", "decelerating, changing")
"""Groups of samples. Accelerating: the recorded speed is at least what it was a second ago. Changing: the label is
not keep."""
ALL = "all"
"""Name of the group of all samples."""
LEFT_OUT = ("no lane", "future unknown", "maneuver unknown", "speed unknown")
"""Why a sample is left out: it has no lane now; its track ends before the horizon, or before T_d, the time that a
maneuver takes, has passed; or its speed is unknown, now or a second ago. The first that applies counts."""
SAME, NEGATED = "same", "negated"


class Feature(NamedTuple):
    """One number that describes a target: lateral values are positive to the right.

    `mirrored` is the value on the mirrored road: SAME, NEGATED, or the name of another feature.
    """

    name: str
    meaning: str
    mirrored: str = SAME


FEATURES = (
    Feature("speed_mps", "along the road"),
    Feature("accel_mps2", "along the road"),
    Feature("lateral_speed_mps", "across the road", NEGATED),
    Feature("lateral_accel_mps2", "across the road", NEGATED),
    Feature("heading_rad", "of the velocity, from the direction of travel", NEGATED),
    Feature("yaw_rate_radps", "change of the heading; stands in for the steering", NEGATED),
    Feature("moved_m", "across the road since the history's beginning", NEGATED),
    Feature("offset_m", "from the centre of its lane", NEGATED),
    Feature("left_marking_m", "from the vehicle's centre to the lane's left edge", "right_marking_m"),
    Feature("right_marking_m", "from the vehicle's centre to the lane's right edge", "left_marking_m"),
    Feature("left_lane", "1 where there is a lane to the left", "right_lane"),
    Feature("right_lane", "1 where there is a lane to the right", "left_lane"),
    Feature("ego", "1 where there is a vehicle behind; where there is none, all that follows is 0"),
    Feature("ego_column", "lane of the vehicle behind: -1 left, 0 own, 1 right", NEGATED),
    Feature("gap_m", "distance from the ego's front to the target's front"),
    Feature("side_m", "distance of the target to the right of the ego", NEGATED),
    Feature("relative_speed_mps", "the target's speed minus the ego's; the following likewise"),
    Feature("relative_accel_mps2", "along the road"),
    Feature("relative_lateral_speed_mps", "across the road", NEGATED),
    Feature("relative_heading_rad", "of the velocities", NEGATED),
    Feature("relative_yaw_rate_radps", "of the headings' changes", NEGATED),
)
"""All candidates; a fit chooses which of them its forest reads."""
FEATURE_NAMES = tuple(feature.name for feature in FEATURES)
FEATURE_NUMBER = {name: number for number, name in enumerate(FEATURE_NAMES)}
"""Position of each feature in FEATURES."""


@dataclass(frozen=True)
class Coefficient:
    """Pearson's coefficients of a feature with 1 where the class is keep, left or right, else 0 (point-biserial).

    They are 0 where either does not vary. `reason` says why the forest does not read the feature; empty where it does.
    """

    feature: str
    keep: float
    left: float
    right: float
    chosen: bool
    reason: str

    @property
    def strength(self) -> float:
        """Largest of the three coefficients' absolute values."""
        return max(abs(self.keep), abs(self.left), abs(self.right))


@dataclass(frozen=True)
class CellScore:
    """Scores of one model at one horizon, over all samples or one stratum: shares of n samples, None where n is 0.

    The `column` is that of the model's own `place`, or the `forest`'s. `cell`, `row` and `lane` are samples in the
    predicted cell, row and column; a true place outside the nine is never right, but in `cell_clipped`, where outer
    columns and rows have no end. `one_against_rest` is the mean, over the nine cells, of the share of samples that are
    rightly said to be in that cell or not: a wrong cell costs two ninths. `majority` is the most frequent true cell:
    what a constant prediction reaches. `own_lane` and `outside` are true places in the own column, and outside the nine
    cells.
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
    one_against_rest: float | None
    majority: float | None
    own_lane: float | None
    outside: float | None


@dataclass(frozen=True)
class ManeuverScore:
    """Scores of the forest's maneuvers, over all samples or one stratum. None: no such sample.

    `accuracy` is the share of samples whose most probable maneuver is the label, `recall` the same by label, `balanced`
    the mean of the recalls, `majority` the share of the most frequent label.
    """

    stratum: str
    n: int
    accuracy: float | None
    recall: dict[str, float | None]
    balanced: float | None
    majority: float | None


@dataclass(frozen=True)
class GridScores:
    """Scores of cells and maneuvers on one part, and the number of its samples that are not scored, by LEFT_OUT."""

    cells: list[CellScore]
    maneuvers: list[ManeuverScore]
    left_out: int
    left_out_by_reason: dict[str, int]


@dataclass(frozen=True)
class LearningPoint:
    """Scores on the evaluation part of a forest fitted on `drawn` examples, before augmentation.

    `lane` is the share of `n` samples whose lane at the last horizon is right; see `ManeuverScore` for the others.
    """

    drawn: int
    augmented: bool
    seed: int
    n: int
    accuracy: float | None
    balanced: float | None
    lane: float
    majority: float | None
