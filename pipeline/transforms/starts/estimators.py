"""Estimators of the length of a track's missing start, for many cut tracks at once.

An estimator takes a `Cut` and returns an estimate and a margin in frames, (B,) each; the window begins
max(1, estimate) + margin frames before the start. The contract is DESIGN section 6.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tracklake.pipeline.transforms.starts.late_starts import LEAST_REFERENCES, SIGMAS
from tracklake.schemas.arrays import Flags, Floats, Integers

NEAREST = 10
"""References of `estimate_locally`. Its three constants were chosen on generated data alone (`tracklake sample
--minutes 2 --seed 11`), so that no recording that it is measured on has a part in them: of 10, 12, 16, 20 and 30
references, 0, 10 and 30 s, and 2, 2.5 and 3 errors, those with the least excess. All cover at least 0.9994 of the
missing time there."""
LANE_APART_S = 10.0
"""Time that a lane between two vehicles counts as in `estimate_locally`, in s."""
ERRORS = 2.0
"""Margin of `estimate_locally` in standard errors of prediction."""


@dataclass(frozen=True)
class Cut:
    """B tracks cut at one position, and the drives of R fully tracked vehicles, of which a track's own is unknown.

    Unknown lanes are NaN.

    Args:
        start_frame: (B,) frame of the first entry left.
        speed_mps: (B,) speed of that entry.
        by_mean_speed: (B,) frames from the cut-off to the start at the subset's mean speed.
        known: (B, R) whether the reference is another vehicle and reaches the start.
        frames: (B, R) frames from the cut-off to the start; 0 if not known.
        speeds_mps: (B, R) speed of the reference's entry nearest to the start.
        passed_frame: (B, R) frame at which the reference crossed the start.
    """

    start_frame: Integers
    speed_mps: Floats
    lane: Floats
    by_mean_speed: Floats
    known: Flags
    frames: Floats
    speeds_mps: Floats
    lanes: Floats
    passed_frame: Floats
    frame_rate_hz: float

    @cached_property
    def lines(self) -> "_Lines":
        """The contract's regressions over all references of each track, (B,)."""
        return _Lines.fit(self.known, self.speeds_mps, self.frames)

    @property
    def sigma(self) -> Floats:
        """Sample standard deviation of the references' frames, (B,); a quarter of the estimate for fewer than two."""
        variance = self.lines.variation / np.maximum(self.lines.n - 1, 1)
        return np.where(self.lines.n >= 2, np.sqrt(variance), self.by_mean_speed / 4)


Estimator = Callable[[Cut], tuple[Floats, Floats]]


@dataclass(frozen=True)
class _Lines:
    """Lines frames = b0 + b1 * speed, fitted by ordinary least squares to n points each; all arrays are (B,).

    The spread is the sum of squared offsets of the speeds (0 if they do not vary), the variation that of the frames,
    and the slope b1.
    """

    n: Integers
    mean_speed_mps: Floats
    mean_frames: Floats
    spread: Floats
    slope: Floats
    variation: Floats
    residual: Floats

    @classmethod
    def fit(cls, known: Flags, speeds_mps: Floats, frames: Floats) -> "_Lines":
        """Fit each row's line to its known points."""
        n = known.sum(axis=1)
        count = np.maximum(n, 1)
        mean_speed, mean_frames = ((values * known).sum(axis=1) / count for values in (speeds_mps, frames))
        speed_offset = np.where(known, speeds_mps - mean_speed[:, np.newaxis], 0.0)
        frames_offset = np.where(known, frames - mean_frames[:, np.newaxis], 0.0)
        slowest, fastest = (np.where(known, speeds_mps, limit) for limit in (np.inf, -np.inf))
        varies = fastest.max(axis=1, initial=-np.inf) > slowest.min(axis=1, initial=np.inf)
        # Offsets that are only rounding errors of a mean are no spread.
        spread = np.where(varies, (speed_offset**2).sum(axis=1), 0.0)
        products = (speed_offset * frames_offset).sum(axis=1)
        slope = np.divide(products, spread, out=np.zeros_like(spread), where=varies)
        residual = ((frames_offset - slope[:, np.newaxis] * speed_offset) ** 2 * known).sum(axis=1)
        return cls(n, mean_speed, mean_frames, spread, slope, (frames_offset**2).sum(axis=1), residual)

    def predict(self, speed_mps: Floats) -> Floats:
        """Predict the frames at one speed for each line."""
        return self.mean_frames + self.slope * (speed_mps - self.mean_speed_mps)

    def predict_error(self, speed_mps: Floats) -> Floats:
        """Compute the standard error s sqrt(1 + 1/n + (v - mean v)2 / spread), s2 = residual / (n - 2)."""
        offset = (speed_mps - self.mean_speed_mps) ** 2
        leverage = np.divide(offset, self.spread, out=np.zeros_like(offset), where=self.spread > 0)
        return np.sqrt(self.residual / np.maximum(self.n - 2, 1) * (1 + 1 / np.maximum(self.n, 1) + leverage))


def estimate_by_regression(cut: Cut) -> tuple[Floats, Floats]:
    """Estimate as the contract does: regression over all references, or the mean speed with fewer than 10."""
    enough = cut.lines.n >= LEAST_REFERENCES
    return np.where(enough, cut.lines.predict(cut.speed_mps), cut.by_mean_speed), SIGMAS * cut.sigma


def estimate_without_margin(cut: Cut) -> tuple[Floats, Floats]:
    """Estimate as the contract does, without a margin."""
    estimate, margin = estimate_by_regression(cut)
    return estimate, np.zeros_like(margin)


def estimate_locally(cut: Cut) -> tuple[Floats, Floats]:
    """Estimate by regression over the NEAREST references, with a margin of ERRORS standard errors of prediction.

    Nearest in time of passing the start; each lane between two vehicles counts as LANE_APART_S, an unknown lane as
    none. Where traffic slows down and recovers, the vehicles just before and after predict better than the whole
    recording, whose spread reflects the course of traffic rather than the uncertainty of one drive. If the contract
    uses the mean speed, this is the contract's estimate.
    """
    apart_s = np.abs(cut.passed_frame - cut.start_frame[:, np.newaxis]) / cut.frame_rate_hz
    lanes_apart = np.nan_to_num(np.abs(cut.lanes - cut.lane[:, np.newaxis]), nan=0.0)
    distance = np.where(cut.known, apart_s + LANE_APART_S * lanes_apart, np.inf)
    nearest = np.argpartition(distance, min(NEAREST, distance.shape[1]) - 1, axis=1)[:, :NEAREST]
    lines = _Lines.fit(
        np.take_along_axis(cut.known, nearest, axis=1),
        np.take_along_axis(cut.speeds_mps, nearest, axis=1),
        np.take_along_axis(cut.frames, nearest, axis=1),
    )
    estimate, margin = estimate_by_regression(cut)
    enough = cut.lines.n >= LEAST_REFERENCES
    return (
        np.where(enough, lines.predict(cut.speed_mps), estimate),
        np.where(enough, ERRORS * lines.predict_error(cut.speed_mps), margin),
    )


ESTIMATES: Mapping[str, Estimator] = {
    "regression": estimate_by_regression,
    "mean_speed": lambda cut: (cut.by_mean_speed, SIGMAS * cut.sigma),
    "no_margin": estimate_without_margin,
    "local_regression": estimate_locally,
}
"""Estimators by their names in `schemas.start_assessments.ESTIMATORS`."""
