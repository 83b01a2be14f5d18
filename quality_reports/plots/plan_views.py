"""Plan views: the vehicles of one moment from above, as SVG that shows more or less road, as wide as the page is."""

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from tracklake.quality_reports.plots.axes import MINUS
from tracklake.quality_reports.plots.rasters import colour_values
from tracklake.quality_reports.plots.scenes import LENGTH_M, WIDTH_M

PX_PER_M = 8
"""Scale along and across the road, in pixels per metre."""
REACH_M = 76.0
"""Drawn road before and behind the middle, in metres: more than half of the widest page."""
MOST_APART_M = 30.0
"""Longest stretch with both vehicles of a finding that is centred, in metres; a longer one is centred on the first."""
MOST_HIGH_M, VERGE_M = 34.0, 2.5
"""Greatest height of a view and the space beside the road, in metres."""
WIDE = 999
"""Half of the length of drawn markings, in pixels."""
AXIS_PX, TICK_M = 22, 10
"""Height of the axis below the road in pixels, and the distance of its ticks in metres."""
SHOWN = {
    "number": pl.Int64,
    "vehicle_id": pl.Int32,
    "partner_id": pl.Int32,
    "frame": pl.Int32,
    "first_frame": pl.Int32,
    "last_frame": pl.Int32,
}
"""Columns of what is drawn: a vehicle and its partner at a frame, and the frames of its drawn way."""


@dataclass(frozen=True)
class Road:
    """The road of a subset, across.

    Args:
        markings: y_m of the lane markings; None where they are unknown.
        lanes: each lane and its middle.
        first_y_m: least y_m of an entry.
        last_y_m: greatest y_m of an entry.
    """

    markings: list[float] | None
    lanes: Sequence[tuple[int, float]]
    first_y_m: float
    last_y_m: float

    @property
    def edges(self) -> tuple[float, float]:
        """Left and right edge of the drawn surface."""
        if self.markings:
            return self.markings[0], self.markings[-1]
        return self.first_y_m - WIDTH_M, self.last_y_m + WIDTH_M


@dataclass(frozen=True)
class PlanView:
    """A drawing of one moment.

    Args:
        svg: the drawing, of numbers and words of our own.
        facts: what the finding's vehicles do, in words.
    """

    svg: str
    facts: str


def draw_plan_views(entries: pl.DataFrame, shown: pl.DataFrame, road: Road, top_mps: float) -> list[PlanView | None]:
    """Draw the surroundings of vehicles, each at one moment, with their way 5 s before and after where it is known.

    Args:
        entries: rows of subset_scenes.sql, sorted by vehicle_id and frame.
        shown: rows of SHOWN, numbered from 0; without a partner, partner_id is null.
        road: the road of the subset.
        top_mps: upper end of the colour scale of speeds.

    Returns:
        A view per row of `shown`, or None where the vehicle has no entry in the frame.
    """
    placed = _place_vehicles(entries, shown, road)
    own = placed.filter("is_own").sort("number", "is_partner")
    tops = dict(
        own.filter(~pl.col("is_partner")).select("number", pl.struct("middle_m", "top_m", "high_m")).iter_rows()
    )
    vehicles = placed.with_columns(
        colour=pl.Series(colour_values(placed["speed_mps"].cast(pl.Float64).to_numpy(), 0, top_mps), dtype=pl.String)
    ).sort("number", "is_own", "is_partner", "vehicle_id")
    drawn = vehicles.group_by("number", maintain_order=True).agg(
        _draw_boxes().filter(~pl.col("is_own")).str.join().alias("others"),
        _draw_boxes().filter("is_own").str.join().alias("boxes"),
        _draw_windscreens().str.join().alias("windscreens"),
        _draw_ids().str.join().alias("ids"),
        _describe_vehicles().filter("is_own").str.join("; ").alias("facts"),
    )
    ways = _draw_ways(entries, shown, own)
    views: list[PlanView | None] = [None] * shown.height
    for row in drawn.iter_rows(named=True):
        frame = tops[row["number"]]
        vehicles_svg = (
            f'<path class="way" d="{ways.get(row["number"], "")}"/><g class="boxes">{row["others"]}</g>'
            f'<g class="boxes own">{row["boxes"]}</g><path class="windscreens" d="{row["windscreens"]}"/>'
            f'<g class="ids">{row["ids"]}</g>'
        )
        views[row["number"]] = PlanView(_wrap(frame, road, vehicles_svg), row["facts"])
    return views


