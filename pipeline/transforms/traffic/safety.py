"""Surrogate measures of safety: runs of entries beyond a threshold, by follower and leader."""

from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.tracks.gaps import NO_LEADER
from tracklake.pipeline.transforms.traffic.scene import NO_LANE, Scene, measure_ttc
from tracklake.schemas.arrays import Flags, Floats, Integers, bound_runs, expand_ranges

MAXIMA = ("drac_mps2",)
"""Measures that are critical above their threshold; the others are below it."""


def find_exposures(
    scene: Scene, changes: pl.DataFrame, *, thresholds: Mapping[str, float]
) -> tuple[pl.DataFrame, dict[str, int]]:
    """Find the runs of consecutive entries with the same leader that are beyond a threshold.

    Args:
        scene: entries.
        changes: lane changes, columns of `lane_change_events`.
        thresholds: threshold of each of MEASURES.

    Returns:
        Columns of `safety` without dataset and subset, sorted; and numbers of what is left out, by reason.
    """
    row, is_present = scene.leader_rows
    lanes, has_leader = scene.lanes, scene.leaders != NO_LEADER
    known = (lanes != NO_LANE) & (lanes[row] != NO_LANE)
    elsewhere = is_present & known & (lanes != lanes[row])
    used = is_present & ~elsewhere
    gap_m = np.where(used, scene.read("gap_m"), np.nan)
    runs = [_find_runs(scene, name, values, thresholds[name]) for name, values in _measure(scene, used, gap_m).items()]
    runs.append(_find_encroachments(scene, changes, thresholds["pet_s"]))
    own = scene.own
    skipped = {
        "no_leader_known": 0 if scene.has_leaders else int(own.sum()),
        "leader_absent": int((has_leader & ~is_present & own).sum()),
        "leader_in_other_lane": int((elsewhere & own).sum()),
        "no_gap": int((used & np.isnan(gap_m) & own).sum()),
    }
    return join_exposures(runs), skipped


def join_exposures(runs: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Join the runs of several measures, or of several scenes, each once.

    Two vehicles that change into one lane at one frame are each other's second and first: once is enough.
    """
    key = ("vehicle_id", "leader_id", "measure", "first_frame")
    return pl.concat(runs).sort(*key, "worst").unique(key, keep="first", maintain_order=True)


def _measure(scene: Scene, used: Flags, gap_m: Floats) -> dict[str, Floats]:
    """Measure each entry with its leader at the same frame; NaN where a measure is undefined."""
    x_m, speed_mps, row = scene.read("x_m"), scene.read("speed_mps"), scene.leader_rows[0]
    ahead_m = x_m[row] - x_m
    closing_mps = np.where(used, speed_mps - speed_mps[row], np.nan)
    nothing = np.full(len(used), np.nan)
    closes = (gap_m > 0) & (closing_mps > 0)
    return {
        "ttc_s": measure_ttc(gap_m, closing_mps),
        "drac_mps2": np.divide(closing_mps**2, 2 * gap_m, out=nothing.copy(), where=closes),
        "time_headway_s": np.divide(ahead_m, speed_mps, out=nothing, where=used & (ahead_m > 0) & (speed_mps > 0)),
    }


def _find_runs(scene: Scene, measure: str, values: Floats, threshold: float) -> pl.DataFrame:
    """Find the runs of entries of one follower and leader whose value is beyond the threshold."""
    upwards = measure in MAXIMA
    beyond = values > threshold if upwards else values < threshold
    goes_on = np.zeros(len(values) + 1, bool)
    goes_on[1:-1] = scene.follows[1:-1] & beyond[1:] & beyond[:-1] & (scene.leaders[1:] == scene.leaders[:-1])
    beyond &= scene.own
    first, last = np.flatnonzero(beyond & ~goes_on[:-1]), np.flatnonzero(beyond & ~goes_on[1:])
    within = values[beyond]
    starts = np.cumsum(last - first + 1) - (last - first + 1)
    worst = (np.maximum if upwards else np.minimum).reduceat(within, starts) if starts.size else within
    return _make_rows(scene, measure, threshold, (scene.leaders[first], first, last), worst)


def _make_rows(
    scene: Scene, measure: str, threshold: float, runs: tuple[NDArray[np.integer], Integers, Integers], worst: Floats
) -> pl.DataFrame:
    """Make rows of `safety` of runs of entries, which are leaders, first and last rows."""
    leader, first, last = runs
    entries = last - first + 1
    return pl.DataFrame(
        {
            "vehicle_id": scene.ids[first],
            "leader_id": leader,
            "first_frame": scene.frames[first],
            "last_frame": scene.frames[last],
            "entries": entries,
            "seconds": entries / scene.rate_hz,
            "worst": worst,
        }
    ).with_columns(measure=pl.lit(measure), threshold=pl.lit(threshold))


def _find_encroachments(scene: Scene, changes: pl.DataFrame, threshold_s: float) -> pl.DataFrame:
    """Find the post-encroachment times of lane changes below the threshold, at the frames of the crossings.

    At its first entry in the new lane the vehicle's rear leaves a place that the new follower's front reaches later,
    and its front enters one that the new leader's rear has left.
    """
    events = changes.select("vehicle_id", "crossing_frame", "new_leader_id", "new_follower_id")
    who, frame, leader, follower = (events[name].fill_null(NO_LEADER).to_numpy() for name in events.columns)
    own, _ = scene.find_entries(who, frame)
    front_m, length_m = scene.read("x_m"), scene.lengths_m
    behind, has_follower = scene.find_entries(follower, frame)
    ahead, has_leader = scene.find_entries(leader, frame)
    steps = int(np.ceil(threshold_s * scene.rate_hz))
    lag_s = _time_passages(scene, front_m, front_m[own] - length_m[own], behind, steps)
    lead_s = _time_passages(scene, front_m - length_m, front_m[own], ahead, -steps)
    lag, lead = has_follower & (lag_s < threshold_s), has_leader & (lead_s < threshold_s)
    seconds = np.concatenate([lag_s[lag], lead_s[lead]])
    second = np.concatenate([behind[lag], own[lead]])
    first = np.concatenate([who[lag], leader[lead]])
    return _make_rows(scene, "pet_s", threshold_s, (first, second, second), seconds)


def _time_passages(scene: Scene, positions_m: Floats, place_m: Floats, row: Integers, steps: int) -> Floats:
    """Measure the time from each row to the moment at which its vehicle passes a place, (R,); NaN where it does not.

    Positions are linear between entries; frames that are missing end the search.

    Args:
        scene: entries.
        positions_m: position of each entry, (N,).
        place_m: a place for each of the rows, (R,).
        row: rows to start at.
        steps: number of entries to search; negative to search back, for who was before the place and now is beyond it.
    """
    way = 1 if steps > 0 else -1
    first, last = bound_runs(scene.pieces)
    reach = np.minimum(last[row] - row if way > 0 else row - first[row], abs(steps))
    offset, owner = expand_ranges(np.ones(len(row), np.int64), reach)
    here = row[owner] + way * offset
    place, now, before = place_m[owner], positions_m[here], positions_m[here - way]
    passes = (before < place) & (now >= place) if way > 0 else (before > place) & (now <= place)
    hit = np.flatnonzero(passes)
    event, at = np.unique(owner[hit], return_index=True)
    hit = hit[at]
    seconds = np.full(len(row), np.nan)
    seconds[event] = (offset[hit] - 1 + (place[hit] - before[hit]) / (now[hit] - before[hit])) / scene.rate_hz
    return seconds
