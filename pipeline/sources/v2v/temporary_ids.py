"""Temporary ids, which senders change every five minutes, linked to one vehicle where its motion leaves no doubt."""

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Integers

MAX_SILENCE_S = 2.0
"""Longest time between the last message with one id and the first with the next, in s."""
GATE_M = 5.0
"""Distance from the predicted position within which the next id must begin, in m; errors of positions last longer."""
GATE_GROWTH_MPS = 2.0
"""What the gate grows by in each second without a message, in m/s."""
MAX_SPEED_CHANGE_MPS = 3.0
"""Largest difference between the last speed and the first with the next id, in m/s."""
SIZE_TOLERANCE_M = 0.05
"""Largest difference between the sizes that a vehicle states, in m."""
CLEAR_RATIO = 2.0
"""A link is clear if the next candidate of either id is this many times as far."""
CELL_M = 200.0
"""Side of the squares in which candidates are looked for, in m; no vehicle crosses one in MAX_SILENCE_S."""
METRES_PER_DEGREE = 111_195.0
"""Metres in a degree of latitude."""
CELL = ("column", "row", "period")
"""What names a square in space and a period in time."""
NEIGHBORS = np.array([(east, north, later) for east in (-1, 0, 1) for north in (-1, 0, 1) for later in (0, 1)])
"""Steps to the squares around one, now and in the next MAX_SILENCE_S."""


def link_ids(units: pl.DataFrame) -> tuple[pl.Series, int]:
    """Link ids that follow one another.

    An id can be followed by one that begins within MAX_SILENCE_S after its last message, near to where the vehicle
    would be at the last speed and heading, as fast and as large. It is followed where each of the two is the other's
    nearest candidate and no other candidate of either comes near to that.

    Args:
        units: one row per id: `first_` and `last_` of utc_us, lat_deg, lon_deg, speed_mps and heading_deg, `length_m`,
            `width_m`, `messages`.

    Returns:
        for each row the row of its vehicle's first id, and the number of ids whose vehicle was in doubt.
    """
    rows = units.with_columns(unit=pl.int_range(pl.len(), dtype=pl.Int64))
    pairs = _find_candidates(rows)
    cost = pl.col("cost")
    judged = pairs.with_columns(
        is_nearest=(cost == cost.min().over("before")) & (cost == cost.min().over("after")),
        next_cost=pl.min_horizontal(cost.sort().get(1, null_on_oob=True).over(side) for side in ("before", "after")),
    )
    clear = judged.filter("is_nearest", (pl.col("next_cost") > CLEAR_RATIO * cost).fill_null(value=True))
    previous = np.arange(rows.height)
    previous[clear["after"].to_numpy()] = clear["before"].to_numpy()
    return pl.Series("first_unit", _follow(previous)), pairs["after"].n_unique() - clear.height


def _find_candidates(rows: pl.DataFrame) -> pl.DataFrame:
    """Return pairs of ids that may follow one another, `before` and `after`, with their distance in gates (`cost`)."""
    scale = float(np.cos(np.radians(rows["first_lat_deg"].to_numpy()).mean())) if rows.height else 1.0
    around = _locate(rows.filter(pl.col("messages") > 1), "last", scale).join(
        pl.DataFrame(NEIGHBORS, schema=[f"{name}_step" for name in CELL]), how="cross"
    )
    around = around.with_columns(pl.col(name) + pl.col(f"{name}_step") for name in CELL)
    pairs = around.join(_locate(rows, "first", scale), on=CELL, suffix="_after")
    silence_s = (pl.col("first_utc_us_after") - pl.col("last_utc_us")) / 1e6
    heading = pl.col("last_heading_deg").fill_null(0).cast(pl.Float64).radians()
    driven_m = pl.col("last_speed_mps").fill_null(0).cast(pl.Float64) * silence_s
    north_m = (pl.col("first_lat_deg_after") - pl.col("last_lat_deg")) * METRES_PER_DEGREE
    east_m = (pl.col("first_lon_deg_after") - pl.col("last_lon_deg")) * METRES_PER_DEGREE
    east_m = east_m * pl.col("last_lat_deg").radians().cos()
    apart_m = ((east_m - driven_m * heading.sin()) ** 2 + (north_m - driven_m * heading.cos()) ** 2).sqrt()
    possible = pairs.filter(
        silence_s.is_between(0, MAX_SILENCE_S, closed="right"),
        _agree("last_speed_mps", "first_speed_mps_after", MAX_SPEED_CHANGE_MPS),
        _agree("length_m", "length_m_after", SIZE_TOLERANCE_M),
        _agree("width_m", "width_m_after", SIZE_TOLERANCE_M),
    )
    cost = apart_m / (GATE_M + GATE_GROWTH_MPS * silence_s)
    return possible.select(before="unit", after="unit_after", cost=cost).filter(pl.col("cost") <= 1)


def _locate(rows: pl.DataFrame, end: str, scale: float) -> pl.DataFrame:
    """Add the square and the period in which each id begins (`first`) or ends (`last`).

    `scale` is the length of a degree of longitude, in degrees of latitude; for all the same one, so that squares agree.
    """
    squares = [
        (degrees * METRES_PER_DEGREE / CELL_M).floor().cast(pl.Int64)
        for degrees in (pl.col(f"{end}_lon_deg") * scale, pl.col(f"{end}_lat_deg"))
    ]
    period = pl.col(f"{end}_utc_us") // int(MAX_SILENCE_S * 1e6)
    return rows.with_columns(part.alias(name) for name, part in zip(CELL, (*squares, period), strict=True))


def _agree(before: str, after: str, limit: float) -> pl.Expr:
    """Return whether two values are near to each other; an unknown one agrees with every other."""
    return ((pl.col(before) - pl.col(after)).abs() <= limit).fill_null(value=True)


def _follow(previous: Integers) -> Integers:
    """Follow each id to the first of its vehicle, in steps that double."""
    while not np.array_equal(further := previous[previous], previous):
        previous = further
    return previous
