"""`split_leakage`, `split_context`, `split_shifts`: what the parts of a split share, and how they differ."""

import polars as pl

from tracklake.schemas.columns import DATASET, PARTS, Table, column

QUANTITIES = ("vehicles_per_lane_s", "speed", "left", "right", "brake")
"""Quantities whose distributions are compared: veh/lane/s, m/s, and 0 or 1 for each sample's maneuver."""
_SPLIT = column(pl.String, "the split's name")
_PART = column(pl.String, "one part: train or val", isin=PARTS)
_OTHER = column(pl.String, "a later one: val or eval", isin=PARTS)

SPLIT_LEAKAGE = Table(
    "split_leakage",
    "One row per (split, dataset, pair of parts): what both hold, and what there is of it.",
    key=("split", "dataset", "part", "other_part"),
    partition=(),
    columns={
        "split": _SPLIT,
        "dataset": DATASET,
        "part": _PART,
        "other_part": _OTHER,
        "vehicles_shared": column(pl.Int64, "vehicles with entries in both parts", ge=0),
        "vehicles": column(pl.Int64, "with entries in the other part", ge=0),
        "frames_shared": column(
            pl.Int64,
            "frames of a subset in which both parts have entries; recordings that follow one another in clock time are "
            "not compared",
            ge=0,
        ),
        "frames": column(pl.Int64, "frames of a subset in which the other part has entries", ge=0),
        "scenes_shared": column(pl.Int64, "moments of a subset at which both parts have samples", ge=0),
        "scenes": column(pl.Int64, "moments of a subset at which the other part has samples", ge=0),
        "context_shared": column(pl.Int64, "neighbors of samples of either part that are in the other one", ge=0),
        "context": column(pl.Int64, "neighbors of the samples of both parts", ge=0),
        "nearest_s": column(
            pl.Float64,
            "least time between an entry of one part and an entry of the other in the same subset; null where no "
            "subset is in both; recordings that follow one another in clock time are not compared",
            unit="s",
            nullable=True,
            ge=0,
        ),
    },
)

SPLIT_CONTEXT = Table(
    "split_context",
    "One row per (split, dataset, part) with samples: what the part's samples see.",
    key=("split", "dataset", "part"),
    partition=(),
    columns={
        "split": _SPLIT,
        "dataset": DATASET,
        "part": column(pl.String, "train, val or eval", isin=PARTS),
        "samples": column(
            pl.Int64, "whose history and least future lie in their block, of vehicles that are not left out", ge=0
        ),
        "neighbors": column(pl.Int64, "of these samples, as `neighbors` has them", ge=0),
        "neighbors_elsewhere": column(pl.Int64, "of these neighbors, those in another part or block: cut off", ge=0),
        "neighbors_left_out": column(pl.Int64, "of these neighbors, those in no part: cut off", ge=0),
    },
)

SPLIT_SHIFTS = Table(
    "split_shifts",
    "One row per (split, dataset, pair of parts, quantity): how its distributions differ.",
    key=("split", "dataset", "part", "other_part", "quantity"),
    partition=(),
    columns={
        "split": _SPLIT,
        "dataset": DATASET,
        "part": _PART,
        "other_part": _OTHER,
        "quantity": column(
            pl.String,
            "vehicles_per_lane_s (of the subset or block, of each sample), speed (recorded, of each entry, to 0.1 "
            "m/s), left, right, brake (1 for samples with that maneuver, else 0)",
            isin=QUANTITIES,
        ),
        "mean": column(pl.Float64, "in the part; of a maneuver its share"),
        "other_mean": column(pl.Float64, "in the other part"),
        "std": column(pl.Float64, "standard deviation in the part", ge=0),
        "other_std": column(pl.Float64, "in the other part", ge=0),
        "shift": column(
            pl.Float64,
            "greatest difference of the two cumulative distributions (Kolmogorov and Smirnov's); of a maneuver the "
            "difference of its shares",
            ge=0,
            le=1,
        ),
    },
)
