"""Plots of a drive: the ego's surroundings from above and over time, what measured them, losses and errors."""

from collections.abc import Sequence
from typing import Any, cast

import polars as pl

from tracklake.quality_reports.plots.axes import (
    MINUS,
    Scale,
    draw_frame,
    draw_line,
    draw_path,
    draw_text,
    find_range,
    format_number,
    wrap_svg,
)
from tracklake.quality_reports.plots.distributions import Row
from tracklake.schemas.chart_theme import BLUE, GREEN, INK, MUTED, ORANGE

WIDTH, LEFT, RIGHT, TOP, BOTTOM = 1112, 64, 24, 40, 44
"""Size of a plot, its margins among it, in pixels."""
PX_PER_M, TICK_M = 5, 10
"""Scale of plan views in pixels per metre, and the distance of their axes' ticks in m."""
REACH_M, ASIDE_M = 110.0, 14.0
"""Road ahead, behind and to either side of the ego that plan views show, in m."""
MOMENTS = 5
"""Plan views of a drive."""
MOST_VEHICLES = 40
"""Most vehicles that have a line or a row of their own."""
MOST_POINTS = 20_000
"""Most points of all lines over time."""
ABREAST_M = 2.0
"""Offset to either side up to which a vehicle counts as in the ego's lane, in m."""
RED = "#b3261e"
"""Colour of lost messages."""
KINDS = (("V2V and LiDAR", GREEN), ("V2V", BLUE), ("LiDAR or camera", ORANGE), ("predicted only", MUTED))
"""What measured a vehicle at a tick, and its colour."""

_IS_NEAR = (pl.col("rel_x_m").abs() < REACH_M, pl.col("rel_y_m").abs() < ASIDE_M)


def classify_sources() -> pl.Expr:
    """Return which of KINDS a tick of a vehicle is, as its name."""
    sensed = pl.col("from_lidar") | pl.col("from_camera")
    names = [pl.lit(name) for name, _ in KINDS]
    return (
        (pl.when(pl.col("from_v2v") & pl.col("from_lidar")).then(names[0]).when("from_v2v").then(names[1]))
        .when(sensed)
        .then(names[2])
        .otherwise(names[3])
    )


def list_vehicles(messages: pl.DataFrame, ticks: pl.DataFrame) -> list[int]:
    """List all vehicles but the ego by id, those beyond the MOST_VEHICLES with most messages and ticks last.

    Args:
        messages: rows of drive_messages.sql.
        ticks: rows of drive_ticks.sql.
    """
    rows = pl.concat([messages.filter(~pl.col("own")).select("vehicle_id"), ticks.select("vehicle_id")])
    counted = (
        rows.group_by("vehicle_id").len().sort("len", "vehicle_id", descending=[True, False])["vehicle_id"].to_list()
    )
    return [*sorted(counted[:MOST_VEHICLES]), *counted[MOST_VEHICLES:]]


