"""Lane changes as events: when the lateral motion begins and ends, and the gaps in the target lane."""

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tracks.gaps import NO_LEADER
from tracklake.pipeline.transforms.traffic.scene import NO_LANE, Scene
from tracklake.schemas.arrays import Floats, Integers, bound_runs, find_run_starts

FLICKER_S = 2.0
"""Time within which a lane change that is taken back counts as none, in s, as in the rule `lane_flicker`."""
WINDOW_S = 1.0
"""Time over which the lateral speed is measured, in s: positions of NGSIM err by decimetres from frame to frame."""


def find_lane_changes(scene: Scene, *, lateral_mps: float) -> tuple[pl.DataFrame, dict[str, int]]:
    """Find the lane changes, and for each the run of entries that move its way by at least `lateral_mps`.

    The run holds the first entry in the new lane, or the one before; a drift slower than that has no run: it begins
    and ends at the crossing, and neither end is seen.

    Returns:
        Columns of `lane_change_events` without dataset and subset, sorted; and numbers of what is left out, by reason.
    """
    crossing, skipped = find_crossings(scene)
    before, lanes = crossing - 1, scene.lanes
    to_right = lanes[crossing] > lanes[before]
    first_of_piece, last_of_piece = bound_runs(scene.pieces)
    lateral = measure_lateral_speed(scene, first_of_piece, last_of_piece)
    way = np.where(lateral >= lateral_mps, 1, np.where(lateral <= -lateral_mps, -1, 0))
    first_of_run, last_of_run = bound_runs(4 * scene.pieces + way)
    wanted = np.where(to_right, 1, -1)
    moves = way[crossing] == wanted
    inside = np.where(moves, crossing, before)
    moves |= way[before] == wanted
    first = np.where(moves, first_of_run[inside], crossing)
    last = np.where(moves, last_of_run[inside], crossing)
    y_m, speed_mps, frames = scene.read("y_m"), scene.read("speed_mps"), scene.frames
    events = pl.DataFrame(
        {
            "vehicle_id": scene.ids[crossing],
            "crossing_frame": frames[crossing],
            "first_frame": frames[first],
            "last_frame": frames[last],
            "seconds": (frames[last] - frames[first]) / scene.rate_hz,
            "begin_seen": moves & (first > first_of_piece[crossing]),
            "end_seen": moves & (last < last_of_piece[crossing]),
            "from_lane": lanes[before],
            "to_lane": lanes[crossing],
            "direction": np.where(to_right, "right", "left"),
            "lateral_move_m": y_m[last] - y_m[first],
            "greatest_lateral_speed_mps": _find_greatest(np.abs(lateral), first, last),
            "speed_mps": speed_mps[crossing],
        }
    )
    return events.hstack(_describe_neighbors(scene, crossing).get_columns()), skipped


def find_crossings(scene: Scene) -> tuple[Integers, dict[str, int]]:
    """Find the rows of first entries in a new lane, of own vehicles; and numbers of what is left out, by reason.

    A stay of at most FLICKER_S between two stays in one and the same other lane is left out, with the changes into and
    out of it. So where a vehicle wavers between two lanes before it stays in the second, the last crossing counts.
    Changes while frames or lanes are missing cannot be timed.
    """
    lanes, ids = scene.lanes, scene.ids
    joined = scene.follows[:-1] & (lanes != NO_LANE)
    joined[1:] &= lanes[:-1] != NO_LANE
    piece = np.cumsum(~joined)
    starts = find_run_starts(piece * (np.int64(1) << 17) + lanes)
    entries = np.diff(starts, append=len(lanes))
    lane, own = lanes[starts], piece[starts]
    flickers = np.zeros(len(starts), bool)
    flickers[1:-1] = (own[:-2] == own[2:]) & (lane[:-2] == lane[2:]) & (entries[1:-1] <= FLICKER_S * scene.rate_hz)
    kept = np.flatnonzero(~flickers)
    changes = (own[kept][1:] == own[kept][:-1]) & (lane[kept][1:] != lane[kept][:-1])
    unseen = (ids[1:] == ids[:-1]) & ~scene.follows[1:-1] & (lanes[1:] != lanes[:-1]) & scene.own[1:]
    skipped = {
        "no_lane": int(((lanes == NO_LANE) & scene.own).sum()),
        "lane_flicker": int((flickers & scene.own[starts]).sum()),
        "lane_change_in_gap": int((unseen & (lanes[1:] != NO_LANE) & (lanes[:-1] != NO_LANE)).sum()),
    }
    crossing = starts[kept[1:][changes]]
    return crossing[scene.own[crossing]], skipped


def measure_lateral_speed(scene: Scene, first: Integers, last: Integers) -> Floats:
    """Measure lateral speeds over WINDOW_S around each entry, less at ends of tracks; 0 for a single entry.

    Args:
        scene: entries.
        first: first row of each entry's track without gaps.
        last: its last row.
    """
    reach = max(1, round(WINDOW_S / 2 * scene.rate_hz))
    row = np.arange(len(first))
    low, high = np.maximum(row - reach, first), np.minimum(row + reach, last)
    y_m = scene.read("y_m")
    speeds: Floats = (y_m[high] - y_m[low]) * scene.rate_hz / np.maximum(high - low, 1)
    return speeds


def _find_greatest(values: Floats, first: Integers, last: Integers) -> Floats:
    """Find the greatest value between two rows, both included, (R,)."""
    if not first.size:
        return np.empty(0)
    bounds = np.stack([first, last + 1], axis=1).ravel()
    greatest: Floats = np.maximum.reduceat(np.append(values, 0.0), bounds)[::2]
    return greatest


def _describe_neighbors(scene: Scene, crossing: Integers) -> pl.DataFrame:
    """Describe leaders and followers before and at each crossing, and the gaps at it."""
    followers = scene.tracks["follower_id"].fill_null(NO_LEADER).to_numpy()
    x_m = scene.read("x_m")
    ids = {
        f"{age}_{name}_id": others[row]
        for age, row in (("old", crossing - 1), ("new", crossing))
        for name, others in (("leader", scene.leaders), ("follower", followers))
    }
    row, is_present = scene.find_entries(followers[crossing], scene.frames[crossing])
    lag_m = np.where(is_present, x_m[crossing] - scene.lengths_m[crossing] - x_m[row], np.nan)
    gaps = {"lead_gap_m": scene.read("gap_m")[crossing], "lag_gap_m": lag_m.round(3)}
    named = pl.DataFrame(ids).with_columns(pl.all().replace(NO_LEADER, None))
    return named.hstack(pl.DataFrame(gaps).with_columns(pl.all().fill_nan(None)).get_columns())
