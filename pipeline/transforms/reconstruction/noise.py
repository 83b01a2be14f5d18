"""Estimates of the noise of recorded positions and of the weight of smoothness, per recording and coordinate.

Leaving single points out (generalised cross-validation) takes a tracker's noise for motion, because it is correlated
over about half a second. So blocks of BLOCK_S are left out, and the error of the smoothed track at the middle of each
block, with which hardly any recorded entry shares its noise, is compared for a range of weights (Burman, Chow and
Nolan 1994, A cross-validatory method for dependent data).

Noise that is correlated over longer than a block, as that of NGSIM is, looks like motion in this test. There the
weight is the least with which the smoothed jerk is not denser than that of drivers (JERK_DENSITY).
"""

from dataclasses import dataclass

import numpy as np

from tracklake.pipeline.transforms.reconstruction.smoothing import Series, make_penalty, smooth
from tracklake.schemas.arrays import Flags, Floats, Integers

BLOCK_S, PERIOD_S = 2.1, 5.4
"""Length of the blocks that are left out, and time from one to the next, in s."""
SHIFTS = 4
"""Ways to lay the blocks, so that each part of a track is left out once."""
MOST_HZ = 0.5
"""Highest cut-off frequency at which a weight is sought, in Hz: above it jerk could change its sign more than once a
second, which no driver does (Punzo, Borzacchiello and Ciuffo 2011)."""
LEAST_HZ = {"x_m": 0.15, "y_m": 0.25}
"""Lowest cut-off frequency by coordinate, in Hz. Lane changes are rare, so the estimate does not see them; they take
about 4 s (Thiemann, Treiber and Kesting 2008), and a lower frequency would cut them off."""
STEPS = 9
"""Weights that are compared."""
JERK_DENSITY = 0.3
"""Power density of drivers' jerk up to the cut-off frequency, in (m/s3)2/Hz: that of I-80 as re-extracted by Coifman
and Li (2017), 0.2 to 0.4; simulated traffic has 0.02 to 0.3."""
SAMPLE_POINTS = 60_000
"""Points of the pieces that the estimates are made from."""
CLIP = 4.0
"""Errors, in standard deviations, beyond which they count no more: jumps between cameras are no noise."""
NORMAL_MAD = 1.4826
"""Standard deviation of normal noise per median absolute deviation."""


@dataclass(frozen=True)
class Noise:
    """Noise of one coordinate and the weight of smoothness that suits it.

    Args:
        noise_m: standard deviation of the recorded positions' noise.
        weight_s6: weight of the squared third derivative.
    """

    noise_m: float
    weight_s6: float


def compute_weight(cutoff_hz: float) -> float:
    """Return the weight with which the smoother halves motions of a frequency: (2 pi f)^-6, in s6."""
    return float((2 * np.pi * cutoff_hz) ** -6)


def compute_cutoff(weight_s6: float) -> float:
    """Return the frequency that the smoother halves, in Hz; the inverse of `compute_weight`."""
    return float(weight_s6 ** (-1 / 6) / (2 * np.pi))


def estimate_noise(
    series: Series,
    z: Floats,
    known: Flags,
    noise_m: float | None,
    weight_s6: float | None,
    least_hz: float,
) -> Noise:
    """Estimate what is None of the noise and the weight; a set noise scales the estimated weight by its square.

    Args:
        series: the pieces that `draw_pieces` has drawn.
        z: (N,) positions, recorded or interpolated in gaps.
        known: (N,) which of them were recorded.
        noise_m: the noise, where it is set.
        weight_s6: the weight, where it is set.
        least_hz: lowest cut-off frequency.
    """
    ratio = (compute_weight(least_hz) / compute_weight(MOST_HZ)) ** (1 / (STEPS - 1))
    weights = compute_weight(MOST_HZ) * ratio ** np.arange(STEPS)
    estimated = _choose_weight(series, z, known, weights) if weight_s6 is None else weight_s6
    if noise_m is not None and weight_s6 is not None:
        return Noise(noise_m, weight_s6)
    found_m = _measure_noise(series, z, known, estimated)
    if noise_m is None:
        return Noise(found_m, estimated)
    scale = (noise_m / max(found_m, 1e-6)) ** 2
    return Noise(noise_m, float(np.clip(estimated * scale, weights[0] / 100, weights[-1] * 100)))


def draw_pieces(series: Series) -> Integers:
    """Return pieces of a subset, spread evenly over it, with about SAMPLE_POINTS points."""
    share = min(1.0, SAMPLE_POINTS / max(int(series.size.sum()), 1))
    wanted = max(1, int(len(series.size) * share))
    return np.unique(np.linspace(0, len(series.size) - 1, wanted).astype(np.int64))


def _choose_weight(series: Series, z: Floats, known: Flags, weights: Floats) -> float:
    """Return the weight whose left-out points are predicted best, and at least that of a driver's jerk."""
    losses, densities = np.empty(len(weights)), np.empty(len(weights))
    for place, weight in enumerate(weights):
        errors = _predict(series, z, known, float(weight))
        limit = CLIP * NORMAL_MAD * np.median(np.abs(errors)) if errors.size else 0.0
        losses[place] = np.mean(np.minimum(errors**2, limit**2)) if errors.size else 0.0
        densities[place] = _measure_jerk_density(series, z, known, float(weight))
    best = int(np.argmin(losses)) if losses.any() else STEPS // 2
    calm = np.flatnonzero(densities <= JERK_DENSITY)
    return float(weights[max(best, int(calm[0]) if calm.size else len(weights) - 1)])


def _predict(series: Series, z: Floats, known: Flags, weight_s6: float) -> Floats:
    """Return the errors at the middles of blocks that are left out."""
    penalty = make_penalty(series, weight_s6)
    place = np.arange(len(z)) - np.repeat(series.first, series.size)
    left = np.repeat(series.size, series.size) - 1 - place
    block, period = round(BLOCK_S * series.rate_hz), round(PERIOD_S * series.rate_hz)
    inner = (place >= block) & (left >= block)
    errors = []
    for shift in range(SHIFTS):
        phase = (place + shift * period // SHIFTS) % period
        held = (phase < block) & inner
        x = smooth(penalty, z, (known & ~held).astype(np.float64))
        errors.append((z - x)[held & known & (phase == block // 2)])
    return np.concatenate(errors)


def _measure_noise(series: Series, z: Floats, known: Flags, weight_s6: float) -> float:
    """Return the standard deviation of the noise: root of (residual * error at left-out points).

    With independent noise and single points left out, the mean of that product is the noise's variance exactly: the
    residual is (1 - h) times the error, h being the smoother's diagonal (Craven and Wahba 1979).
    """
    residual = (z - smooth(make_penalty(series, weight_s6), z, known.astype(np.float64)))[known]
    scale = NORMAL_MAD * float(np.median(np.abs(residual))) if residual.size else 0.0
    errors = _predict(series, z, known, weight_s6)
    if not errors.size:
        return scale
    return float(np.sqrt(scale * NORMAL_MAD * float(np.median(np.abs(errors)))))


def _measure_jerk_density(series: Series, z: Floats, known: Flags, weight_s6: float) -> float:
    """Return the median over pieces of the mean squared jerk of the smoothed track per Hz below the cut-off."""
    x = smooth(make_penalty(series, weight_s6), z, known.astype(np.float64))
    squared = np.zeros(len(x))
    squared[:-3] = (np.diff(x, 3) * series.rate_hz**3) ** 2 * series.lie_within(3)[:-3]
    mean = np.add.reduceat(squared, series.first) / (series.size - 3)
    return float(np.median(mean)) / compute_cutoff(weight_s6)
