"""Columns that the rules of drives read: derived from each station's messages in order, and from ticks of the ego.

Frame of the ego: x ahead and y to the right of its centre, in m. Headings are degrees clockwise from north.
"""

import polars as pl

LOSS_WINDOW_S = 5.0
"""Time before a message over which lost messages are counted, in seconds."""
BASELINE_S, BASELINE_SLACK_S = 2.0, 1.0
"""Least time between the two messages that give a direction of motion, and how much longer it may be, in seconds."""
MAX_ACCEL_MPS2 = 8.0
"""Greatest acceleration or braking of a road vehicle, in m/s2."""
MAX_AGE_S = 1.0
"""Oldest message, and oldest state of the ego, that is carried forward to a tick, in seconds."""
EQUATOR_RADIUS_M, ECCENTRICITY_2 = 6_378_137.0, 0.006_694_379_990_141_3
"""WGS-84: radius of the equator, in m, and first eccentricity squared."""
DRIVE_READS = {
    "loss_share": ("lost_before", "time_s"),
    "latency_s": ("received_s", "time_s"),
    "clock_error_s": ("clock_step_s", "received_s", "time_s"),
    "heading_error_deg": ("lat_deg", "lon_deg", "heading_deg", "time_s"),
    "motion_mps": ("lat_deg", "lon_deg", "time_s"),
    "jump_excess_m": ("lat_deg", "lon_deg", "speed_mps", "time_s"),
    "box_distance_m": ("box_x_m", "box_y_m", "from_lidar", "message_x_m", "message_y_m"),
}
"""Columns of `bsm`, and of ticks with placed messages, behind each derived column."""

Pair = tuple[pl.Expr, pl.Expr]


def prepare_messages(messages: pl.DataFrame) -> pl.DataFrame:
    """Add the derived columns of messages, and their tick and their number within the station.

    Args:
        messages: rows of `bsm` of one drive, sorted by vehicle_id, time_s.
    """
    time_us = (pl.col("time_s") * 1e6).round().cast(pl.Int64)
    ordered = messages.with_columns(
        tick=(pl.col("time_s") * 10).floor().cast(pl.Int32),
        number=pl.int_range(pl.len()).over("vehicle_id"),
        time_us=time_us,
        since_us=time_us - round(BASELINE_S * 1e6),
    )
    window = f"{round(LOSS_WINDOW_S * 1e6)}i"
    lost = ordered.rolling("time_us", period=window, group_by="vehicle_id").agg(
        share=pl.col("lost_before").sum() / (pl.col("lost_before").sum() + pl.len())
    )
    columns = ["vehicle_id", "time_us", "lat_deg", "lon_deg", "heading_deg"]
    then = ordered.select(columns).with_columns(then_us="time_us").sort("time_us")
    before = ordered.with_columns(row=pl.int_range(pl.len())).sort("since_us")
    before = before.select("row", "vehicle_id", "since_us").join_asof(
        then,
        left_on="since_us",
        right_on="time_us",
        by="vehicle_id",
        tolerance=round(BASELINE_SLACK_S * 1e6),
        check_sortedness=False,  # both are sorted by time alone, which suffices for any station
    )
    paired = before.sort("row").select(pl.col("lat_deg", "lon_deg", "heading_deg").name.suffix("_then"), "then_us")
    latency = pl.col("received_s") - pl.col("time_s")
    return (
        pl.concat([ordered, paired], how="horizontal")
        .with_columns(
            lost["share"].alias("loss_share"),
            latency_s=latency.round(6),
            clock_error_s=pl.max_horizontal(pl.col("clock_step_s").abs().cast(pl.Float64), -latency).round(6),
            jump_excess_m=_measure_jumps(),
            **_compare_headings(),
        )
        .drop("time_us", "since_us", "then_us", "lat_deg_then", "lon_deg_then", "heading_deg_then")
    )


def _compare_headings() -> dict[str, pl.Expr]:
    """Return the speed over the baseline, and how far the headings lie off the direction of motion.

    Along an arc the chord has the direction midway between the headings at its ends.
    """
    east, north = measure_way((pl.col("lat_deg_then"), pl.col("lon_deg_then")), (pl.col("lat_deg"), pl.col("lon_deg")))
    turn = wrap_degrees(pl.col("heading_deg") - pl.col("heading_deg_then"))
    midway = pl.col("heading_deg_then") + turn / 2
    direction = pl.arctan2(east, north).degrees()
    return {
        "motion_mps": (east**2 + north**2).sqrt() / (pl.col("time_us") - pl.col("then_us")) * 1e6,
        "heading_error_deg": wrap_degrees(direction - midway).abs().round(3),
    }


def _measure_jumps() -> pl.Expr:
    """Return by how much a station's way since its message before is longer or shorter than it can be, in m.

    Between two speeds, the way differs by at most acceleration * time^2 / 4 from their mean times the time.
    """
    before = {name: pl.col(name).shift(1).over("vehicle_id") for name in ("lat_deg", "lon_deg", "speed_mps", "time_s")}
    east, north = measure_way((before["lat_deg"], before["lon_deg"]), (pl.col("lat_deg"), pl.col("lon_deg")))
    seconds = pl.col("time_s") - before["time_s"]
    usual = seconds * (pl.col("speed_mps").cast(pl.Float64) + before["speed_mps"]) / 2
    excess = ((east**2 + north**2).sqrt() - usual).abs() - MAX_ACCEL_MPS2 * seconds**2 / 4
    return excess.clip(lower_bound=0).round(3)


