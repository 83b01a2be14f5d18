"""Raw coordinates turned into the canonical frame: x along the direction of travel, y to the driver's right.

Formulas: DESIGN section 4, 'Orientation of highD' and 'NGSIM'.
"""

import polars as pl

from tracklake.pipeline.transforms.tracks.headings import find_headings
from tracklake.schemas.columns import FOOT_M

UPPER, LOWER = 1, 2
"""Codes of highD's drivingDirection: the upper carriageway drives to the image's left, the lower one to its right."""
EAST, NORTH, WEST, SOUTH = 1, 2, 3, 4
"""Codes of NGSIM's Direction on arterials, where Local_Y runs north and Local_X east."""
DIRECTIONS = {EAST: "east", NORTH: "north", WEST: "west", SOUTH: "south"}
"""Names of NGSIM's directions by code."""


def orient_highd(
    entries: pl.DataFrame, direction: int, upper_m: list[float], lower_m: list[float], rate_hz: float
) -> pl.DataFrame:
    """Turn one carriageway's boxes into the canonical frame.

    The box (x, y, width, height) is axis-aligned with y pointing down, and its middle is the body's. On the lower
    carriageway vehicles drive right and the driver's right is down; on the upper one they drive left and it is up. The
    front centre lies half a length from the middle in the direction of the heading.

    The entries have id, frame, x, y, width, height, xVelocity, yVelocity, xAcceleration, laneId of the carriageway, as
    in highD, sorted by id, frame; lane markings are y in m, from the top. Adds x_m and y_m, to 1 mm, heading_rad, lane,
    speed_mps, accel_mps2, lateral_speed_mps.
    """
    upper_lanes, sign = len(upper_m) - 1, -1 if direction == UPPER else 1
    entries = entries.with_columns(
        speed_mps=sign * pl.col("xVelocity"),
        accel_mps2=sign * pl.col("xAcceleration"),
        lateral_speed_mps=sign * pl.col("yVelocity"),
        lane=upper_lanes + 2 - pl.col("laneId") if direction == UPPER else pl.col("laneId") - upper_lanes - 2,
    )
    names = ("id", "frame", "speed_mps", "lateral_speed_mps")
    vehicle, frame, forward_mps, right_mps = (entries[name].to_numpy() for name in names)
    headings = find_headings(vehicle, frame, forward_mps, right_mps, rate_hz)
    cosine, sine = (pl.lit(pl.Series(values)) for values in headings)
    half, middle_x, middle_y = (
        pl.col("width") / 2,
        pl.col("x") + pl.col("width") / 2,
        pl.col("y") + pl.col("height") / 2,
    )
    front_x = sign * middle_x + half * cosine
    left_edge_m = -upper_m[-1] if direction == UPPER else lower_m[0]
    return entries.with_columns(
        x_m=(front_x - front_x.min() if direction == UPPER else front_x).round(3),
        y_m=(sign * middle_y + half * sine - left_edge_m).round(3),
        heading_rad=sine.arcsin().round(4),
    )


def orient_ngsim(entries: pl.DataFrame, direction: int | None) -> pl.DataFrame:
    """Add x_m, y_m, speed_mps and accel_mps2 to Local_X, Local_Y (feet, front centre), v_Vel, v_Acc of one subset.

    Freeways keep Local_X and Local_Y. On arterials x_m is measured along the direction of travel, from the first
    recorded point if travel runs against the axis; y_m for north and south from the street's centre line, for the
    crossing streets from the leftmost recorded point.

    `direction` is EAST, NORTH, WEST or SOUTH; None on a freeway.
    """
    lateral, along = pl.col("Local_X") * FOOT_M, pl.col("Local_Y") * FOOT_M
    x_m, y_m = {
        None: (along, lateral),
        NORTH: (along, lateral),
        SOUTH: (along.max() - along, -lateral),
        EAST: (lateral - lateral.min(), along.max() - along),
        WEST: (lateral.max() - lateral, along - along.min()),
    }[direction]
    return entries.with_columns(
        x_m=x_m, y_m=y_m, speed_mps=pl.col("v_Vel") * FOOT_M, accel_mps2=pl.col("v_Acc") * FOOT_M
    )
