"""Lane changes predicted by a random forest, and cells of a grid around each vehicle (Choi et al. 2021).

- `labels`: keeping, left and right, from the tracks' lanes; they use the future.
- `features`: what a target's history tells, and the choice of those features that correlate with the labels.
- `examples`: samples of four strata, drawn evenly; mirrored and shifted copies.
- `forest`: fitted by scikit-learn, stored by skops.
- `cells`, `grid`: nine cells around the constant-velocity place, and how often models predict the right one.
- `learning_curve`: scores by number of examples.

Source: Choi, Yim, Baek and Lee 2021, Machine Learning-Based Vehicle Trajectory Prediction Using V2V Communications and
On-Board Sensors, Electronics 10(4), 420, https://doi.org/10.3390/electronics10040420.
"""

from tracklake.training.lane_changes.forest import ForestError, LaneForest, fit_lane_forest
from tracklake.training.lane_changes.grid import GridScores, evaluate_grid
from tracklake.training.lane_changes.learning_curve import learn_curve
from tracklake.training.lane_changes.settings import LaneForestSettings

__all__ = [
    "ForestError",
    "GridScores",
    "LaneForest",
    "LaneForestSettings",
    "evaluate_grid",
    "fit_lane_forest",
    "learn_curve",
]
