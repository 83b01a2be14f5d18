"""Entries written by hand for the tests of identities: 10 Hz, so that 10 m/s is 1 m a frame."""

import polars as pl

from tracklake.pipeline.transforms.tracks.identities import identify_vehicles

TOP = 2**31 - 1
CONSTANTS = ("announced", "length")
SCHEMA = {
    "source_id": pl.Int32,
    "frame": pl.Int32,
    "announced": pl.Int32,
    "length": pl.Float64,
    "x_m": pl.Float64,
    "y_m": pl.Float64,
    "speed_mps": pl.Float64,
    "lane": pl.Int16,
    "leader_source_id": pl.Int32,
    "follower_source_id": pl.Int32,
}


def entry(source, frame, x_m, y_m=0.0, *, speed=10.0, announced=None, length=4.0, lane=1, leader=0, follower=0):
    """One row of SCHEMA."""
    return (source, frame, announced, length, x_m, y_m, speed, lane, leader, follower)


def drive(source, frames, x_m, y_m=0.0, *, metres=1.0, speed=10.0, **values):
    """A vehicle at x_m in the first of the frames, going some metres a frame."""
    first = frames[0]
    return [entry(source, frame, x_m + metres * (frame - first), y_m, speed=speed, **values) for frame in frames]


def identify(rows, *, one_way=True, frame_rate_hz=10.0):
    """What identify_vehicles makes of rows in any order."""
    return identify_vehicles(
        pl.DataFrame(rows, schema=SCHEMA, orient="row"),
        constants=CONSTANTS,
        frame_rate_hz=frame_rate_hz,
        announced="announced",
        one_way=one_way,
    )


def tracks_of(found):
    """{vehicle_id: [(frame, x_m), ...]}."""
    return {
        vehicle: rows.select("frame", "x_m").rows()
        for (vehicle,), rows in found.entries.partition_by("vehicle_id", as_dict=True).items()
    }


def places(rows):
    """[(frame, x_m), ...] of rows of SCHEMA."""
    return sorted((row[1], row[4]) for row in rows)
