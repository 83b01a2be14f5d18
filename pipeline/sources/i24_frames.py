"""Trajectories of I-24 MOTION on common frames, 25 a second since 1970."""

import polars as pl

from tracklake.pipeline.sources.csv import LINE
from tracklake.pipeline.transforms.tracks.headings import find_headings
from tracklake.schemas.columns import FOOT_M

RATE_HZ = 25.0
"""Rate of the trajectories, in Hz."""
PERIOD_S = 300
"""Length of a recording in s, so that its tables fit into memory; a day is cut into these, as NGSIM's are published."""
PERIOD_FRAMES = round(PERIOD_S * RATE_HZ)
ON_FRAME = 0.01
"""Farthest from a frame, in frames, at which a position counts as that of the frame."""
LONGEST_STEP = 1.5
"""Longest step in frames over which a position at a frame between is interpolated; frame gaps are longer."""
LEAST_ENTRIES = 2
"""Fewest positions on frames of a trajectory: one has no speed."""
SYNTHETIC_ID = "73796e746865746963"
"""Beginning of _id in generated documents: `synthetic` in hex; those of databases begin with a time."""


def put_on_frames(documents: pl.DataFrame) -> tuple[pl.DataFrame, int, int]:
    """Put trajectories on the common frames, 25 a second since 1970.

    A position within 0.01 frames of one is taken for it; between two, at most 1.5 frames apart, it is interpolated.

    Returns the number of trajectories that are interpolated, the number of positions that no frame is made of, and
    period (number of the PERIOD_S since 1970), vehicle (the document's number), frame (within the period),
    x_ft, y_ft, their rates of change (central differences), direction, length_ft, width_ft, class, synthetic.
    Trajectories of fewer than two positions on frames are left out, of the numbers as well.
    """
    constants = documents.select(
        vehicle=pl.col(LINE).cast(pl.Int32),
        direction=pl.col("direction").cast(pl.Int8),
        length_ft=pl.col("length").list.median(),
        width_ft=pl.col("width").list.median(),
        **{"class": pl.col("coarse_vehicle_class").cast(pl.Int16, strict=False)},
        synthetic=pl.col("_id").struct.field("$oid").str.starts_with(SYNTHETIC_ID).fill_null(value=False),
    )
    points = documents.select(pl.col(LINE).cast(pl.Int32).alias("vehicle"), "timestamp", "x_position", "y_position")
    points = _find_frames(points.explode("timestamp", "x_position", "y_position"))
    points = points.filter((pl.col("end") - pl.col("first")).sum().over("vehicle") >= LEAST_ENTRIES)
    unused = points.filter("is_unused").height
    points = points.filter(pl.col("end") > pl.col("first")).with_columns(frame=pl.int_ranges("first", "end"))
    points = points.explode("frame").with_columns(is_between=pl.col("frame") - pl.col("at") > ON_FRAME)
    share = (pl.col("frame") - pl.col("at")) / (pl.col("ahead") - pl.col("at"))
    share = pl.when("is_between").then(share).otherwise(0.0)
    points = points.with_columns(
        x_ft=pl.col("x_position") + share * (pl.col("x_ahead") - pl.col("x_position")).fill_null(0.0),
        y_ft=pl.col("y_position") + share * (pl.col("y_ahead") - pl.col("y_position")).fill_null(0.0),
    )
    between = points.filter("is_between")["vehicle"].n_unique()
    points = points.select(
        *("vehicle", "x_ft", "y_ft"),
        speed_ftps=_derive_rate("x_ft"),
        lateral_ftps=_derive_rate("y_ft"),
        period=pl.col("frame") // PERIOD_FRAMES,
        frame=(pl.col("frame") % PERIOD_FRAMES).cast(pl.Int32),
    )
    return points.join(constants, on="vehicle", how="left", maintain_order="left"), between, unused


def _find_frames(points: pl.DataFrame) -> pl.DataFrame:
    """Find each position's `first` frame and that before which it `end`s: the two are the same where it has none."""
    at, is_same = pl.col("at"), pl.col("vehicle") == pl.col("vehicle").shift(-1)
    points = points.with_columns(at=pl.col("timestamp") * RATE_HZ)
    points = points.with_columns(
        first=(at - ON_FRAME).ceil().cast(pl.Int64),
        ahead=pl.when(is_same).then(at.shift(-1)),
        x_ahead=pl.when(is_same).then(pl.col("x_position").shift(-1)),
        y_ahead=pl.when(is_same).then(pl.col("y_position").shift(-1)),
    )
    first, ahead = pl.col("first"), pl.col("ahead")
    after_own = first + (first - at <= ON_FRAME).cast(pl.Int64)
    after = (ahead - ON_FRAME).ceil().cast(pl.Int64)
    points = points.with_columns(end=pl.when(ahead - at <= LONGEST_STEP).then(after).otherwise(after_own))
    ends_interpolation = (pl.col("end") > after_own).shift(1, fill_value=False)
    return points.with_columns(is_unused=(pl.col("end") == first) & ~ends_interpolation)


def add_headings(points: pl.DataFrame) -> pl.DataFrame:
    """Add the cosine and the sine of the heading, positive to greater y, of whole trajectories: see `find_headings`."""
    speeds = points.select(
        forward=pl.col("direction") * pl.col("speed_ftps") * FOOT_M, aside=pl.col("lateral_ftps") * FOOT_M
    )
    frame = points["period"] * PERIOD_FRAMES + points["frame"]
    forward_mps, aside_mps = (speeds[name].to_numpy() for name in ("forward", "aside"))
    vehicle = points["vehicle"].to_numpy()
    cosine, sine = find_headings(vehicle, frame.to_numpy(), forward_mps, aside_mps, RATE_HZ)
    return points.with_columns(cosine=pl.Series(cosine), sine=pl.Series(sine))


def _derive_rate(column: str) -> pl.Expr:
    """Differentiate a position over the neighbouring frames: on one side at ends of tracks, over a gap where needed."""
    value, frame, vehicle = pl.col(column), pl.col("frame"), pl.col("vehicle")
    slopes = [
        pl.when(vehicle.shift(step) == vehicle).then((value.shift(step) - value) / (frame.shift(step) - frame))
        for step in (-1, 1)
    ]
    near = [
        pl.when((frame.shift(step) - frame).abs() == 1).then(slope) for step, slope in zip((-1, 1), slopes, strict=True)
    ]
    return pl.coalesce(pl.mean_horizontal(near), *slopes) * RATE_HZ
