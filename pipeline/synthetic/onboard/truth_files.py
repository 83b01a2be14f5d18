"""The truth of a synthetic drive as a CSV file, whose first line is its mark and the moment of tick 0."""

from pathlib import Path

import polars as pl

from tracklake.schemas.perception import SURROUNDING_TRUTH

MARK = "# tracklake drive truth"
"""First words of the file."""
COLUMNS = (
    *(name for name in SURROUNDING_TRUTH.columns if name not in ("dataset", "subset", "vehicle_id")),
    "temporary_id",
)
"""Columns of the file: those of `surrounding_truth`, with the id that the vehicle sends instead of the drive's own."""


def write_truth(path: Path, truth: pl.DataFrame, start_us: int) -> None:
    """Write the rows of COLUMNS, whose ticks count from `start_us`, microseconds since 1970."""
    rows = truth.select(COLUMNS).sort("truth_id", "tick").write_csv(float_precision=4)
    path.write_text(f"{MARK} start_us={start_us}\n{rows}", encoding="utf-8", newline="\n")