def place_messages(
    ticks: pl.DataFrame, messages: pl.DataFrame, ego_states: pl.DataFrame, *, max_age_s: float = MAX_AGE_S
) -> pl.DataFrame:
    """Add message_x_m and message_y_m: where a vehicle's last message alone puts it at a tick, in the ego's frame.

    Messages that had arrived by the tick and the ego's last state are carried forward with their speed and heading,
    where they have both; null where the message is older than max_age_s, the state than MAX_AGE_S, or the ego's heading
    unknown. The rows keep their order.

    Args:
        ticks: vehicle_id and tick, sorted by them.
        messages: rows of `bsm` of the drive.
        ego_states: rows of `ego_states` of the drive, sorted by time_s.
        max_age_s: oldest message, in s.
    """
    arrived = messages.select(
        *("vehicle_id", "lat_deg", "lon_deg", "heading_deg", "speed_mps", "time_s"),
        arrival_s=pl.coalesce("received_s", "time_s"),
    ).sort("arrival_s")
    ego = ego_states.select(
        "lat_deg", "lon_deg", "speed_mps", "time_s", ego_s="time_s", heading_deg=pl.col("heading_deg").forward_fill()
    )
    at_ticks = ticks.with_columns(row=pl.int_range(pl.len()), now_s=pl.col("tick") / 10 + 1e-6).sort("now_s")
    joined = (
        at_ticks.join_asof(
            arrived, left_on="now_s", right_on="arrival_s", by="vehicle_id", check_sortedness=False, suffix="_sent"
        )
        .join_asof(ego, left_on="now_s", right_on="ego_s", tolerance=MAX_AGE_S, suffix="_ego")
        .sort("row")
    )
    east, north = measure_way((pl.col("lat_deg_ego"), pl.col("lon_deg_ego")), (pl.col("lat_deg"), pl.col("lon_deg")))
    (own_east, own_north), (sent_east, sent_north) = _move_to_tick("_ego"), _move_to_tick("")
    ahead, right = turn_to_heading(
        (east + sent_east - own_east, north + sent_north - own_north), pl.col("heading_deg_ego")
    )
    fresh = pl.col("now_s") - pl.col("time_s") <= max_age_s + 1e-5  # of a float's last digits
    placed = joined.select(message_x_m=pl.when(fresh).then(ahead), message_y_m=pl.when(fresh).then(right))
    return pl.concat([ticks, placed], how="horizontal")


def prepare_ticks(surrounding: pl.DataFrame, messages: pl.DataFrame, ego_states: pl.DataFrame) -> pl.DataFrame:
    """Add the derived columns of ticks, and their number.

    Args:
        surrounding: vehicle_id, tick, box_x_m, box_y_m and from_lidar of one drive, sorted by vehicle_id, tick.
        messages: rows of `bsm` of the drive.
        ego_states: rows of `ego_states` of the drive, sorted by time_s.
    """
    return measure_boxes(place_messages(surrounding, messages, ego_states))


def measure_boxes(placed: pl.DataFrame) -> pl.DataFrame:
    """Add the distance of boxes that LiDAR saw from where the vehicles' messages put them, and the ticks' number."""
    across = [pl.col(f"box_{axis}_m").cast(pl.Float64) - pl.col(f"message_{axis}_m") for axis in "xy"]
    distance = (across[0] ** 2 + across[1] ** 2).sqrt().round(3)
    return placed.with_columns(number=pl.col("tick"), box_distance_m=pl.when("from_lidar").then(distance))


def measure_way(start: Pair, end: Pair) -> Pair:
    """Return the way between two near positions to the east and to the north, in m.

    Args:
        start: latitude and longitude, in degrees; the ellipsoid's radii of curvature are those there.
        end: latitude and longitude, in degrees.
    """
    latitude = start[0].radians()
    flattening = 1 - ECCENTRICITY_2 * latitude.sin() ** 2
    across = EQUATOR_RADIUS_M / flattening.sqrt()
    along = across * (1 - ECCENTRICITY_2) / flattening
    east = wrap_degrees(end[1] - start[1]).radians() * across * latitude.cos()
    return east, (end[0] - start[0]).radians() * along


def turn_to_heading(way: Pair, heading_deg: pl.Expr) -> Pair:
    """Return a way to the east and to the north as one ahead and to the right of a heading."""
    (east, north), heading = way, heading_deg.cast(pl.Float64).radians()
    return east * heading.sin() + north * heading.cos(), east * heading.cos() - north * heading.sin()


def wrap_degrees(angle: pl.Expr) -> pl.Expr:
    """Return an angle between -180 and 180 degrees."""
    return angle.cast(pl.Float64) - 360 * (angle.cast(pl.Float64) / 360).round()


def _move_to_tick(suffix: str) -> Pair:
    """Return the way of a vehicle from its state of this suffix to the tick, to the east and to the north."""
    way = (pl.col("now_s") - pl.col(f"time_s{suffix}")) * pl.col(f"speed_mps{suffix}").fill_null(0)
    heading = pl.col(f"heading_deg{suffix}").cast(pl.Float64).radians()
    return (way * heading.sin()).fill_null(0), (way * heading.cos()).fill_null(0)