def describe_speed(speed: pl.Expr) -> pl.Expr:
    """Return a speed in m/s as text in km/h and m/s."""
    kmh = (speed * 3.6).round().cast(pl.Int64).cast(pl.String)
    text = pl.format("{} km/h ({} m/s)", kmh, speed.cast(pl.Float64).round(1))
    return text.str.replace("(-0.0", "(0.0", literal=True).str.replace_all("-", MINUS, literal=True)


def _place_vehicles(entries: pl.DataFrame, shown: pl.DataFrame, road: Road) -> pl.DataFrame:
    """Return the entries around each view's middle, with their place in pixels.

    Returns:
        Columns of `entries` and number, is_own, is_partner, middle_m, top_m, high_m (of the view), across and down (of
        the front centre), along_x, along_y (a step along the body of 1 m).
    """
    own = shown.join(entries, on=["vehicle_id", "frame"]).select(
        "number", "frame", "partner_id", own_id="vehicle_id", own_x_m="x_m", own_y_m="y_m"
    )
    scenes = own.join(entries, on="frame").with_columns(
        pl.col("length_m").fill_null(LENGTH_M),
        pl.col("width_m").fill_null(WIDTH_M),
        is_partner=(pl.col("vehicle_id") == pl.col("partner_id")).fill_null(value=False),
    )
    scenes = scenes.with_columns(is_own=(pl.col("vehicle_id") == pl.col("own_id")) | pl.col("is_partner"))
    focus = pl.col("is_own")
    front = pl.col("x_m").filter(focus).max().over("number")
    back = (pl.col("x_m") - pl.col("length_m")).filter(focus).min().over("number")
    left, right = road.edges[0] - VERGE_M, road.edges[1] + VERGE_M
    high = min(MOST_HIGH_M, right - left)
    return (
        scenes.with_columns(
            middle_m=pl.when(front - back <= MOST_APART_M).then((front + back) / 2).otherwise("own_x_m"),
            top_m=(pl.col("own_y_m") - high / 2).clip(left, right - high),
            high_m=pl.lit(high),
        )
        .filter((pl.col("x_m") - pl.col("middle_m")).is_between(-REACH_M, REACH_M + pl.col("length_m")))
        .with_columns(
            across=(pl.col("x_m") - pl.col("middle_m")) * PX_PER_M,
            down=(pl.col("y_m") - pl.col("top_m")) * PX_PER_M,
            along_x=pl.col("heading_rad").cast(pl.Float64).cos() * PX_PER_M,
            along_y=pl.col("heading_rad").cast(pl.Float64).sin() * PX_PER_M,
        )
    )


def _point(back: pl.Expr, right: pl.Expr) -> pl.Expr:
    """Return the pixels of a point of a vehicle as text, so many metres behind its front and right of its axis."""
    across = pl.col("across") - back * pl.col("along_x") - right * pl.col("along_y")
    down = pl.col("down") - back * pl.col("along_y") + right * pl.col("along_x")
    return pl.format("{} {}", across.round(1), down.round(1))


def _draw_boxes() -> pl.Expr:
    """Return vehicles as paths that say on hovering what they are."""
    half, length = pl.col("width_m") / 2, pl.col("length_m")
    corners = [_point(pl.lit(0.0), -half), _point(pl.lit(0.0), half), _point(length, half), _point(length, -half)]
    return pl.format(
        '<path d="M{}L{}L{}L{}Z" fill="{}"><title>{}</title></path>', *corners, "colour", _describe_vehicles()
    )


def _draw_windscreens() -> pl.Expr:
    """Return a line across each vehicle near its front."""
    half, back = pl.col("width_m") / 2, pl.min_horizontal(pl.lit(1.2), pl.col("length_m") / 3)
    return pl.format("M{}L{}", _point(back, -half), _point(back, half))


