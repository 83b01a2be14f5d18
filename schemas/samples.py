"""`samples`, the entries that are none (`sample_drops`, `sample_counts`), and the `neighbors` of samples."""

import polars as pl

from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PLACE, PROTOCOL, Table, column

CELLS = 39
"""Cells of the neighbor grid: 13 rows x 3 columns (left, own, right)."""

SAMPLES = Table(
    "samples",
    "One row per usable sample, at the protocol's rate.",
    key=("protocol", "vehicle_id", "tick"),
    columns={
        "protocol": PROTOCOL,
        **PLACE,
        "vehicle_id": column(pl.Int32, "whose future is predicted", ge=0),
        "tick": column(pl.Int32, "time_s = tick / the protocol's rate", ge=0),
        "frame": column(pl.Int32, "the source's frame on the tick; null where none falls on it", nullable=True),
        "lane": column(pl.Int16, "lane at the tick; in protocols that fold lanes (csp), at most 6 on US-101"),
        "lateral_maneuver": column(
            pl.Enum(LATERAL_MANEUVERS),
            "left or right where the lane changes from 4 s before to now or from now to 4 s after, else keep",
        ),
        "longitudinal_maneuver": column(
            pl.Enum(LONGITUDINAL_MANEUVERS),
            "brake where the mean speed over the next 5 s is under 0.8 of that over the last 3 s, else normal",
        ),
        "nearest": column(
            pl.List(pl.Int32),
            "the nearest vehicles at the tick, whatever their lanes, the nearest first (of two equally far the smaller "
            "id); as many as the protocol lists, fewer only where there are no more; null where it lists none",
            nullable=True,
        ),
    },
)


SAMPLE_DROPS = Table(
    "sample_drops",
    "One row per (protocol, subset, reason): entries on the protocol's clock that are no samples.",
    key=("protocol", "reason"),
    columns={
        "protocol": PROTOCOL,
        **PLACE,
        "reason": column(pl.String, "the first that applies"),
        "entries": column(pl.Int64, "entries dropped", ge=1),
    },
)


SAMPLE_COUNTS = Table(
    "sample_counts",
    "One row per (protocol, subset): how many entries there were to choose from, and how the grid filled.",
    key=("protocol",),
    columns={
        "protocol": PROTOCOL,
        **PLACE,
        "entries_on_clock": column(pl.Int64, "entries on the protocol's clock: samples and dropped ones", ge=0),
        "samples": column(pl.Int64, "kept", ge=0),
        "neighbors": column(pl.Int64, "vehicles in the samples' grids", ge=0),
        "collisions": column(
            pl.Int64,
            "of those within the grids' reach, how many found their cell taken by a nearer one; they moved to the "
            "nearest free cell of the lane",
            ge=0,
        ),
        "all_collisions": column(
            pl.Int64,
            "the same in the grids of all entries at 10 Hz, samples or not, as published counts are; null without "
            "lanes or with a slower camera",
            nullable=True,
            ge=0,
        ),
        "crowded_out": column(pl.Int64, "collisions without a free cell, which are dropped", ge=0),
    },
)


NEIGHBORS = Table(
    "neighbors",
    "One row per (sample, neighbor) in the 13 x 3 grid around the sample.",
    key=("protocol", "vehicle_id", "tick", "cell"),
    columns={
        "protocol": PROTOCOL,
        **PLACE,
        "vehicle_id": column(pl.Int32, "the sample's vehicle", ge=0),
        "tick": column(pl.Int32, "the sample's tick", ge=0),
        "cell": column(
            pl.Int8, "13 * column + row; columns left, own, right; row 6 is alongside, 12 ahead", ge=0, lt=CELLS
        ),
        "neighbor_id": column(pl.Int32, "vehicle in the cell", ge=0),
        "dx_m": column(pl.Float32, "neighbor's x_m - own x_m", unit="m"),
    },
)
