"""Tracks for the tests of late starts: made by hand or at random, and the columns of `vehicles` that repair reads."""

import polars as pl
from lake_sources import EXCERPTS

US101 = EXCERPTS / "us101_0750_290_vehicles.csv.gz"
NAMES = {"dataset": "ngsim", "subset": "us-101-0750"}


def read_us101():
    """The real excerpt: its tracks and its first frame."""
    raw = pl.read_csv(US101).sort("Vehicle_ID", "Frame_ID")
    tracks = raw.select(
        vehicle_id=pl.col("Vehicle_ID").cast(pl.Int32),
        frame=pl.col("Frame_ID").cast(pl.Int32),
        x_m=pl.col("Local_Y") * 0.3048,
        lane=pl.lit(None, pl.Int16),
        speed_mps=(pl.col("v_Vel") * 0.3048).cast(pl.Float32),
    )
    return tracks, int(raw["Frame_ID"].min())


def make_tracks(entries):
    """(vehicle_id, frame, x_m, lane, speed_mps) rows."""
    schema = {"vehicle_id": pl.Int32, "frame": pl.Int32, "x_m": pl.Float64, "lane": pl.Int16, "speed_mps": pl.Float32}
    return pl.DataFrame(entries, schema=schema, orient="row")


def summarise(tracks):
    """The columns of `vehicles` that classify_starts reads."""
    return tracks.group_by("vehicle_id", maintain_order=True).agg(
        first_frame=pl.col("frame").first(),
        last_frame=pl.col("frame").last(),
        entries=pl.len().cast(pl.Int32),
        start_x_m=pl.col("x_m").first(),
        end_x_m=pl.col("x_m").last(),
        start_lane=pl.col("lane").first(),
    )


def drive(vehicle, first_frame, frames, *, m_per_frame=1.0, speed_mps=8.0, lane=1, start_x_m=0.0):
    """A steady track, whatever speed it records."""
    return [(vehicle, first_frame + i, start_x_m + i * m_per_frame, lane, speed_mps) for i in range(frames)]


def creep(random, vehicle, first_frame, *, frames=90, lanes=(1, 2, 3)):
    """A random walk that stops, backs up and changes lanes, by steps of random length."""
    x, lane, track = 0.0, int(random.choice(lanes)), []
    for i in range(frames):
        track.append((vehicle, first_frame + i, x, lane, float(random.uniform(0, 12))))
        x += float(random.choice([-0.4, 0.0, 0.7, 1.5]) * random.uniform(0.5, 1.5))
        lane = int(random.choice(lanes)) if random.random() < 0.05 else lane
    return track


def cross_slowly(track, x_m):
    """First crossing of x_m by a loop: frame, nearer entry; None where it is not reached."""
    for i, entry in enumerate(track):
        if entry[2] >= x_m:
            if i == 0:
                return entry[1], entry
            before = track[i - 1]
            share = (x_m - before[2]) / (entry[2] - before[2])
            nearer = before if x_m - before[2] <= entry[2] - x_m else entry
            return before[1] + share * (entry[1] - before[1]), nearer
    return None
