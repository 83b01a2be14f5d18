"""TGSIM's trajectory files as shipped: one row per vehicle and tenth of a second, in metres of a reference image.

Names are those of the portal's export (`xloc_kf`); the original files write `xloc-kf`, `ID` and `ACC`. `av` and `acc`,
of which a site has one or neither, are `automated` here. Meanings follow the descriptions on data.transportation.gov
and doi.org/10.1177/03611981241257257. Positions are of the vehicle's middle, as users of the data read them.
"""

import polars as pl

from tracklake.schemas.columns import Table, column

RAW_TGSIM = Table(
    "raw_tgsim",
    "One row per line of a TGSIM trajectory file.",
    key=("line",),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "id": column(pl.Int32, "of the vehicle; restarts in every run", ge=0),
        "time": column(pl.Float64, "since a time of the run", unit="s", ge=0, le=100_000_000),
        "xloc_kf": column(pl.Float64, "to the right in the image", unit="m", ge=-20_000, le=20_000),
        "yloc_kf": column(pl.Float64, "down in the image", unit="m", ge=-20_000, le=20_000),
        "lane_kf": column(pl.Int16, "the site's number of the lane", ge=-100, le=100, nullable=True),
        "speed_kf": column(pl.Float64, "smoothed speed", unit="m/s", ge=-100, le=100),
        "acceleration_kf": column(pl.Float64, "smoothed acceleration", unit="m/s2", ge=-200, le=200, nullable=True),
        "length_smoothed": column(pl.Float64, "of the vehicle", unit="m", ge=0, le=100, nullable=True),
        "width_smoothed": column(pl.Float64, "of the vehicle", unit="m", ge=0, le=20, nullable=True),
        "type_most_common": column(
            pl.String,
            "small-vehicle, large-vehicle; I-395: 1 car, 2 truck, 3 bus, 4 automated vehicle",
            nullable=True,
        ),
        "automated": column(pl.String, "yes or no, in any case: one of the automated test vehicles", nullable=True),
        "run_index": column(pl.Int32, "number of the run; I-395 has none in its original file", ge=0, nullable=True),
    },
)

RAW_TGSIM_CENTRELINES = Table(
    "raw_tgsim_centrelines",
    "One row per lane and line of a file of lane centrelines, whose columns are x1, y1, ramp1, x2, ...",
    key=("lane", "line"),
    partition=(),
    columns={
        "lane": column(pl.Int16, "number in the columns' names: the site's number of the lane"),
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "x": column(pl.Float64, "to the right in the image", unit="m", ge=-20_000, le=20_000),
        "y": column(pl.Float64, "down in the image", unit="m", ge=-20_000, le=20_000),
        "ramp": column(pl.Float64, "0 no ramp, 1 on-ramp, 2 off-ramp, 3 weaving section", nullable=True),
    },
)
