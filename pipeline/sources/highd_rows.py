"""Rows of a highD tracks file that can be read but not be true beside the others: dropped, with a reason each."""

import numpy as np
import polars as pl

from tracklake.pipeline.sources.csv.raw_files import LINE
from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.pipeline.transforms.tracks.orientation import LOWER, UPPER
from tracklake.schemas import TRACKS

STRANGER = "vehicle without a row in tracksMeta"
DIRECTION = "drivingDirection"
LANE = "laneId is no lane of the vehicle's carriageway, nor beside it"
SPEED = "xVelocity is no speed on the vehicle's carriageway"

FEW = 0.01
"""Up to this share of rows may name unknown vehicles: damaged ids. More, and the files do not belong together."""


def split_conflicts(entries: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """The first row of every vehicle and frame in the order of lines, and the others, which contradict it.

    Args:
        entries: id, frame and LINE, sorted by id and frame.
    """
    conflicting = entries.select(
        ((pl.col("id") == pl.col("id").shift(1)) & (pl.col("frame") == pl.col("frame").shift(1))).fill_null(value=False)
    ).to_series()
    if not conflicting.any():
        return entries, entries.clear()
    entries = entries.sort("id", "frame", LINE)
    return entries.filter(~conflicting), entries.filter(conflicting)


def split_strangers(
    entries: pl.DataFrame, vehicles: pl.DataFrame, tracks_file: RawFile, vehicles_file: RawFile
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Rows of vehicles that tracksMeta knows, and those of others.

    Raises:
        SourceError: the others are more than a few.
    """
    strangers = entries.join(vehicles, on="id", how="anti")
    if strangers.is_empty():
        return entries, strangers
    if strangers.height > FEW * entries.height:
        first = strangers.row(0, named=True)
        raise SourceError(
            f"{tracks_file.name}, line {first[LINE]}: vehicle {first['id']} has no row in {vehicles_file.name} "
            f"({strangers['id'].n_unique()} such vehicles). The files do not belong together or one is cut short; "
            "restore the originals."
        )
    return entries.join(vehicles, on="id", how="semi", maintain_order="left"), strangers


def add_directions(entries: pl.DataFrame, vehicles: pl.DataFrame) -> pl.DataFrame:
    """Entries, sorted by id, with the drivingDirection of their vehicle."""
    runs = entries["id"].rle().struct.unnest()
    directions = runs.join(vehicles, left_on="value", right_on="id", how="left", maintain_order="left")
    of_entry = np.repeat(directions[DIRECTION].to_numpy(), runs["len"].to_numpy())
    return entries.with_columns(pl.Series(DIRECTION, of_entry))


def split_impossible(
    entries: pl.DataFrame, upper_lanes: int, lower_lanes: int
) -> tuple[pl.DataFrame, list[tuple[pl.DataFrame, str]]]:
    """Rows that may be true on their carriageway, and those that may not, each set with its reason.

    The lane must be one of the carriageway's, or the strip left or right of them (median, shoulder); the speed must lie
    within the bounds of `tracks`.

    Args:
        entries: laneId, xVelocity, drivingDirection.
        upper_lanes: of the upper carriageway, whose laneIds begin with 2 (1 is its shoulder).
        lower_lanes: of the lower carriageway.
    """
    direction = entries[DIRECTION].to_numpy()
    # The median stands between the carriageways with an id of its own: it is left of both.
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
