"""`splits` and `split_balance`: which subset trains, which evaluates, and how alike the parts are."""

import polars as pl

from schemas.columns import DATASET, PARTS, SUBSET, Table, column

SPLITS = Table(
    "splits",
    "One row per (split, subset, block): where its samples go.",
    key=("split", "dataset", "subset", "block"),
    partition=(),
    columns={
        "split": column(pl.String, "the split's name"),
        "dataset": DATASET,
        "subset": SUBSET,
        "block": column(pl.Int32, "0 where the subset stands undivided", ge=0),
        "first_frame": column(pl.Int32, "of the block"),
        "last_frame": column(pl.Int32, "of the block"),
        "first_vehicle_id": column(pl.Int32, "lowest id of the part; null = all", nullable=True),
        "last_vehicle_id": column(pl.Int32, "highest id of the part; null = all", nullable=True),
        "part": column(pl.String, "train, val or eval", isin=PARTS),
    },
)


SPLIT_BALANCE = Table(
    "split_balance",
    "One row per (split, dataset, part): how the part compares.",
    key=("split", "dataset", "part"),
    partition=(),
    columns={
        "split": column(pl.String, "the split's name"),
        "dataset": DATASET,
        "part": column(pl.String, "train, val or eval", isin=PARTS),
        "subsets": column(pl.Int32, "carriageways in the part", ge=0),
        "vehicles": column(pl.Int64, "vehicles in the part", ge=0),
        "vehicle_share": column(pl.Float64, "of the dataset's vehicles", ge=0, le=1),
        "samples": column(pl.Int64, "kept samples in the part: the weight of its subsets", ge=0),
        "flow_mean": column(pl.Float64, "sample-weighted mean of flow", unit="veh/lane/s", nullable=True),
        "flow_std": column(
            pl.Float64,
            "sample-weighted standard deviation of flow",
            unit="veh/lane/s",
            nullable=True,
        ),
        "relaxed": column(
            pl.Boolean,
            "True where the lake is too small to meet every constraint of the split",
        ),
        "relaxed_reason": column(pl.String, "which constraint, and by how much", nullable=True),
    },
)
