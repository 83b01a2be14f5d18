"""`splits`, their recipes, the balance of their parts, and the vehicles that are in none."""

import polars as pl

from tracklake.schemas.columns import DATASET, PARTS, PLACE, Table, column

SPLITS = Table(
    "splits",
    "One row per (split, subset, block): where the entries of its frames and vehicles go. An entry within no row is in "
    "no part; nor is one of a vehicle in `split_left_out`, but in train.",
    key=("split", "dataset", "subset", "block"),
    partition=(),
    columns={
        "split": column(pl.String, "the split's name"),
        **PLACE,
        "block": column(
            pl.Int32, "counted from 0 in each subset; what is seen around a sample never lies beyond its block", ge=0
        ),
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
        "vehicles": column(pl.Int64, "vehicles that give entries to the part, each counted once", ge=0),
        "vehicle_share": column(pl.Float64, "of the vehicles of all parts of the dataset", ge=0, le=1),
        "samples": column(pl.Int64, "kept samples in the part, of vehicles that are not left out of it", ge=0),
        "vehicles_per_lane_s_mean": column(
            pl.Float64, "sample-weighted mean of subsets.vehicles_per_lane_s", unit="veh/lane/s", nullable=True
        ),
        "vehicles_per_lane_s_std": column(
            pl.Float64,
            "sample-weighted standard deviation of subsets.vehicles_per_lane_s",
            unit="veh/lane/s",
            nullable=True,
        ),
        "relaxed": column(pl.Boolean, "True where the lake is too small to meet every constraint of the split"),
        "relaxed_reason": column(pl.String, "which constraint, and by how much", nullable=True),
    },
)


SPLIT_LEFT_OUT = Table(
    "split_left_out",
    "One row per (split, vehicle) with entries in two parts: it gives no samples and no context to val and eval.",
    key=("split", "dataset", "subset", "vehicle_id"),
    partition=(),
    columns={
        "split": column(pl.String, "the split's name"),
        **PLACE,
        "vehicle_id": column(pl.Int32, "in two parts", ge=0),
        "parts": column(pl.String, "in which it has entries, in the order train, val, eval"),
        "entries": column(pl.Int64, "of it in val and eval, which go into no part", ge=1),
    },
)


SPLIT_RECIPES = Table(
    "split_recipes",
    "One row per split: what it is made by.",
    key=("split",),
    partition=(),
    columns={
        "split": column(pl.String, "the split's name"),
        "meaning": column(pl.String, "how it divides"),
        "claims_no_leakage": column(pl.Boolean, "whether `tracklake split` fails where its parts share anything"),
        "trains": column(pl.Boolean, "whether tensors are made of it"),
        "window_s": column(pl.Float64, "history and future of a sample together", unit="s", gt=0),
        "digest": column(pl.String, "first 12 hex digits of the sha256 of name and parameters"),
        "parameters": column(pl.String, "every one that the split is made by, as JSON"),
    },
)
