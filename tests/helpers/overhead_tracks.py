"""Overhead tracks with numbers that tests can work out by hand: vehicles at constant speed on a straight road."""

from collections.abc import Mapping

import polars as pl

FACTS = {"dataset": "highd", "subset": "01-lower"}


def make_tracks(
    vehicles: Mapping[int, tuple[float, float, float]], *, seconds: float = 6.0, rate_hz: float = 25.0
) -> pl.DataFrame:
    """Entries of vehicles that drive at a constant speed: `x_m` of the front at time 0, `y_m` and speed by id."""
    frames = round(seconds * rate_hz) + 1
    return pl.concat(
        pl.DataFrame(
            {
                "vehicle_id": pl.Series([vehicle] * frames, dtype=pl.Int32),
                "frame": pl.int_range(1, frames + 1, dtype=pl.Int32, eager=True),
            }
        ).with_columns(
            time_s=(pl.col("frame") - 1) / rate_hz,
            x_m=x_m + speed_mps * (pl.col("frame") - 1) / rate_hz,
            y_m=pl.lit(y_m),
            speed_mps=pl.lit(speed_mps, pl.Float32),
            accel_mps2=pl.lit(0.0, pl.Float32),
            lane=pl.lit(2, pl.Int16),
        )
        for vehicle, (x_m, y_m, speed_mps) in vehicles.items()
    )


def make_vehicles(sizes: Mapping[int, tuple[str | None, float | None, float | None]]) -> pl.DataFrame:
    """Class, length and width of vehicles by id."""
    rows = [(vehicle, *size) for vehicle, size in sizes.items()]
    schema = {"vehicle_id": pl.Int32, "class": pl.String, "length_m": pl.Float32, "width_m": pl.Float32}
    return pl.DataFrame(rows, schema=schema, orient="row")