def choose_moments(ticks: pl.DataFrame) -> list[int]:
    """Choose the ticks of plan views: in each of MOMENTS equal parts of the drive the first with most vehicles near.

    Args:
        ticks: rows of drive_ticks.sql.
    """
    near = ticks.filter(*_IS_NEAR)
    if near.is_empty():
        return []
    first, last = near.select(low=pl.col("tick").min(), high=pl.col("tick").max()).row(0)
    part = ((pl.col("tick") - first) * MOMENTS // (last - first + 1)).alias("part")
    crowded = near.group_by("tick").agg(vehicles=pl.len()).with_columns(part)
    chosen = crowded.sort("vehicles", "tick", descending=[True, False]).group_by("part", maintain_order=True).first()
    return sorted(chosen["tick"].to_list())


def draw_surroundings(
    ticks: pl.DataFrame, truth: pl.DataFrame, moments: Sequence[int], ego_size_m: tuple[float, float]
) -> list[str]:
    """Draw the vehicles around the ego from above at some ticks, true to scale, ahead to the right.

    A drawing is as wide as its page: a narrow page shows less road around the ego and not a smaller one.

    Args:
        ticks: rows of drive_ticks.sql.
        truth: rows of drive_truth.sql.
        moments: ticks to draw.
        ego_size_m: length and width of the ego.
    """
    near = ticks.filter(*_IS_NEAR, pl.col("tick").is_in([*moments])).with_columns(kind=classify_sources())
    truth = truth.filter(*_IS_NEAR)
    aside_m = pl.concat([near["rel_y_m"], truth["rel_y_m"]]).abs().max()
    beside = min(ASIDE_M, cast("float", aside_m) + 4.5)
    height = 2 * beside * PX_PER_M
    reach = PX_PER_M * REACH_M
    metres = [(value, value * PX_PER_M) for value in range(TICK_M - int(REACH_M), int(REACH_M), TICK_M)]
    marks = "".join(f"M{x} {height:.1f}v5" for _, x in metres)
    axis = "".join(f'<text x="{x}" y="{height + 17:.1f}">{format_number(value)} m</text>' for value, x in metres)
    views = []
    for tick in moments:
        own, true = (rows.filter(pl.col("tick") == tick) for rows in (near.sort("vehicle_id"), truth))
        views.append(
            f'<svg class="plan" role="img" aria-label="Vehicles around the ego from above" height="{height + 22:.1f}">'
            f'<svg height="{height:.1f}"><rect class="road" width="100%" height="{height:.1f}"/>'
            f'<svg x="50%" overflow="visible"><path class="dotted" d="M{-reach} {height / 2:.1f}H{reach}"/>'
            f"{_draw_boxes(own, height / 2)}{_draw_outlines(true, height / 2)}{_draw_ego(height / 2, ego_size_m)}"
            "</svg></svg>"
            f'<svg x="50%" overflow="visible"><path class="tick" d="{marks}"/><g class="axis">{axis}</g></svg></svg>'
        )
    return views


def draw_sources() -> str:
    """Draw the legend of the plan views."""
    return wrap_svg(500, 28, "Colours of vehicles", "".join(_draw_legend([*KINDS, ("true outline", INK)], 500)))


def _draw_ego(middle: float, size_m: tuple[float, float]) -> str:
    """Return the ego as a box with a nose that points ahead."""
    long, wide = size_m[0] * PX_PER_M, size_m[1] * PX_PER_M
    nose = long * 0.3
    sides = f"h{long - nose:.1f}l{nose:.1f} {wide / 2:.1f}l{-nose:.1f} {wide / 2:.1f}h{nose - long:.1f}z"
    return f'<path d="M{-long / 2:.1f} {middle - wide / 2:.1f}{sides}" fill="{INK}"><title>the ego</title></path>'


def _draw_boxes(own: pl.DataFrame, middle: float) -> str:
    """Return the boxes of one moment, turned by their headings, with ids."""
    colours = dict(KINDS)
    parts = []
    for row in own.iter_rows(named=True):  # a few boxes
        filled = f'fill="{colours[row["kind"]]}" fill-opacity="0.8"'
        size_m = row["box_length_m"], row["box_width_m"]
        parts.append(f"{_place_box(row, middle, size_m)} {filled}><title>{_describe_vehicle(row)}</title></rect>")
        above = middle + (row["rel_y_m"] - size_m[1] / 2) * PX_PER_M - 4
        at = f'x="{row["rel_x_m"] * PX_PER_M:.1f}" y="{above:.1f}"'
        parts.append(f'<g class="ids"><text {at}>{row["vehicle_id"]}</text></g>')
    return "".join(parts)


def _draw_outlines(true: pl.DataFrame, middle: float) -> str:
    """Return the true outlines of one moment, dashed."""
    look = f'fill="none" stroke="{INK}" stroke-dasharray="3 2"/>'
    return "".join(
        f"{_place_box(row, middle, (row['length_m'], row['width_m']))} {look}" for row in true.iter_rows(named=True)
    )


def _place_box(row: Row, middle: float, size_m: tuple[float, float]) -> str:
    """Return the begin of a rectangle of a size at a row's place, turned by its heading."""
    long, wide = (extent * PX_PER_M for extent in size_m)
    across, down = row["rel_x_m"] * PX_PER_M, middle + row["rel_y_m"] * PX_PER_M
    return (
        f'<rect x="{across - long / 2:.1f}" y="{down - wide / 2:.1f}" width="{long:.1f}" height="{wide:.1f}" '
        f'transform="rotate({row["rel_heading_deg"]:.1f} {across:.1f} {down:.1f})"'
    )


def _describe_vehicle(row: Row) -> str:
    """Return what is known of a vehicle at a tick in words."""
    off = "" if row["error_m"] is None else f", {row['error_m']:.2f} m from the truth"
    return (
        f"vehicle {row['vehicle_id']}: {row['rel_x_m']:.1f} m ahead, {row['rel_y_m']:.1f} m to the right, "
        f"{row['speed_mps'] * 3.6:.0f} km/h ({row['speed_mps']:.1f} m/s), {row['kind']}{off}"
    ).replace("-", MINUS)


def draw_ways(ticks: pl.DataFrame) -> str:
    """Draw how far ahead of the ego each vehicle is over time, by its side.

    Args:
        ticks: rows of drive_ticks.sql.
    """
    step = 1 + ticks.height // MOST_POINTS
    shown = ticks.filter(pl.col("tick") % step == 0).with_columns(time_s=pl.col("tick") / 10)
    shown = shown.with_columns(
        follows=(pl.col("tick").diff() == step).fill_null(value=False)
        & (pl.col("vehicle_id").diff() == 0).fill_null(value=False)
    )
    last_s = float(ticks.select(pl.col("tick").max() / 10).item())
    x = Scale(0.0, max(1.0, last_s), LEFT, WIDTH - RIGHT)
    y = Scale(*find_range(shown["rel_x_m"], 20.0), TOP + 220, TOP)
    sides = {
        "to the left": (BLUE, pl.col("rel_y_m") < -ABREAST_M),
        "straight ahead or behind": (GREEN, pl.col("rel_y_m").abs() <= ABREAST_M),
        "to the right": (ORANGE, pl.col("rel_y_m") > ABREAST_M),
    }
    drawn = [draw_frame(x, y, "time (s)", "ahead of the ego (m)", x_ticks=10, y_ticks=6)]
    drawn.append(f'<path d="M{x.start} {y.to_pixels(0.0):.1f}H{x.end}" stroke="{INK}" fill="none"/>')
    for colour, inside in sides.values():
        points = shown.with_columns(pl.when(inside).then("rel_x_m").alias("rel_x_m"))
        drawn.append(draw_path(draw_line(points, x, y, "rel_x_m", "time_s"), colour, 1.4))
    drawn += _draw_legend([(name, colour) for name, (colour, _) in sides.items()])
    return wrap_svg(WIDTH, y.start + BOTTOM, "Vehicles ahead of and behind the ego over time", "".join(drawn))


def draw_support(messages: pl.DataFrame, ticks: pl.DataFrame, vehicles: Sequence[int]) -> str:
    """Draw when messages of each vehicle arrived or were lost, and when LiDAR and camera saw it: a row per vehicle.

    Args:
        messages: rows of drive_messages.sql.
        ticks: rows of drive_ticks.sql.
        vehicles: ids of the vehicles to draw, at most MOST_VEHICLES.
    """
    heard = messages.select(
        "vehicle_id", "lost_before", at=pl.col("time_s") * 10, before=pl.col("time_s").shift(1).over("vehicle_id") * 10
    )
    stripes = [
        ("message", BLUE, _find_stretches(heard.select("vehicle_id", tick="at"), 2.5)),
        ("lost", RED, heard.filter(pl.col("lost_before") > 0).select("vehicle_id", low="before", high="at")),
        ("LiDAR", GREEN, _find_stretches(ticks.filter("from_lidar"), 1.5)),
        ("camera", ORANGE, _find_stretches(ticks.filter("from_camera"), 2.5)),
    ]
    last = max([each.select(pl.col("high").max()).item() or 0 for _, _, each in stripes] + [1])
    x = Scale(0.0, last / 10, LEFT + 30, WIDTH - RIGHT)
    drawn = _draw_legend([(name, colour) for name, colour, _ in stripes])
    rows = {vehicle: TOP + 20 * number for number, vehicle in enumerate(vehicles)}
    bottom = TOP + 20 * len(rows)
    y = Scale(0.0, 1.0, bottom, TOP)
    drawn.append(draw_frame(x, y, "time (s)", "", x_ticks=10, y_ticks=0))
    drawn += [draw_text(LEFT + 22, top + 14, str(vehicle), anchor="end") for vehicle, top in rows.items()]
    for number, (_, colour, stretches) in enumerate(stripes):
        down = {0: 6, 1: 6, 2: 11, 3: 16}[number]
        shape = "".join(
            f"M{x.to_pixels(low / 10):.1f} {rows[vehicle] + down}"
            f"h{max(x.to_pixels((high - low) / 10) - x.start, 1):.1f}"
            for vehicle, low, high in stretches.select("vehicle_id", "low", "high").iter_rows()
            if vehicle in rows
        )
        drawn.append(f'<path d="{shape}" fill="none" stroke="{colour}" stroke-width="4"/>')
    return wrap_svg(WIDTH, bottom + BOTTOM, "Messages, LiDAR and camera of each vehicle over time", "".join(drawn))


def _find_stretches(rows: pl.DataFrame, most_apart: float) -> pl.DataFrame:
    """Return the stretches of a vehicle's ticks that lie no farther apart, from low to high."""
    begins = (pl.col("tick").diff() > most_apart) | (pl.col("vehicle_id").diff() != 0)
    runs = rows.sort("vehicle_id", "tick").with_columns(run=begins.fill_null(value=True).cum_sum())
    return runs.group_by("run", maintain_order=True).agg(
        pl.col("vehicle_id").first(), low=pl.col("tick").first().cast(pl.Float64), high=pl.col("tick").last() + 1.0
    )


def draw_losses(losses: Sequence[Row]) -> str:
    """Draw the share of lost messages by distance; the number of messages stands above each bar."""
    x = Scale(0.0, max(row["until_m"] for row in losses), LEFT, WIDTH - RIGHT)
    y = Scale(0.0, max(0.1, *(row["lost_share"] for row in losses)) * 108, TOP + 160, TOP)
    drawn = [draw_frame(x, y, "distance of the sender (m)", "lost (%)", x_ticks=10, y_ticks=5)]
    for row in losses:
        left, right, top = (
            x.to_pixels(row["from_m"]) + 1,
            x.to_pixels(row["until_m"]) - 1,
            y.to_pixels(100 * row["lost_share"]),
        )
        drawn.append(f'<path d="M{left:.1f} {y.start}V{top:.1f}H{right:.1f}V{y.start}z" fill="{BLUE}"/>')
        drawn.append(draw_text(f"{(left + right) / 2:.1f}", f"{top - 4:.1f}", f"{row['messages']:,}", anchor="middle"))
    return wrap_svg(WIDTH, y.start + BOTTOM, "Share of lost messages by distance", "".join(drawn))


def draw_errors(errors: Sequence[Row]) -> str:
    """Draw the errors of positions by distance: medians as lines with marks, 95 % dashed."""
    series = (
        ("last message alone", ORANGE, "message_error"),
        ("fused, by records until then", BLUE, "error"),
        ("smoothed by the whole drive", GREEN, "smoothed_error"),
    )
    highest = max(row[f"{name}_p95_m"] or 0.0 for row in errors for _, _, name in series)
    x = Scale(0.0, max(row["until_m"] for row in errors), LEFT, WIDTH - RIGHT)
    y = Scale(0.0, 1.05 * max(0.1, highest), TOP + 220, TOP)
    drawn = [draw_frame(x, y, "true distance (m)", "error of the position (m)", x_ticks=10, y_ticks=6)]
    for _, colour, name in series:
        for figure, dashes in (("median", ""), ("p95", ' stroke-dasharray="5 4"')):
            points = [((row["from_m"] + row["until_m"]) / 2, row[f"{name}_{figure}_m"]) for row in errors]
            at = [
                f"{x.to_pixels(middle):.1f} {y.to_pixels(value):.1f}" for middle, value in points if value is not None
            ]
            if at:
                drawn.append(f'<path d="M{"L".join(at)}" fill="none" stroke="{colour}" stroke-width="2"{dashes}/>')
            if figure == "median":
                drawn += [
                    f'<path d="M{each}m-3.5 0a3.5 3.5 0 1 0 7 0a3.5 3.5 0 1 0-7 0" fill="{colour}"/>' for each in at
                ]
    drawn += _draw_legend([(name, colour) for name, colour, _ in series])
    return wrap_svg(WIDTH, y.start + BOTTOM, "Errors of positions by distance", "".join(drawn))


def _draw_legend(entries: Sequence[tuple[str, Any]], right: float = WIDTH - RIGHT) -> list[str]:
    """Return coloured squares with names in a line that ends at `right`, in pixels."""
    drawn = []
    for name, colour in reversed(entries):
        right -= 6.2 * len(name) + 26
        mark = f'<path d="M{right:.0f} 10h10v10h-10z" fill="{colour}"/>'
        if colour == INK:
            mark = f'<path d="M{right:.0f} 10h10v10h-10z" fill="none" stroke="{INK}" stroke-dasharray="3 2"/>'
        drawn += [mark, draw_text(f"{right + 14:.0f}", 19, name)]
    return drawn
