"""Lane changes of varied traffic: every driver has a duration, a course and a place beside the centre line.

SUMO decides who changes lanes and when a marking is crossed, and keeps both lanes free around that moment. How long a
change takes and how it runs is drawn here. Durations are those of Toledo and Zohar (2007), 4.6 s on average and 1 to
13 s long; nearly all of those drawn here are between 2.5 and 11 s, 5 s on average.
"""

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.scenarios import Road

LEAST_S, SPREAD_S, SPREAD_SHAPE = 2.5, 0.85, 3.0
"""Durations of lane changes: the least, in s; scale, in s, and shape of the gamma distribution of what exceeds it."""
CROSSING = (0.4, 0.6)
"""Range of the share of a lane change's duration after which its middle is reached."""
ASIDE_M, ASIDE_MOST_M = 0.15, 0.3
"""Standard deviation and limit of the distance that a driver keeps to the lane's centre line, in m."""
SWAY_M, SWAY_WAY_M = (0.02, 0.12), (100.0, 300.0)
"""Ranges of how far drivers sway to either side, and of the way on which they sway once to and fro, in m."""


def draw_courses(changes: pl.DataFrame, random: np.random.Generator) -> pl.DataFrame:
    """Draw when lane changes begin and end; those of one vehicle never overlap.

    Args:
        changes: `id`, `time` at which the marking is crossed in s, lanes `start` and `target`.
        random: source of the draws.

    Returns:
        Also `begin` and `end` in s, `lean` (-1 to 1: how much faster a change begins than it ends) and `blend` (0: a
        cubic course, 1: the one with the least jerk).
    """
    drivers = changes.select(pl.col("id").unique().sort())
    shape = drivers.height
    drawn = drivers.with_columns(
        pl.Series("duration", LEAST_S + random.gamma(SPREAD_SHAPE, SPREAD_S, shape)),
        pl.Series("crossing", random.uniform(*CROSSING, shape)),
        pl.Series("blend", random.uniform(0, 1, shape)),
    )
    before, after = pl.col("duration") * pl.col("crossing"), pl.col("duration") * (1 - pl.col("crossing"))
    apart = pl.col("time").diff().over("id") / (before + after.shift().over("id"))
    crossing = pl.col("crossing")
    return (
        changes.join(drawn, on="id", how="left", maintain_order="left")
        .sort("id", "time")
        .with_columns(fits=apart)
        .with_columns(fits=pl.min_horizontal(1.0, "fits", pl.col("fits").shift(-1).over("id")))
        .select(
            *changes.columns,
            begin=pl.col("time") - before * pl.col("fits"),
            end=pl.col("time") + after * pl.col("fits"),
            lean=(0.5 - crossing) / (crossing * (1 - crossing)),
            blend="blend",
        )
    )


def compute_course(part: pl.Expr, lean: pl.Expr, blend: pl.Expr) -> pl.Expr:
    """Compute the share of the way across from the share of the time, 0 to 1: both begin and end at rest."""
    p = part + lean * part * (1 - part)
    return (1 - blend) * p**2 * (3 - 2 * p) + blend * p**3 * (10 - 15 * p + 6 * p**2)


def move_across(placed: pl.DataFrame, courses: pl.DataFrame, road: Road, random: np.random.Generator) -> pl.DataFrame:
    """Add `across` (in lanes, 0 is the leftmost lane's centre line) and the lane change that a vehicle is in.

    Args:
        placed: entries sorted by `time` in s, with `id`, `x` in m and `number` of the lane.
        courses: those of `draw_courses`.
        road: the carriageway.
        random: source of the draws.

    Returns:
        Also `change_begin` and `change_end` in s and `change_side` (-1 left, 1 right), null between lane changes.
    """
    drivers = placed.select(pl.col("id").unique().sort())
    shape = drivers.height
    drawn = drivers.with_columns(
        pl.Series("aside", np.clip(random.normal(0, ASIDE_M, shape), -ASIDE_MOST_M, ASIDE_MOST_M)),
        pl.Series("sway", random.uniform(*SWAY_M, shape)),
        pl.Series("turn", 2 * np.pi / random.uniform(*SWAY_WAY_M, shape)),
        pl.Series("phase", random.uniform(0, 2 * np.pi, shape)),
    )
    part = ((pl.col("time") - pl.col("begin")) / (pl.col("end") - pl.col("begin"))).clip(0, 1)
    step = pl.col("target") - pl.col("start")
    course = pl.col("start") + step * compute_course(part, pl.col("lean"), pl.col("blend"))
    beside = pl.col("aside") + pl.col("sway") * (pl.col("x") * pl.col("turn") + pl.col("phase")).sin()
    changing = pl.when(pl.col("time") <= pl.col("end"))
    return (
        placed.join_asof(
            courses.rename({"time": "crossed"}).sort("begin"), left_on="time", right_on="begin", by="id",
            check_sortedness=False, coalesce=False,
        )
        .join(drawn, on="id", how="left", maintain_order="left")
        .with_columns(
            across=pl.coalesce(course, "number") - 1 + beside / road.lane_width_m,
            change_begin=changing.then("begin"),
            change_end=changing.then("end"),
            change_side=changing.then(step.sign()),
        )
        .select(*placed.columns, "across", "change_begin", "change_end", "change_side")
    )  # fmt: skip
