"""`subsets`: one row per carriageway of a recording; `subset_status`: whether validation excludes it."""

import polars as pl

from tracklake.schemas.columns import DATASET, SUBSET, Table, column

SOURCE_FILE = pl.Struct({"file": pl.String(), "sha256": pl.String()})

SUBSETS = Table(
    "subsets",
    "One row per subset: the unit of parallelism, splitting and reporting.",
    key=("subset",),
    columns={
        "dataset": DATASET,
        "subset": SUBSET,
        "recording": column(pl.String, "one continuous camera recording"),
        "site": column(pl.String, "where it was recorded"),
        "direction": column(pl.String, "of travel: upper/lower (highD) or north/south/east/west"),
        "freeway": column(
            pl.Boolean,
            "False for arterials, which take no part in late starts, samples and splits",
        ),
        "frame_rate_hz": column(pl.Float64, "of the source", unit="Hz", gt=0),
        "lanes": column(
            pl.Int16,
            "main lanes of the carriageway; null where unknown",
            nullable=True,
            ge=1,
        ),
        "seconds": column(pl.Float64, "length of the recording", unit="s", gt=0),
        "first_frame": column(pl.Int32, "the recording's first frame, where time_s = 0"),
        "last_frame": column(pl.Int32, "the subset's last frame"),
        "vehicles": column(pl.Int32, "tracks in the subset", ge=1),
        "entries": column(pl.Int64, "rows of tracks", ge=1),
        "flow_vphpl": column(
            pl.Float64,
            "flow by Edie's definition: distance driven on the main lanes / (length of the section * lanes * seconds); "
            "null where the lanes or the length are unknown",
            unit="veh/h/lane",
            nullable=True,
        ),
        "vehicles_per_lane_s": column(
            pl.Float64,
            "vehicles / lanes / seconds, which flow-balanced splits balance; it counts all that were seen, also those "
            "on the road at the start, and is no flow; null where the lanes are unknown",
            unit="veh/lane/s",
            nullable=True,
        ),
        "ids_split": column(pl.Int32, "source ids that stood for more than one vehicle", ge=0),
        "on_ramp_lanes": column(pl.List(pl.Int16()), "lanes that are on-ramps"),
        "lane_markings_m": column(
            pl.List(pl.Float64),
            "y_m of the markings, leftmost (0) first; null where the source has none",
            unit="m",
            nullable=True,
        ),
        "columns_missing": column(pl.List(pl.String), "columns of tracks that the source does not have"),
        "source_files": column(pl.List(SOURCE_FILE), "the raw files and their sha256"),
    },
)


SUBSET_STATUS = Table(
    "subset_status",
    "One row per subset: what validation decided about the whole of it.",
    key=("subset",),
    columns={
        "dataset": DATASET,
        "subset": SUBSET,
        "backward_vehicles": column(pl.Int32, "vehicles with any entry of negative speed", ge=0),
        "excluded": column(pl.Boolean, "kept in the lake, out of samples and splits"),
        "excluded_reason": column(pl.String, "null unless excluded", nullable=True),
    },
)
