"""Clean tracks: the rows of `tracks` with other positions, and with all that follows from positions."""

from collections.abc import Mapping
from typing import Any

import polars as pl

from tracklake.pipeline.transforms.tracks.gaps import add_gaps
from tracklake.pipeline.transforms.tracks.kinematics import add_kinematics
from tracklake.schemas import TRACKS

KEY = ("vehicle_id", "frame")
MOTION = ("x_m", "y_m", "speed_mps", "accel_mps2", "lateral_speed_mps")
"""Columns of `tracks` that the new positions bring with them."""
FILLED = ("lane", "leader_id", "follower_id", "heading_rad")
"""Columns of `tracks` that an entry which fills a gap takes from the entries on both sides of the gap."""


def replace_positions(
    tracks: pl.DataFrame, motion: pl.DataFrame, vehicles: pl.DataFrame, facts: Mapping[str, Any]
) -> pl.DataFrame:
    """Give one subset's tracks other positions, and compute all columns that follow from positions again.

    Rows of `tracks` that `motion` lacks stay as recorded. Rows of `motion` that `tracks` lacks lie in a gap of a track
    and are added: leader and follower are those of both sides of the gap where these agree, lane and heading those of
    the nearer side in time. Recorded headways stay as recorded, and so do gaps of entries whose leader has no entry.

    Args:
        tracks: all columns of TRACKS, sorted by vehicle_id, frame, each pair once.
        motion: KEY and MOTION of the new entries, each pair once, of vehicles in `tracks`.
        vehicles: vehicle_id and length_m of the subset's vehicles.
        facts: frame_rate_hz and first_frame of the subset.

    Returns:
        The columns of TRACKS, sorted as `tracks`.
    """
    moved = motion.select(*KEY, *(pl.col(name).alias(f"new_{name}") for name in MOTION))
    entries = (
        tracks.lazy()
        .join(moved.lazy(), on=KEY, how="left", maintain_order="left")
        .with_columns(pl.coalesce(pl.col(f"new_{name}").cast(TRACKS.dtypes[name]), name).alias(name) for name in MOTION)
        .select(tracks.columns)
        .collect()
    )
    added = motion.join(tracks, on=KEY, how="anti")
    if added.height:
        entries = pl.concat([entries, _fill_gaps(added, tracks, facts)], how="diagonal").sort(KEY)
    entries = add_kinematics(entries, facts["frame_rate_hz"]).rename({"gap_m": "recorded_gap_m"})
    entries = add_gaps(entries, vehicles, use_recorded_headway=False)
    entries = entries.with_columns(pl.coalesce("gap_m", "recorded_gap_m").alias("gap_m"))
    return entries.lazy().pipe(TRACKS.conform).collect()


def _fill_gaps(added: pl.DataFrame, tracks: pl.DataFrame, facts: Mapping[str, Any]) -> pl.DataFrame:
    """Return rows of `tracks` for entries that lie in gaps, with what the sides of each gap say."""
    known = tracks.select(*KEY, *FILLED, at=pl.col("frame"))
    rows = added.select(*KEY, *(pl.col(name).cast(TRACKS.dtypes[name]) for name in MOTION)).sort(KEY)
    before, after = (known.rename({name: f"{side}_{name}" for name in ("at", *FILLED)}) for side in ("before", "after"))
    rows = rows.join_asof(before, on="frame", by="vehicle_id", strategy="backward", check_sortedness=False)
    rows = rows.join_asof(after, on="frame", by="vehicle_id", strategy="forward", check_sortedness=False)
    frame = pl.col("frame")
    is_nearer_before = frame - pl.col("before_at") <= pl.col("after_at") - frame
    agreed = [
        pl.when(pl.col(f"before_{name}") == pl.col(f"after_{name}")).then(f"before_{name}").alias(name)
        for name in ("leader_id", "follower_id")
    ]
    nearer = [
        pl.when(is_nearer_before).then(f"before_{name}").otherwise(f"after_{name}").alias(name)
        for name in ("lane", "heading_rad")
    ]
    return rows.select(
        *(pl.lit(tracks[name][0]).cast(tracks.schema[name]).alias(name) for name in ("dataset", "subset")),
        *KEY,
        *MOTION,
        *agreed,
        *nearer,
        time_s=(frame - facts["first_frame"]) / facts["frame_rate_hz"],
    )