def _draw_ids() -> pl.Expr:
    """Return the ids above the vehicles, and below a finding's second vehicle."""
    beside = pl.col("width_m") / 2 * PX_PER_M
    down = pl.col("down") - pl.col("length_m") / 2 * pl.col("along_y")
    down = pl.when("is_partner").then(down + beside + 13).otherwise(down - beside - 4)
    across = pl.col("across") - pl.col("length_m") / 2 * pl.col("along_x")
    kind = pl.when("is_own").then(pl.lit(' class="own"')).otherwise(pl.lit(""))
    return pl.format('<text x="{}" y="{}"{}>{}</text>', across.round(1), down.round(1), kind, "vehicle_id")


def _describe_vehicles() -> pl.Expr:
    """Return what is known of vehicles in words."""
    lane = pl.format(", lane {}", "lane").fill_null("")
    return pl.format("vehicle {}: {} at {} m{}", "vehicle_id", describe_speed(pl.col("speed_mps")), _round_x(), lane)


def _round_x() -> pl.Expr:
    """Return positions along the road, rounded to a metre."""
    return pl.col("x_m").round().cast(pl.Int64)


def _draw_ways(entries: pl.DataFrame, shown: pl.DataFrame, own: pl.DataFrame) -> dict[int, str]:
    """Return the path of each view's first vehicle through the frames before and after its moment."""
    views = own.filter(~pl.col("is_partner")).select("number", "middle_m", "top_m")
    rows = (
        shown.select("number", "vehicle_id", "first_frame", "last_frame")
        .join(views, on="number")
        .join(entries, on="vehicle_id", maintain_order="left_right")
        .filter(pl.col("frame").is_between("first_frame", "last_frame"))
    )
    across = ((pl.col("x_m") - pl.col("middle_m")) * PX_PER_M).clip(-2_000, 2_000).round(1)
    points = pl.format("{} {}", across, ((pl.col("y_m") - pl.col("top_m")) * PX_PER_M).round(1))
    ways = rows.group_by("number").agg(pl.format("M{}", points.str.join("L")).first())
    return dict(ways.iter_rows())


def _wrap(frame: dict[str, float], road: Road, vehicles: str) -> str:
    """Return the drawing of the road around the vehicles.

    Its inner part begins in the middle, where the finding is: a narrow page shows less road and not a smaller one.
    """
    top, height = frame["top_m"], frame["high_m"] * PX_PER_M
    left, right = ((y_m - top) * PX_PER_M for y_m in road.edges)
    markings = [(y_m - top) * PX_PER_M for y_m in road.markings or ()]
    edges = "".join(f"M-{WIDE} {y:.1f}H{WIDE}" for y in (left, right)) if markings else ""
    dashed = "".join(f"M-{WIDE} {y:.1f}H{WIDE}" for y in markings[1:-1])
    middles = [(lane, (y_m - top) * PX_PER_M) for lane, y_m in road.lanes]
    dotted = "" if markings else "".join(f"M-{WIDE} {y:.1f}H{WIDE}" for _, y in middles)
    names = "".join(
        f'<text class="lane" x="4" y="{y + 4:.1f}">lane {lane}</text>' for lane, y in middles if 0 < y < height
    )
    first = round((frame["middle_m"] - REACH_M) / TICK_M) * TICK_M
    ticks = [(x_m, (x_m - frame["middle_m"]) * PX_PER_M) for x_m in range(first, first + 2 * int(REACH_M), TICK_M)]
    marks = "".join(f"M{x:.1f} {height:g}v5" for _, x in ticks)
    axis = "".join(f'<text x="{x:.1f}" y="{height + 17:g}">{str(x_m).replace("-", MINUS)} m</text>' for x_m, x in ticks)
    return (
        f'<svg class="plan" role="img" aria-label="Vehicles from above" height="{height + AXIS_PX:g}">'
        f'<svg height="{height:g}"><rect class="road" y="{left:.1f}" width="100%" height="{right - left:.1f}"/>'
        f'<svg x="50%" overflow="visible"><path class="edge" d="{edges}"/><path class="dashed" d="{dashed}"/>'
        f'<path class="dotted" d="{dotted}"/>{vehicles}</svg>{names}</svg>'
        f'<svg x="50%" overflow="visible"><path class="tick" d="{marks}"/>'
        f'<g class="axis">{axis}</g></svg></svg>'
    )
