"""Files made from others: rows of a recording that stand in a fuller file of it as well."""

from collections.abc import Sequence

import polars as pl

from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.csv.raw_files import LINE

IN_FULLER_FILE = "duplicate row: the same entry stands in a fuller file"


def split_derived(
    rows: pl.DataFrame, shares: Sequence[pl.DataFrame], essential: Sequence[str]
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Part rows from those that a fuller file of the recording has too, which take over what only the others say.

    A file that lacks columns (no lane, no size) says less of the same entries, so that its rows are no exact
    repetitions. One of them is dropped if a row of a file with more columns has the same values in all columns that
    both files have; the others stay. Where the file has a column that the fuller one lacks (its only lanes, say), the
    fuller one's row gets the value first: of rows that differ in nothing else, the first one's.

    Args:
        rows: of all files, with FILE.
        shares: the rows of each file, in the order of FILE, to see what columns it has: those with any value.
        essential: columns that tell entries apart; without them in common nothing is compared.

    Returns:
        (rows to keep, rows that stand in a fuller file), in the order given; the latter as they were.
    """
    present = [frozenset(_filled(share) & set(rows.columns)) for share in shares]
    # Files that hold nothing of the recording have no columns either.
    kinds = sorted({columns for columns in present if columns}, key=lambda columns: (-len(columns), sorted(columns)))
    if len(kinds) < 2:
        return rows, rows.clear()
    of_kind = [
        rows.filter(pl.col(FILE).is_in([file for file, columns in enumerate(present) if columns == kind]))
        for kind in kinds
    ]
    said = [set(kind) for kind in kinds]
    dropped = [rows.clear().select(FILE, LINE)]
    # From the poorest up, so that what a row takes over goes on with it to a fuller file still.
    for number in range(len(kinds) - 1, 0, -1):
        for fuller, columns in enumerate(kinds[:number]):
            common = sorted(columns & kinds[number])
            if set(essential) <= set(common):
                repeating = of_kind[number].join(of_kind[fuller], on=common, how="semi", nulls_equal=True)
                dropped.append(repeating.select(FILE, LINE))
                further = sorted(said[number] - columns)
                of_kind[fuller] = _take_over(of_kind[fuller], repeating, common, further)
                said[fuller] |= set(further)
    repeated = pl.concat(dropped)
    if repeated.is_empty():
        return rows, rows.clear()
    place = [FILE, LINE]
    kept = rows.select(place).join(repeated, on=place, how="anti", maintain_order="left")
    kept = kept.join(pl.concat(of_kind), on=place, how="left", maintain_order="left").select(rows.columns)
    return kept, rows.join(repeated, on=place, how="semi", maintain_order="left")


def _take_over(
    rows: pl.DataFrame, repeating: pl.DataFrame, common: Sequence[str], further: Sequence[str]
) -> pl.DataFrame:
    """Rows with values of further columns, where they have none, from those that are the same in the common ones."""
    if not further or repeating.is_empty():
        return rows
    found = repeating.sort(FILE, LINE).unique(common, keep="first").select(*common, *further)
    joined = rows.join(found, on=common, how="left", nulls_equal=True, maintain_order="left", suffix=_FOUND)
    return joined.select(
        pl.coalesce(name, f"{name}{_FOUND}") if name in further else pl.col(name) for name in rows.columns
    )


_FOUND = " found"


def _filled(share: pl.DataFrame) -> set[str]:
    return {name for name in share.columns if name not in (FILE, LINE) and share[name].null_count() < share.height}
