"""True tracks of the sample's vehicles in the canonical frame, by which reconstructed tracks are judged."""

import polars as pl

TRUE_TRACKS_SCHEMA = {
    "dataset": pl.String(),
    "recording": pl.String(),
    "subset": pl.String(),
    "vehicle_id": pl.Int32(),
    "frame": pl.Int32(),
    "x_m": pl.Float64(),
    "y_m": pl.Float64(),
    "speed_mps": pl.Float32(),
    "accel_mps2": pl.Float32(),
    "lateral_speed_mps": pl.Float32(),
    "lane": pl.Int16(),
}
"""Every frame in which a vehicle is in the window, recorded or not, sorted by dataset, subset, vehicle_id, frame.
Positions are the front centre's, without noise and defects: x_m along the direction of travel, counted from where
ingestion counts that of the written file, so that x_m less this x_m is the error; y_m from the left edge to the
driver's right. Speeds and accelerations are rates of change of the positions."""
HEADING_S = 0.1
"""Time to either side over which velocities are averaged to find where a vehicle points, in s."""
LEAST_HEADING_MPS = 2.0
"""Speed below which a vehicle points where it last did, in m/s."""


def build_true_tracks(tracks: pl.DataFrame, rate_hz: float, *, start_m: float = 0.0, pointed: bool) -> pl.DataFrame:
    """Turn the generator's tracks, sorted by vehicle, frame, into true tracks without their place.

    SUMO's speed is that of the step before a frame, and so is its acceleration; the rates of change at a frame are
    the mean of the speeds before and after it, and the acceleration between them.

    Args:
        tracks: simulated tracks under the file's ids.
        rate_hz: frames per second.
        start_m: position in the generator's frame at which x_m is 0.
        pointed: the format records boxes about the body's middle, so that the front lies where the vehicle points.
    """
    half, window = pl.col("length") / 2, 2 * round(HEADING_S * rate_hz) + 1
    ahead, aside = (
        pl.col(name).rolling_mean(window, min_samples=1, center=True).over("vehicle")
        for name in ("speed", "lateral_speed")
    )
    moves = (ahead > 0) & (ahead.pow(2) + aside.pow(2) >= LEAST_HEADING_MPS**2)
    heading = pl.when(moves).then(pl.arctan2(aside, ahead)).forward_fill().over("vehicle").fill_null(0.0)
    fronts = tracks.with_columns(heading=heading if pointed else pl.lit(0.0)).with_columns(
        x_m=pl.col("x") - start_m - half * (1 - pl.col("heading").cos()),
        y_m=pl.col("y") + half * pl.col("heading").sin(),
    )
    after, before = (pl.col("y_m").shift(step).over("vehicle") for step in (-1, 1))
    apart = after.is_not_null().cast(pl.Int8) + before.is_not_null().cast(pl.Int8)
    sideways = (after.fill_null(pl.col("y_m")) - before.fill_null(pl.col("y_m"))) * rate_hz
    return fronts.select(
        "frame",
        "lane",
        pl.col("x_m", "y_m").round(4),
        vehicle_id="vehicle",
        speed_mps=(pl.col("speed") + pl.col("speed").shift(-1).over("vehicle").fill_null(pl.col("speed"))) / 2,
        accel_mps2=pl.col("accel").shift(-1).over("vehicle").fill_null(pl.col("accel")),
        lateral_speed_mps=pl.when(apart > 0).then(sideways / apart).otherwise(0.0),
    )
