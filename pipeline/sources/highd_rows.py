"""Rows of a highD tracks file that contradict the metadata: dropped, with a reason each."""

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tracks.orientation import LOWER, UPPER
from tracklake.schemas import TRACKS

DIRECTION = "drivingDirection"
"""Column of tracksMeta with the vehicle's carriageway."""
LANE = "laneId is no lane of the vehicle's carriageway, nor beside it"
SPEED = "xVelocity is no speed on the vehicle's carriageway"


def add_directions(entries: pl.DataFrame, vehicles: pl.DataFrame) -> pl.DataFrame:
    """Add their vehicle's drivingDirection to entries, which are sorted by id."""
    runs = entries["id"].rle().struct.unnest()
    directions = runs.join(vehicles, left_on="value", right_on="id", how="left", maintain_order="left")
    of_entry = np.repeat(directions[DIRECTION].to_numpy(), runs["len"].to_numpy())
    return entries.with_columns(pl.Series(DIRECTION, of_entry))


def split_impossible(
    entries: pl.DataFrame, upper_lanes: int, lower_lanes: int
) -> tuple[pl.DataFrame, list[tuple[pl.DataFrame, str]]]:
    """Split rows that are possible on their carriageway from the others, which come in sets with a reason each.

    The lane must be one of the carriageway's or the strip left or right of them (median, shoulder); the speed must lie
    within the bounds of `tracks`.

    `entries` have laneId, xVelocity and drivingDirection. The laneIds of the upper lanes begin with 2 (1 is the
    shoulder).
    """
    direction = entries[DIRECTION].to_numpy()
    # The median has an id of its own between the carriageways: it is left of both.
    median = upper_lanes + 2
    first = np.where(direction == UPPER, 1, median)
    last = np.where(direction == UPPER, median, median + lower_lanes + 1)
    sign = np.where(direction == LOWER, 1, -1)
    slowest, fastest = TRACKS.bounds["speed_mps"]
    lane_ids, speeds = entries["laneId"].to_numpy(), entries["xVelocity"].to_numpy() * sign
    no_lane = (lane_ids < first) | (lane_ids > last)
    no_speed = ~no_lane & ((speeds < slowest) | (speeds > fastest))
    if not (no_lane.any() or no_speed.any()):
        return entries, []
    dropped = [(entries.filter(no_lane), LANE), (entries.filter(no_speed), SPEED)]
    return entries.filter(~(no_lane | no_speed)), dropped
