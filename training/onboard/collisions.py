"""Collision warnings, the outlook of Choi et al. (2021): predicted cells of the ego and of a vehicle overlap.

Two vehicles' cells overlap at a tick where the vehicle's centre is less than half a lane to the side of the ego's, and
the space between their bodies along the road is shorter than they approach in a second, 1 m at least. The true future
is judged by the same rule, with the same approach.
"""

from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Flags, Integers, Singles
from tracklake.schemas.protocols import V2V
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.lane_changes.cells import measure_rows
from tracklake.training.onboard.models import Forecaster, predict_places
from tracklake.training.onboard.samples import FEATURE_NUMBER, Samples

NEVER = 0
"""Tick ahead of an overlap that does not come within the horizon."""


@dataclass(frozen=True)
class WarningScore:
    """Warnings of one model against the truth, over n samples (a vehicle at a moment) of so many trajectories.

    `warned` and `true` are samples with an overlap predicted, and coming, within the horizon; `hits` are both, `missed`
    only true, `false` only warned. `warnings` are runs of warned samples of a trajectory without one in between that is
    not, `warnings_per_hour` by the time that vehicles were near. `median_time_s` is the predicted time to the overlap.
    `median_lead_s` is the time from the first hit before a trajectory's first overlap to that overlap. None: no such.
    """

    model: str
    n: int
    trajectories: int
    warned: int
    true: int
    hits: int
    missed: int
    false: int
    warnings: int
    warnings_per_hour: float | None
    median_time_s: float | None
    median_lead_s: float | None


def find_overlaps(samples: Samples, place_m: Singles) -> Integers:
    """Find the first tick ahead, from 1, at which cells overlap: (B,) of places (B, F, 2); NEVER where none does."""
    last_x = samples.feature[:, -1, FEATURE_NUMBER["rel_x_m"]]
    approach = np.maximum(0, -np.sign(last_x) * samples.velocity_mps[:, 0])
    row_m = measure_rows(approach, np.ones(len(samples)))[:, None]
    bodies_m = (samples.size_m[:, :1] + samples.ego_size_m[:, :1]) / 2
    overlaps = (np.abs(place_m[..., 1]) < NOMINAL_LANE_M / 2) & (np.abs(place_m[..., 0]) - bodies_m < row_m)
    return np.where(overlaps.any(axis=1), overlaps.argmax(axis=1) + 1, NEVER)


def score_warnings(model: Forecaster, samples: Samples) -> WarningScore:
    """Compare the warnings of a model with the overlaps of the true future."""
    own = find_overlaps(samples, predict_places(model.name, model.predict, samples))
    return compare_overlaps(model.name, samples, own, find_overlaps(samples, samples.place_m))


def compare_overlaps(name: str, samples: Samples, own: Integers, true: Integers) -> WarningScore:
    """Compare first overlapping ticks as predicted and as they come, (B,) each."""
    warned, comes, trajectory = own > NEVER, true > NEVER, samples.trajectory
    hits = warned & comes
    warnings = int(_find_beginnings(trajectory, samples.tick, warned).sum())
    hours = len(samples) * V2V.step_s / 3600
    lead = _measure_leads(trajectory, samples.tick, hits, np.where(comes, samples.tick + true, np.iinfo(np.int64).max))
    return WarningScore(
        model=name,
        n=len(samples),
        trajectories=len(np.unique(trajectory)),
        warned=int(warned.sum()),
        true=int(comes.sum()),
        hits=int(hits.sum()),
        missed=int((comes & ~warned).sum()),
        false=int((warned & ~comes).sum()),
        warnings=warnings,
        warnings_per_hour=warnings / hours if hours else None,
        median_time_s=float(np.median(own[warned])) / V2V.rate_hz if warned.any() else None,
        median_lead_s=float(np.median(lead)) / V2V.rate_hz if len(lead) else None,
    )


def _find_beginnings(trajectory: Integers, tick: Integers, warned: Flags) -> Flags:
    """Find samples that are warned of while the sample of their trajectory before was not, or was not one step ago."""
    follows = np.zeros(len(tick), dtype=np.bool_)
    follows[1:] = (np.diff(trajectory) == 0) & (np.diff(tick) == V2V.step_ticks) & warned[:-1]
    return warned & ~follows


def _measure_leads(trajectory: Integers, tick: Integers, hits: Flags, overlap: Integers) -> Integers:
    """Measure the ticks from the first hit of each trajectory to its first overlap; (E,), of those with such a hit."""
    number = int(trajectory.max(initial=-1)) + 1
    most = np.iinfo(np.int64).max
    first_overlap, first_hit = np.full(number, most), np.full(number, most)
    np.minimum.at(first_overlap, trajectory, overlap)
    np.minimum.at(first_hit, trajectory[hits], tick[hits])
    found = first_hit < first_overlap
    leads: Integers = (first_overlap - first_hit)[found & (first_overlap < most)]
    return leads
