"""Identities of vehicles: source ids that stand for several vehicles are split."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.tracks.continuity import Moves, link_tracks
from tracklake.schemas.arrays import Integers

INT32_MAX = 2**31 - 1
ROW = "row_of_entry"
TRACK = "track_of_entry"
FILLED = "filled_"
"""Prefix of constants whose nulls are filled from other entries of the id."""


@dataclass(frozen=True)
class Identified:
    """Entries with vehicle_id, leader_id, follower_id (null = none), sorted by vehicle_id, frame; and ids split."""

    entries: pl.DataFrame
    ids_split: int


def identify_vehicles(
    entries: pl.DataFrame,
    *,
    constants: Sequence[str],
    frame_rate_hz: float,
    announced: str | None = None,
    one_way: bool = True,
) -> Identified:
    """Give every vehicle of a subset an id of its own; no entry is dropped.

    A source id stands for as many vehicles as it has different sets of constants (announced frames, length, width,
    class: equal in all rows of one vehicle; a missing one is filled if the id's other rows agree on it). Within these,
    `pipeline.transforms.tracks.continuity` splits by motion: several entries in one frame, or a return to where the
    vehicle cannot have moved. An id whose vehicle may just have been out of sight stays one. The vehicle seen first
    keeps the source's id; the others get ids that are not used in the subset.

    A leader or follower with an id that was split is the vehicle of that id in the same frame: for a leader the
    nearest one ahead, for a follower the nearest one behind, in the same lane before another lane, and only if there
    is none, one on the other side. If no vehicle of that id has an entry in that frame, it is the only one whose first
    and last frame lie on either side of it, else null. An id that was not split is left as recorded. No vehicle is its
    own leader or follower: if an entry names its own id and no other vehicle has it, there is none.

    The entries have source_id, frame, x_m, y_m, speed_mps, lane, leader_source_id, follower_source_id (0 or null =
    none) and the constants, in any order (fastest if sorted by source_id and frame). `announced` is the constant with
    the number of entries of a vehicle. With `one_way` all vehicles drive towards larger x_m, and none leaves and comes
    back.
    """
    if not _is_sorted(entries):
        entries = entries.sort("source_id", "frame")
    ids = entries["source_id"].to_numpy()
    vehicle = ids
    split = pl.Series("source_id", [], entries.schema["source_id"])
    doubtful = _find_doubtful(entries, constants, announced, frame_rate_hz)
    if len(doubtful):
        tracked = entries.with_row_index(ROW).filter(pl.col("source_id").is_in(doubtful.implode()))
        tracked = _add_tracks(tracked, constants, announced, frame_rate_hz, one_way)
        vehicles, split = _assign_ids(tracked, entries)
        named = tracked.join(vehicles, on=TRACK, maintain_order="left")
        vehicle = ids.copy()
        vehicle[named[ROW].to_numpy()] = named["vehicle_id"].to_numpy()
    entries = entries.with_columns(pl.Series("vehicle_id", vehicle))
    entries = entries.with_columns(_select_other("leader"), _select_other("follower"))
    if len(split):
        entries = entries.with_columns(_resolve_role(entries, role, split) for role in ("leader", "follower"))
        entries = entries.sort("vehicle_id", "frame")
    return Identified(entries, len(split))


def _is_sorted(entries: pl.DataFrame) -> bool:
    ids, frames = entries["source_id"].to_numpy(), entries["frame"].to_numpy()
    return bool(np.all((ids[1:] > ids[:-1]) | ((ids[1:] == ids[:-1]) & (frames[1:] >= frames[:-1]))))


def _find_doubtful(
    entries: pl.DataFrame, constants: Sequence[str], announced: str | None, frame_rate_hz: float
) -> pl.Series:
    """Find source ids that may stand for more than one vehicle, by a cheap test of all entries."""
    ids, frames = entries["source_id"].to_numpy(), entries["frame"].to_numpy()
    same = ids[1:] == ids[:-1]
    step = np.where(same, frames[1:] - frames[:-1], 1)
    differs = pl.any_horizontal(pl.col(name).ne_missing(pl.col(name).shift(1)) for name in constants)
    found = same & (step == 0)
    if constants:
        found |= same & entries.select(differs)[1:].to_series().to_numpy()
    # The few entries after an absence are tested one by one.
    after = np.flatnonzero(step > 1) + 1
    if len(after):
        around = entries[np.stack([after - 1, after], axis=1).ravel()]
        moves = _build_moves(around, None, None, frame_rate_hz, one_way=True)
        first = np.arange(0, 2 * len(after), 2)
        found[after - 1] |= ~moves.are_reachable(first, first + 1)
    doubtful = pl.Series("source_id", ids[1:][found]).unique()
    if announced is None or not len(after):
        return doubtful
    absent = entries.filter(pl.col("source_id").is_in(pl.Series(ids[after]).unique().implode()))
    counts = absent.group_by("source_id").agg(pl.len().alias("entries"), pl.col(announced).max())
    too_many = counts.filter(pl.col("entries") >= 1.5 * pl.col(announced), pl.col(announced) > 0)
    return pl.concat([doubtful, too_many["source_id"]]).unique()


def _build_moves(
    entries: pl.DataFrame, group: Integers | None, announced: str | None, rate_hz: float, *, one_way: bool
) -> Moves:
    size = entries.height
    return Moves(
        group=np.zeros(size, np.int64) if group is None else group,
        frame=entries["frame"].to_numpy().astype(np.int64),
        x_m=entries["x_m"].to_numpy(),
        y_m=entries["y_m"].to_numpy(),
        speed_mps=entries["speed_mps"].to_numpy(),
        announced=np.zeros(size, np.int64)
        if announced is None
        else entries[announced].fill_null(0).to_numpy().astype(np.int64),
        frame_rate_hz=rate_hz,
        one_way=one_way,
    )


def _add_tracks(
    entries: pl.DataFrame, constants: Sequence[str], announced: str | None, rate_hz: float, one_way: bool
) -> pl.DataFrame:
    """Sort entries of doubtful ids and add the track of each."""
    values = {name: pl.col(name).n_unique() - pl.col(name).has_nulls() for name in constants}
    filled = [
        pl.when(values[name].over("source_id") == 1)
        .then(pl.col(name).max().over("source_id"))
        .otherwise(pl.col(name))
        .alias(FILLED + name)
        for name in constants
    ]
    key = ["source_id", *(FILLED + name for name in constants)]
    rest = [name for name in entries.columns if name not in ("source_id", "frame", "x_m", ROW)]
    # Sorted by all columns, so that the given order does not matter.
    entries = entries.with_columns(filled).sort(*key, "frame", "x_m", *rest)
    changes = pl.any_horizontal(pl.col(name).ne_missing(pl.col(name).shift(1)) for name in key)
    group = entries.select(changes.cast(pl.Int64).cum_sum()).to_series().to_numpy()
    counted = None if announced is None else FILLED + announced
    track = link_tracks(_build_moves(entries, group, counted, rate_hz, one_way=one_way))
    return entries.with_columns(pl.Series(TRACK, track))


def _assign_ids(tracked: pl.DataFrame, entries: pl.DataFrame) -> tuple[pl.DataFrame, pl.Series]:
    """Assign a vehicle_id to each track; also return the source ids that have several."""
    vehicles = (
        tracked.with_row_index("position")
        .group_by(TRACK)
        .agg(pl.col("source_id").first(), first=pl.col("frame").min(), position=pl.col("position").min())
        .sort("source_id", "first", "position")
        .with_columns(later=~pl.col("source_id").is_first_distinct())
    )
    extra = vehicles.filter("later")
    split = extra["source_id"].unique()
    known = vehicles.filter(~pl.col("later")).select(TRACK, vehicle_id="source_id")
    if extra.is_empty():
        return known, split
    return pl.concat([known, extra.select(TRACK, _find_unused_ids(entries, extra.height).alias("vehicle_id"))]), split


def _find_unused_ids(entries: pl.DataFrame, count: int) -> pl.Series:
    used = np.concatenate(
        [
            entries[name].drop_nulls().unique().to_numpy()
            for name in ("source_id", "leader_source_id", "follower_source_id")
        ]
    )
    highest = int(used.max())
    if highest + count <= INT32_MAX:
        return pl.Series(np.arange(highest + 1, highest + 1 + count, dtype=np.int32))
    return pl.Series(np.setdiff1d(np.arange(1, used.size + count + 1), used)[:count].astype(np.int32))


def _select_other(role: str) -> pl.Expr:
    """Select the id that an entry names as its leader or follower, unless it is none or its own."""
    named = pl.col(f"{role}_source_id")
    return pl.when((named != 0) & (named != pl.col("source_id"))).then(named).alias(f"{role}_id")


def _resolve_role(entries: pl.DataFrame, role: str, split: pl.Series) -> pl.Series:
    """Replace leader or follower ids that were split by the id of the vehicle that is meant."""
    source, sign = f"{role}_source_id", 1 if role == "leader" else -1
    several = entries.filter(pl.col("source_id").is_in(split.implode()))
    present = several.select("frame", "lane", "x_m", pl.col("source_id").alias(source), named="vehicle_id")
    ahead = sign * (pl.col("x_m_right") - pl.col("x_m"))
    naming = entries.with_row_index(ROW).select(ROW, "frame", "lane", "x_m", "vehicle_id", source)
    naming = naming.filter(pl.col(source).is_in(split.implode()))
    is_other = pl.col("named") != pl.col("vehicle_id")
    candidates = (
        naming.join(present, on=["frame", source])
        .filter(is_other)
        .select(
            ROW,
            "named",
            wrong_side=ahead <= 0,
            other_lane=pl.col("lane").ne_missing(pl.col("lane_right")),
            away_m=ahead.abs(),
        )
        .sort(ROW, "wrong_side", "other_lane", "away_m", "named")
        .unique(ROW, keep="first", maintain_order=True)
    )
    spans = several.group_by(pl.col("source_id").alias(source), pl.col("vehicle_id").alias("named")).agg(
        first=pl.col("frame").min(), last=pl.col("frame").max()
    )
    missing = (
        naming.join(candidates, on=ROW, how="anti")
        .join(spans, on=source)
        .filter(is_other, pl.col("frame").is_between("first", "last"))
        .filter(pl.len().over(ROW) == 1)
    )
    return (
        entries[f"{role}_id"]
        .scatter(naming[ROW], None)
        .scatter(candidates[ROW], candidates["named"])
        .scatter(missing[ROW], missing["named"])
    )
