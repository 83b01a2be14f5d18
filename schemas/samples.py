"""`samples`, `sample_drops` and `neighbors`: prediction origins, what was left out, and who stands around them."""

import polars as pl

from schemas.columns import DATASET, LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PROTOCOL, SUBSET, Table, column

CELLS = 39
"""Cells of the neighbor grid: 13 rows x 3 columns (left, own, right)."""

SAMPLES = Table(
    "samples",
    "One row per usable sample, at the protocol's rate.",
    key=("protocol", "vehicle_id", "tick"),
    columns={
        "protocol": PROTOCOL,
        "dataset": DATASET,
        "subset": SUBSET,
        "vehicle_id": column(pl.Int32, "whose future is predicted", ge=0),
        "tick": column(pl.Int32, "time_s = tick / the protocol's rate", ge=0),
        "frame": column(
            pl.Int32,
            "the source's frame on the tick; null where none falls on it",
            nullable=True,
        ),
        "lane": column(pl.Int16, "lane at the tick"),
        "lateral_maneuver": column(pl.String, "keep, left or right", isin=LATERAL_MANEUVERS),
        "longitudinal_maneuver": column(pl.String, "normal or brake", isin=LONGITUDINAL_MANEUVERS),
    },
)


SAMPLE_DROPS = Table(
    "sample_drops",
    "One row per (protocol, subset, reason): entries on the protocol's clock that are no samples.",
    key=("protocol", "reason"),
    columns={
        "protocol": PROTOCOL,
        "dataset": DATASET,
        "subset": SUBSET,
        "reason": column(pl.String, "the first that applies"),
        "entries": column(pl.Int64, "entries dropped", ge=1),
    },
)


NEIGHBORS = Table(
    "neighbors",
    "One row per (sample, neighbor) in the 13 x 3 grid around the sample.",
    key=("protocol", "vehicle_id", "tick", "cell"),
    columns={
        "protocol": PROTOCOL,
        "dataset": DATASET,
        "subset": SUBSET,
        "vehicle_id": column(pl.Int32, "the sample's vehicle", ge=0),
        "tick": column(pl.Int32, "the sample's tick", ge=0),
        "cell": column(
            pl.Int8,
            "13 * column + row; columns left, own, right; row 6 is alongside, 12 ahead",
            ge=0,
            lt=CELLS,
        ),
        "neighbor_id": column(pl.Int32, "who stands there", ge=0),
        "dx_m": column(pl.Float32, "neighbor's x_m - own x_m", unit="m"),
    },
)
