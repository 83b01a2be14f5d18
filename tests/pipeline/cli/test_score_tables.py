"""Lines that tell what was fitted, by hand."""

import pytest

from tracklake.pipeline.cli.score_tables import describe_fit
from tracklake.training.models.fitting import Fit

KALMAN = {"measurement_lateral_m": 0.25, "acceleration_lateral_m2ps3": 2.0}


@pytest.mark.parametrize(
    ("fit", "line"),
    [
        (
            Fit("kalman-cv", 1200, KALMAN, ["measurement_lateral_m"]),
            "kalman-cv: acceleration_lateral_m2ps3 = 2, fitted on 1,200 samples of `train`; "
            "measurement_lateral_m = 0.25, set, not fitted",
        ),
        (
            Fit("kalman-cv", 12, KALMAN, [], ["measurement_lateral_m"]),
            "kalman-cv: measurement_lateral_m = 0.25 (bound of the search), acceleration_lateral_m2ps3 = 2, "
            "fitted on 12 samples of `train`",
        ),
        (
            Fit("damped-velocity", 0, {"decay_s": 1.0}, []),
            "damped-velocity: decay_s = 1, not fitted: `train` has no samples",
        ),
    ],
)
def test_a_line_tells_what_was_fitted_and_what_was_set(fit, line):
    assert describe_fit(fit) == line
