"""Small recorded tracks, and their reconstruction with every table checked against its declaration."""

import polars as pl

from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.reconstruction import Reconstruction, reconstruct
from tracklake.schemas.reconstruction import (
    RECONSTRUCTED,
    RECONSTRUCTION_QUALITY,
    RECONSTRUCTION_SKIPS,
    UNKEPT_BOUNDS,
)

MAX_ID = 2**31 - 1


def make_facts(rate_hz=10.0, **others):
    return {"dataset": "custom", "subset": "s", "frame_rate_hz": rate_hz, "first_frame": 0, "freeway": True, **others}


def make_tracks(*vehicles, rate_hz=10.0):
    """Each vehicle is (id, frames, x_m) or (id, frames, x_m, leader_id)."""
    parts = [
        pl.DataFrame(
            {"vehicle_id": vehicle, "frame": list(frames), "x_m": x, "leader_id": leader[0] if leader else None}
        )
        for vehicle, frames, x, *leader in vehicles
    ]
    return pl.concat(
        [
            part.select(
                pl.col("vehicle_id", "frame", "leader_id").cast(pl.Int32),
                pl.col("x_m").cast(pl.Float64),
                time_s=pl.col("frame") / rate_hz,
                y_m=pl.lit(2.0),
                lane=pl.lit(1, pl.Int16),
            )
            for part in parts
        ]
    )


def make_vehicles(tracks, length_m=4.0, kind="car"):
    return tracks.select(pl.col("vehicle_id").unique().sort()).with_columns(
        pl.lit(kind, pl.String).alias("class"),
        length_m=pl.lit(length_m, pl.Float32),
        width_m=pl.lit(1.8, pl.Float32),
    )


def run_reconstruction(tracks, vehicles=None, rate_hz=10.0, config=None, **facts) -> Reconstruction:
    vehicles = make_vehicles(tracks) if vehicles is None else vehicles
    done = reconstruct(tracks, vehicles, make_facts(rate_hz, **facts), config or ReconstructionConfig())
    for table, frame in (
        (RECONSTRUCTED, done.entries),
        (RECONSTRUCTION_QUALITY, done.quality),
        (RECONSTRUCTION_SKIPS, done.skips),
        (UNKEPT_BOUNDS, done.unkept),
    ):
        table.validate(frame, where="test")
    return done
