"""`ingest_log` and `rejects`: the account of every row read."""

import polars as pl

from tracklake.schemas.columns import DATASET, Table, column

REASON_COUNT = pl.Struct({"reason": pl.String(), "rows": pl.Int64()})

INGEST_LOG = Table(
    "ingest_log",
    "One row per (source file, recording): rows_read = rows_kept + rows_dropped, always. Lines that cannot be "
    "one of a file's several recordings are in a row whose recording is null.",
    key=("file",),
    partition=("dataset",),
    columns={
        "dataset": DATASET,
        "recording": column(pl.String, "recording of the rows; null = unknown", nullable=True),
        "file": column(pl.String, "path as given to ingest"),
        "sha256": column(pl.String, "of the file's bytes"),
        "dialect": column(pl.String, "how the file was read"),
        "rows_read": column(pl.Int64, "data rows (headers apart)", ge=0),
        "rows_kept": column(pl.Int64, "rows that became entries (or metadata)", ge=0),
        "rows_dropped": column(pl.Int64, "rows written to rejects", ge=0),
        "dropped_by_reason": column(pl.List(REASON_COUNT), "rows dropped, by reason"),
    },
)


REJECTS = Table(
    "rejects",
    "One row per dropped row of a source file.",
    key=("file", "line"),
    partition=("dataset",),
    columns={
        "dataset": DATASET,
        "recording": column(pl.String, "recording of the row; null = unknown", nullable=True),
        "file": column(pl.String, "path as given to ingest"),
        "line": column(pl.Int64, "line number in the file, from 1", ge=1),
        "reason": column(pl.String, "why it was dropped"),
        "text": column(pl.String, "the line itself"),
    },
)
