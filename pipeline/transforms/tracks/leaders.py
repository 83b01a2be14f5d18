"""Leaders, followers and lanes of entries for sources that record none."""

import polars as pl


def derive_lanes(offset_m: pl.Expr, width_m: float, lanes: int) -> pl.Expr:
    """Derive lanes, 1 leftmost, from the distance to the left edge of the leftmost lane; null beside all lanes."""
    lane = (offset_m / width_m).floor().cast(pl.Int32) + 1
    return pl.when(lane.is_between(1, lanes)).then(lane.cast(pl.Int16))


def derive_leaders(entries: pl.DataFrame) -> pl.DataFrame:
    """Add leader_id and follower_id: the nearest vehicle ahead and behind in the same lane and frame, however far.

    Of vehicles at the same place the one with the greater id is ahead. Entries without a lane neither have nor are
    leaders.

    `entries` have vehicle_id, frame, lane, x_m of one subset, in any order, which is kept.
    """
    order = entries.select(pl.arg_sort_by("frame", "lane", "x_m", "vehicle_id")).to_series()
    frame, lane = pl.col("frame"), pl.col("lane")
    together = (frame == frame.shift(-1)) & (lane == lane.shift(-1))
    found = (
        entries.select("frame", "lane", "vehicle_id")[order]
        .select(
            leader_id=pl.when(together).then(pl.col("vehicle_id").shift(-1)),
            follower_id=pl.when(together.shift(1)).then(pl.col("vehicle_id").shift(1)),
        )
        .with_columns(order.alias(_ROW))
        .sort(_ROW)
    )
    return entries.with_columns(found["leader_id"], found["follower_id"])


_ROW = "row"
