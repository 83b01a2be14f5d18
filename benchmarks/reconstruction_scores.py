"""Errors of smoothed tracks against the truth, per vehicle, and their intervals by a bootstrap over vehicles."""

from dataclasses import dataclass

import numpy as np
from reconstruction_methods import Motion, Runs

from tracklake.pipeline.transforms.reconstruction.bounds import limit_motion
from tracklake.pipeline.transforms.reconstruction.config import BOUNDS
from tracklake.schemas.arrays import Flags, Floats, Integers

DRAWS = 1_000
"""Number of times that vehicles are drawn for an interval."""
STILL_MPS3 = 0.01
"""Jerk that counts as none where changes of its sign are counted, in m/s3."""
SLACK = 1e-4
"""Excess over a bound that does not count, in m/s or m/s2: results are stored as 32-bit numbers."""
FROM_SHARE, TO_SHARE = 0.2, 0.8
"""Parts of its true way between which a vehicle's travel time is taken."""
LEAST_WAY_M = 20.0
"""Least distance over which a travel time is taken, in m."""
RMSE = ("position", "speed", "accel", "steady_accel", "gap", "travel_time")
"""Measures that are roots of mean squares."""


@dataclass(frozen=True)
class Scene:
    """Recorded entries with the truth, sorted by vehicle and frame, (rows,) each.

    Args:
        leader: row of the recorded leader in the same frame, -1 = none.
        vehicle: number of the vehicle, from 0.
        kind: place of the vehicle's class in BOUNDS.
        judged: whether the vehicle counts.
    """

    x: Floats
    recorded: Motion
    true: Motion
    steady_accel: Floats
    leader: Integers
    leader_length: Floats
    vehicle: Integers
    runs: Runs
    kind: Integers
    judged: Flags


@dataclass(frozen=True)
class Tally:
    """Sums and counts of each measure by vehicle, (vehicles,) each."""

    sums: dict[str, Floats]
    counts: dict[str, Floats]

    def rate(self, weights: Floats | None = None) -> dict[str, Floats]:
        """Compute each measure over vehicles, drawn as often as weights (draws, vehicles) say."""
        drawn = np.ones((1, len(next(iter(self.sums.values()))))) if weights is None else weights
        found = {}
        for name, sums in self.sums.items():
            with np.errstate(invalid="ignore", divide="ignore"):
                mean = drawn @ sums / (drawn @ self.counts[name])
            found[name] = np.sqrt(mean) if name in RMSE else mean
        return found


def add_tallies(tallies: list[Tally]) -> Tally:
    """Put the vehicles of several subsets together."""
    names = tallies[0].sums
    return Tally(
        {name: np.concatenate([each.sums[name] for each in tallies]) for name in names},
        {name: np.concatenate([each.counts[name] for each in tallies]) for name in names},
    )


def draw_weights(vehicles: int) -> Floats:
    """Draw how often each vehicle counts in each draw of the bootstrap."""
    return np.random.default_rng(0).multinomial(vehicles, np.full(vehicles, 1 / vehicles), DRAWS).astype(float)


def score_motion(motion: Motion, scene: Scene) -> Tally:
    """Compare a method's motion with the truth."""
    number = int(scene.vehicle.max()) + 1

    def add(values: Floats, rows: Integers | None = None) -> tuple[Floats, Floats]:
        of = scene.vehicle if rows is None else scene.vehicle[rows]
        return np.bincount(of, values, number), np.bincount(of, minlength=number).astype(float)

    led = np.flatnonzero((scene.leader >= 0) & scene.judged[scene.leader])
    gap, true_gap = (x[scene.leader[led]] - scene.leader_length[led] - x[led] for x in (motion.x, scene.true.x))
    limits = limit_motion(tuple(BOUNDS.values()), scene.kind, motion.speed)
    beyond = (motion.accel < -limits.braking_mps2 - SLACK) | (motion.accel > limits.accel_mps2 + SLACK)
    found = {
        "position": add((motion.x - scene.true.x) ** 2),
        "speed": add((motion.speed - scene.true.speed) ** 2),
        "accel": add((motion.accel - scene.true.accel) ** 2),
        "steady_accel": add((motion.accel - scene.steady_accel) ** 2),
        "gap": add((gap - true_gap) ** 2, led),
        "travel_time": _compare_travel_times(motion.x, scene, number),
        "jerk_changes": count_jerk_changes(motion.accel, scene),
        "overlaps": add(((gap < 0) & (true_gap >= 0)).astype(float), led),
        "backward": add((motion.speed < -SLACK).astype(float)),
        "out_of_bounds": add(beyond.astype(float)),
    }
    judged = np.bincount(scene.vehicle, scene.judged, number) > 0
    return Tally(
        {name: sums[judged] for name, (sums, _) in found.items()},
        {name: counts[judged] for name, (_, counts) in found.items()},
    )


def count_jerk_changes(accel: Floats, scene: Scene) -> tuple[Floats, Floats]:
    """Count changes of the jerk's sign by vehicle, and its seconds."""
    number = int(scene.vehicle.max()) + 1
    run = np.repeat(np.arange(len(scene.runs.begins)), scene.runs.lengths)
    jerk = np.diff(accel) * scene.runs.rate_hz
    moves = np.flatnonzero((np.diff(run) == 0) & (np.abs(jerk) > STILL_MPS3))
    sign = np.sign(jerk[moves])
    changes = (np.diff(sign) != 0) & (np.diff(run[moves]) == 0)
    counts = np.bincount(scene.vehicle[moves[1:][changes]], minlength=number).astype(float)
    return counts, np.bincount(scene.vehicle, minlength=number) / scene.runs.rate_hz


def _compare_travel_times(x: Floats, scene: Scene, number: int) -> tuple[Floats, Floats]:
    """Square the error of each vehicle's time between two cross sections, on its longest run."""
    sums, counts = np.zeros(number), np.zeros(number)
    for begin, length in zip(scene.runs.begins, scene.runs.lengths, strict=True):
        rows = slice(begin, begin + length)
        true = np.maximum.accumulate(scene.true.x[rows])
        way = true[-1] - true[0]
        if way < LEAST_WAY_M:
            continue
        sections = true[0] + np.array([FROM_SHARE, TO_SHARE]) * way
        times = [
            np.diff(np.interp(sections, np.maximum.accumulate(each), np.arange(length)))[0] / scene.runs.rate_hz
            for each in (true, x[rows])
        ]
        sums[scene.vehicle[begin]] += (times[1] - times[0]) ** 2
        counts[scene.vehicle[begin]] += 1
    return sums, counts
