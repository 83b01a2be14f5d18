"""`findings`: runs of entries that break a rule."""

import polars as pl

from tracklake.schemas.columns import PLACE, SEVERITIES, Table, column

FINDINGS = Table(
    "findings",
    "One row per run of consecutive entries of one vehicle that breaks one rule.",
    key=("rule", "vehicle_id", "first_frame"),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "whose entries they are", ge=0),
        "rule": column(pl.String, "the rule's name"),
        "severity": column(pl.String, "error, warning or info", isin=SEVERITIES),
        "first_frame": column(pl.Int32, "first entry of the run"),
        "last_frame": column(pl.Int32, "last entry of the run"),
        "entries": column(pl.Int32, "entries in the run", ge=1),
        "worst": column(pl.Float64, "the most extreme value in the run, in the rule's unit"),
    },
)
