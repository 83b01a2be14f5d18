"""Files derived from others: rows of a recording that a file with more columns repeats."""

from collections.abc import Sequence

import polars as pl

from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.csv import LINE

IN_FULLER_FILE = "duplicate row: the same entry stands in a fuller file"


def split_derived(
    rows: pl.DataFrame, shares: Sequence[pl.DataFrame], essential: Sequence[str]
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split rows from those that a fuller file of the recording repeats; the kept rows gain the others' extra values.

    A file that lacks columns (no lane, no size) holds the same entries with fewer values, so its rows are no exact
    repetitions. Such a row is dropped if a row of a file with more columns has the same values in all shared columns.
    If the dropped row has a column that the fuller file lacks, its value is first copied to the fuller file's row.

    `shares` are the rows of each file in the order of FILE; a file has the columns that are not all null. Files that do
    not share the `essential` columns, which identify an entry, are not compared. Returns (rows to keep, rows that a
    fuller file repeats), in the given order; the latter unchanged.
    """
    present = [frozenset(_find_filled(share) & set(rows.columns)) for share in shares]
    # Files without a row of the recording have no columns.
    kinds = sorted({columns for columns in present if columns}, key=lambda columns: (-len(columns), sorted(columns)))
    if len(kinds) < 2:
        return rows, rows.clear()
    of_kind = [
        rows.filter(pl.col(FILE).is_in([file for file, columns in enumerate(present) if columns == kind]))
        for kind in kinds
    ]
    filled = [set(kind) for kind in kinds]
    dropped = [rows.clear().select(FILE, LINE)]
    # From the fewest columns up, so that a copied value can be copied on to a still fuller file.
    for number in range(len(kinds) - 1, 0, -1):
        for fuller, columns in enumerate(kinds[:number]):
            common = sorted(columns & kinds[number])
            if set(essential) <= set(common):
                repeating = of_kind[number].join(of_kind[fuller], on=common, how="semi", nulls_equal=True)
                dropped.append(repeating.select(FILE, LINE))
                further = sorted(filled[number] - columns)
                of_kind[fuller] = _fill_nulls(of_kind[fuller], repeating, common, further)
                filled[fuller] |= set(further)
    repeated = pl.concat(dropped)
    if repeated.is_empty():
        return rows, rows.clear()
    key = [FILE, LINE]
    kept = rows.select(key).join(repeated, on=key, how="anti", maintain_order="left")
    kept = kept.join(pl.concat(of_kind), on=key, how="left", maintain_order="left").select(rows.columns)
    return kept, rows.join(repeated, on=key, how="semi", maintain_order="left")


def _fill_nulls(
    rows: pl.DataFrame, repeating: pl.DataFrame, common: Sequence[str], further: Sequence[str]
) -> pl.DataFrame:
    """Fill nulls of further columns from the first repeating row that is equal in the common columns."""
    if not further or repeating.is_empty():
        return rows
    found = repeating.sort(FILE, LINE).unique(common, keep="first").select(*common, *further)
    joined = rows.join(found, on=common, how="left", nulls_equal=True, maintain_order="left", suffix=_FOUND)
    return joined.select(
        pl.coalesce(name, f"{name}{_FOUND}") if name in further else pl.col(name) for name in rows.columns
    )


_FOUND = " found"


def _find_filled(share: pl.DataFrame) -> set[str]:
    return {name for name in share.columns if name not in (FILE, LINE) and share[name].null_count() < share.height}
