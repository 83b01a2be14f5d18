"""Accounting of every row: exact duplicates, the ingest log, the rejects."""

from collections.abc import Sequence

import polars as pl

from tracklake.pipeline.sources.csv import LINE, REJECT_SCHEMA, fetch_lines
from tracklake.pipeline.sources.source import Part, RowOrder
from tracklake.schemas import INGEST_LOG, REJECTS

FILE = "file_index"
"""Column with the number of a row's file among its recording's files."""
DUPLICATE = "duplicate row"
CONFLICT = "another row has the same vehicle and frame"


def split_duplicates(rows: pl.DataFrame, key: Sequence[str]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split rows from exact repetitions of earlier ones, both sorted by key, then by values, then by file and line.

    `rows` have FILE and LINE and are in the order of these two; `key` is one or two Int32 columns.
    """
    values = [name for name in rows.columns if name not in (FILE, LINE)]
    rest = [name for name in values if name not in key]
    rows = rows.with_columns(_pack(key).alias(_PACKED))
    if not rows[_PACKED].is_sorted():
        # One packed number sorts three times as fast as its columns.
        rows = rows.sort(_PACKED, maintain_order=True)
    repeated = rows.select((pl.col(_PACKED) == pl.col(_PACKED).shift(1)).any()).item()
    rows = rows.drop(_PACKED)
    # Comparing all columns takes seconds and is needed only if a key repeats.
    if not repeated:
        return rows, rows.clear()
    rows = rows.sort([*key, *rest, FILE, LINE], maintain_order=False)
    same = pl.all_horizontal(pl.col(name).eq_missing(pl.col(name).shift(1)) for name in values)
    rows = rows.with_columns((same & (pl.int_range(pl.len()) > 0)).alias("repeats"))
    first, again = rows.filter(~pl.col("repeats")).drop("repeats"), rows.filter("repeats").drop("repeats")
    return first, again


_PACKED = "packed_key"


def find_row_order(rows: pl.DataFrame, vehicle: str, frame: str) -> RowOrder:
    """Tell by what the rows of a recording are sorted in its files; vehicle and frame are Int32 columns."""
    if rows.select(_pack([vehicle, frame])).to_series().is_sorted():
        return "vehicle"
    return "frame" if rows.select(_pack([frame, vehicle])).to_series().is_sorted() else "other"


def _pack(key: Sequence[str]) -> pl.Expr:
    """Pack one or two non-negative Int32 columns into an Int64 of the same order."""
    packed = pl.lit(0, pl.Int64)
    for name in key:
        packed = packed * 2**31 + pl.col(name).cast(pl.Int64)
    return packed


def account_rows(
    dataset: str,
    recording: str | None,
    parts: Sequence[Part],
    rows_parsed: Sequence[int],
    dropped: Sequence[tuple[pl.DataFrame, str]],
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Build the ingest log and the rejects of one recording; read = kept + dropped for each file.

    `rows_parsed` counts the parsed rows of each part; `dropped` are sets of parsed rows (FILE, LINE) that were dropped
    later, each with its reason. Returns (schemas.INGEST_LOG with one row per file, schemas.REJECTS).
    """
    later = [rows.select(FILE, LINE, reason=pl.lit(reason)) for rows, reason in dropped]
    rejects, log = [], []
    for index, (part, parsed) in enumerate(zip(parts, rows_parsed, strict=True)):
        at_parsing = part.rejects if part.rejects is not None else pl.DataFrame(schema=REJECT_SCHEMA)
        mine = pl.concat([rows.filter(pl.col(FILE) == index) for rows in later] or [pl.DataFrame(schema=_LATER)])
        if not mine.is_empty():
            mine = mine.join(fetch_lines(part.file, mine[LINE]), on=LINE, how="left")
        refused = pl.concat([at_parsing, mine.select(*REJECT_SCHEMA)] if not mine.is_empty() else [at_parsing])
        reasons = refused.group_by("reason").agg(pl.len().cast(pl.Int64).alias("rows")).sort("reason")
        log.append(
            {
                "dataset": dataset,
                "recording": recording,
                "file": part.file.name,
                "sha256": part.file.sha256,
                "dialect": part.file.dialect,
                "rows_read": parsed + at_parsing.height,
                "rows_kept": parsed - mine.height,
                "rows_dropped": refused.height,
                "dropped_by_reason": reasons.to_dicts(),
            }
        )
        rejects.append(refused.with_columns(file=pl.lit(part.file.name)))
    return pl.DataFrame(log, schema=INGEST_LOG.dtypes).sort(INGEST_LOG.key), _to_rejects(
        pl.concat(rejects), dataset, recording
    )


_LATER = {FILE: pl.Int64(), LINE: pl.Int64(), "reason": pl.String()}


def _to_rejects(rejects: pl.DataFrame, dataset: str, recording: str | None) -> pl.DataFrame:
    """Turn rejected lines into rows of schemas.REJECTS, one per line."""
    return (
        rejects.with_columns(dataset=pl.lit(dataset), recording=pl.lit(recording, pl.String))
        .lazy()
        .pipe(REJECTS.conform)
        .unique(subset=["file", "line"], keep="first", maintain_order=True)
        .sort(REJECTS.key)
        .collect()
    )
