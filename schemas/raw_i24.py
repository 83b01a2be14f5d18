"""I-24 MOTION's trajectories as shipped (INCEPTION release): a JSON list of documents, one a trajectory, in feet.

Keys follow a published document of github.com/I24-MOTION/data_tutorial. Of its keys only those that the lake keeps are
declared; length, width and height may be arrays.
"""

import polars as pl

from tracklake.schemas.columns import Table, column

RAW_I24_FIELDS = (
    *("_id", "timestamp", "x_position", "y_position", "road_segment_ids", "flags", "length", "width", "height"),
    *("merged_ids", "fragment_ids", "coarse_vehicle_class", "fine_vehicle_class", "direction", "compute_node_id"),
    *("local_fragment_id", "starting_x", "first_timestamp", "configuration_id", "ending_x", "last_timestamp"),
    *("x_score", "y_score"),
)
"""Keys of a document, in order."""
MILE_FT = 5280
"""Feet in a mile."""

RAW_I24 = Table(
    "raw_i24",
    "One row per document and time.",
    key=("line", "timestamp"),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the document in its file, from 1: the vehicle's id", ge=1, le=2**31 - 1),
        "timestamp": column(pl.Float64, "since 1970", unit="s", ge=0, le=1e10),
        "x_position": column(
            pl.Float64,
            "along the road by mile posts, back centre; falls westbound",
            unit="ft",
            ge=57 * MILE_FT,
            le=65 * MILE_FT,
        ),
        "y_position": column(pl.Float64, "across the road, back centre", unit="ft", ge=-500, le=500),
        "direction": column(pl.Int8, "1 eastbound, -1 westbound", ge=-1, le=1),
        "length": column(pl.Float64, "of the vehicle (the median of several)", unit="ft", ge=0, le=300, nullable=True),
        "width": column(pl.Float64, "the same of the width", unit="ft", ge=0, le=60, nullable=True),
        "coarse_vehicle_class": column(
            pl.Int16, "0 sedan, 1 midsize, 2 pickup, 3 van, 4 semi, 5 truck, 6 motorcycle", nullable=True
        ),
        "synthetic": column(pl.Boolean, "whether the document's _id says that it was generated"),
    },
)
