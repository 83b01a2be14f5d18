"""`completeness`: figures that publishers and metadata announce, beside those of the lake."""

import polars as pl

from tracklake.schemas.columns import DATASET, Table, column

RECORDING_META, TRACKS_META, PUBLISHED, TOTAL_FRAMES = "recordingMeta", "tracksMeta", "published", "Total_Frames"
AUTHORITIES = (RECORDING_META, TRACKS_META, PUBLISHED, TOTAL_FRAMES)

MEASURES = {
    "vehicles": "vehicles with rows (source ids)",
    "cars": "of them, cars",
    "trucks": "of them, trucks",
    "entries": "rows kept; where each vehicle announces its own, those of the vehicles that do",
    "vehicles_without_rows": "announced vehicles of which no row was kept",
    "vehicles_incomplete": "vehicles with another number of rows than they announce (none at all apart)",
    "first_frames_differ": "vehicles whose first row is of another frame than announced",
    "last_frames_differ": "vehicles whose last row is of another frame than announced",
}
"""Measures of a recording by name; `vehicles_...` and `..._differ` are expected to be 0."""

PUBLISHED_TOTALS: dict[str, dict[str, int]] = {
    "i-80-1600": {"vehicles": 2_052, "entries": 1_262_678},
    "i-80-1700": {"vehicles": 1_836, "entries": 1_549_918},
    "i-80-1715": {"vehicles": 1_790, "entries": 1_753_791},
    "us-101-0750": {"vehicles": 2_169, "entries": 1_180_598},
    "us-101-0805": {"vehicles": 2_017, "entries": 1_403_095},
    "us-101-0820": {"vehicles": 1_915, "entries": 1_515_240},
}
"""Vehicles (ids) and rows of NGSIM's freeway recordings as published; together 11,779 and 8,665,320."""

COMPLETENESS = Table(
    "completeness",
    "One row per (recording, measure, authority): how much there should be and how much was found. Measures: "
    + "; ".join(f"`{name}`: {meaning}" for name, meaning in MEASURES.items())
    + ". Which vehicles they are: `SELECT * FROM vehicles WHERE entries <> entries_announced` (on arterials a vehicle "
    "that turns is in several subsets, whose entries add up; here they are counted together).",
    key=("recording", "measure", "authority"),
    partition=("dataset",),
    columns={
        "dataset": DATASET,
        "recording": column(pl.String, "one continuous camera recording"),
        "measure": column(pl.String, "what is counted", isin=tuple(MEASURES)),
        "authority": column(
            pl.String,
            "who announces it: recordingMeta, tracksMeta (levelXdata), Total_Frames (NGSIM, per vehicle) or published "
            "(NGSIM's freeways)",
            isin=AUTHORITIES,
        ),
        "expected": column(pl.Int64, "as announced; null where the files do not say", nullable=True, ge=0),
        "found": column(pl.Int64, "figure of the lake; null where it is unknown", nullable=True, ge=0),
        "agrees": column(pl.Boolean, "found = expected; null where either is unknown", nullable=True),
        "rows_dropped": column(
            pl.Int64,
            "beside entries: rows in rejects that could be some of those missing (not blank lines, repeated headers, "
            "lines that belong to no recording, or what several files repeat)",
            nullable=True,
            ge=0,
        ),
    },
)
