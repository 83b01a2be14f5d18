"""Episodes of car following: runs of entries behind one leader in one lane, how they begin and end, and regimes."""

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.tracks.gaps import NO_LEADER
from tracklake.pipeline.transforms.traffic.scene import NO_LANE, Scene, measure_ttc
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.traffic import REGIMES

STANDING_MPS = 0.1
"""Highest speed of the regime `standing`, in m/s: SUMO's bound of a halting vehicle."""
FREE_HEADWAY_S = 6.0
"""Time headway beyond which the leader no longer matters, in s (Vogel 2002)."""
STEADY_MPS2 = 0.2
"""Greatest acceleration, in either direction, of the regimes of steady speed, in m/s2."""


def find_episodes(scene: Scene, *, min_s: float) -> tuple[pl.DataFrame, dict[str, int]]:
    """Find the episodes of car following that last `min_s` or longer.

    An entry belongs to an episode if its recorded leader has an entry at the same frame in the same lane. An episode
    goes on to the next frame as long as follower, leader and lane are the same and no frame is missing.

    Returns:
        Columns of `car_following` without dataset and subset, sorted; and numbers of what is left out, by reason.
    """
    row, is_present = scene.leader_rows
    has_lane = scene.lanes != NO_LANE
    has_leader = scene.leaders != NO_LEADER
    together = is_present & has_lane
    together[together] = scene.lanes[together] == scene.lanes[row[together]]
    goes_on = np.zeros(len(together) + 1, bool)
    goes_on[1:-1] = (
        scene.follows[1:-1]
        & together[1:]
        & together[:-1]
        & (scene.leaders[1:] == scene.leaders[:-1])
        & (scene.lanes[1:] == scene.lanes[:-1])
    )
    first = np.flatnonzero(together & ~goes_on[:-1])
    last = np.flatnonzero(together & ~goes_on[1:])
    seconds = (scene.frames[last] - scene.frames[first]) / scene.rate_hz
    own = scene.own
    kept = (seconds >= min_s) & own[first]
    skipped = {
        "no_lane": int((~has_lane & own).sum()),
        "no_leader_known": 0 if scene.has_leaders else int(own.sum()),
        "leader_absent": int((has_leader & has_lane & ~is_present & own).sum()),
        "leader_in_other_lane": int((is_present & has_lane & ~together & own).sum()),
        "short_episode": int((~kept & own[first]).sum()),
    }
    episodes = pl.DataFrame(
        {
            "vehicle_id": scene.ids[first],
            "leader_id": scene.leaders[first],
            "lane": scene.lanes[first],
            "first_frame": scene.frames[first],
            "last_frame": scene.frames[last],
            "entries": last - first + 1,
            "seconds": seconds,
            "begins_by": _name_boundaries(scene, first, -1),
            "ends_by": _name_boundaries(scene, last, 1),
        }
    ).with_columns(
        cut_in=(pl.col("begins_by") == "cut_in") | (pl.col("ends_by") == "cut_in"),
        cut_out=(pl.col("begins_by") == "leader_left") | (pl.col("ends_by") == "leader_left"),
    )
    measured = _measure(scene, np.flatnonzero(together), np.repeat(np.arange(len(first)), last - first + 1))
    return pl.concat([episodes, measured], how="horizontal").filter(pl.Series(kept)), skipped


def _name_boundaries(scene: Scene, edge: Integers, step: int) -> NDArray[np.str_]:
    """Name what makes each episode begin (`step` -1, edges are first entries) or end (1, last entries): BOUNDARIES."""
    leader_edge = scene.leader_rows[0][edge]
    later = max(step, 0)
    in_view = scene.follows[edge + later] & scene.follows[leader_edge + later]
    beyond = np.where(in_view, edge + step, edge)
    leader_beyond = np.where(in_view, leader_edge + step, leader_edge)
    lane, lane_beyond = scene.lanes[edge], scene.lanes[beyond]
    changed = (lane_beyond != lane) & (lane_beyond != NO_LANE)
    leader_lane = scene.lanes[leader_beyond]
    leader_moved = (leader_lane != lane) & (leader_lane != NO_LANE)
    other = scene.leaders[beyond]
    between = (other != NO_LEADER) & (other != scene.leaders[edge])
    between &= scene.find_lanes(other, scene.frames[beyond]) == lane
    between &= scene.find_lanes(other, scene.frames[edge]) != lane
    by_leader, by_other = ("cut_in", "leader_left") if step < 0 else ("leader_left", "cut_in")
    choices = [~in_view, changed, leader_moved, between]
    return np.asarray(np.select(choices, ["view", "lane_change", by_leader, by_other], "renamed"), np.str_)


def _measure(scene: Scene, entries: Integers, episode: Integers) -> pl.DataFrame:
    """Measure speeds, gaps, least time to collision and shares of regimes, one row per episode."""
    speed_mps, gap_m, x_m = (scene.read(name) for name in ("speed_mps", "gap_m", "x_m"))
    leader = scene.leader_rows[0][entries]
    closing_mps = speed_mps[entries] - speed_mps[leader]
    regimes = classify_regimes(speed_mps[entries], scene.read_acceleration()[entries], x_m[leader] - x_m[entries])
    known = pl.col("regime") >= 0
    return (
        pl.DataFrame(
            {
                "episode": episode,
                "regime": regimes,
                "speed_mps": speed_mps[entries],
                "gap_m": gap_m[entries],
                "ttc_s": measure_ttc(gap_m[entries], closing_mps),
            }
        )
        .with_columns(pl.col("gap_m", "ttc_s").fill_nan(None))
        .group_by("episode", maintain_order=True)
        .agg(
            *(
                (pl.col("regime") == number).filter(known).mean().alias(f"{regime}_share")
                for number, regime in enumerate(REGIMES)
            ),
            # Polars may add in another order on other machines, which changes the last digits.
            mean_speed_mps=pl.col("speed_mps").mean().round(6),
            mean_gap_m=pl.col("gap_m").mean().round(6),
            least_gap_m=pl.col("gap_m").min(),
            least_ttc_s=pl.col("ttc_s").min(),
        )
        .drop("episode")
    )


def classify_regimes(speed_mps: Floats, accel_mps2: Floats, spacing_m: Floats) -> NDArray[np.int8]:
    """Classify entries by driving regime, (N,): the number in REGIMES; -1 where the acceleration is unknown.

    Standing is decided first, so that it needs no acceleration. Free is an entry whose time headway, spacing / speed,
    exceeds FREE_HEADWAY_S; steady one whose acceleration is at most STEADY_MPS2 in either direction.

    Args:
        speed_mps: speed of the follower.
        accel_mps2: acceleration of the follower; NaN where it is unknown.
        spacing_m: distance from front to front.
    """
    free = spacing_m > FREE_HEADWAY_S * speed_mps
    chosen: dict[str, Flags] = {
        "standing": speed_mps <= STANDING_MPS,
        "decelerating": accel_mps2 < -STEADY_MPS2,
        "free_acceleration": free & (accel_mps2 > STEADY_MPS2),
        "accelerating": accel_mps2 > STEADY_MPS2,
        "cruising": free & (accel_mps2 <= STEADY_MPS2),
        "following": accel_mps2 <= STEADY_MPS2,
    }
    numbers = [REGIMES.index(name) for name in chosen]
    return np.asarray(np.select(list(chosen.values()), numbers, -1), np.int8)
