"""Files made from others: rows of a recording that stand in a fuller file of it as well."""

from collections.abc import Sequence

import polars as pl

from pipeline.sources.accounting import FILE
from pipeline.sources.raw_files import LINE

IN_FULLER_FILE = "duplicate row: the same entry stands in a fuller file"


def split_derived(
    rows: pl.DataFrame, shares: Sequence[pl.DataFrame], essential: Sequence[str]
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Part rows from those that a fuller file of the recording has too.

    A file that lacks columns (no lane, no size) says less of the same entries, so that its rows are no exact
    repetitions. One of them is dropped if a row of a file with more columns has the same values in all columns that
    both files have; the others stay.

    Args:
        rows: of all files, with FILE.
        shares: the rows of each file, in the order of FILE, to see what columns it has: those with any value.
        essential: columns that tell entries apart; without them in common nothing is compared.

    Returns:
        (rows to keep, rows that stand in a fuller file), in the order given.
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
    dropped = [rows.clear().select(FILE, LINE)]
    for number, poorer in enumerate(of_kind[1:], start=1):
        for fuller, columns in zip(of_kind[:number], kinds[:number], strict=True):
            common = sorted(columns & kinds[number])
            if set(essential) <= set(common):
                dropped.append(poorer.join(fuller, on=common, how="semi", nulls_equal=True).select(FILE, LINE))
    repeated = pl.concat(dropped)
    if repeated.is_empty():
        return rows, rows.clear()
    place = [FILE, LINE]
    kept = rows.join(repeated, on=place, how="anti", maintain_order="left")
    return kept, rows.join(repeated, on=place, how="semi", maintain_order="left")


def _filled(share: pl.DataFrame) -> set[str]:
    return {name for name in share.columns if name not in (FILE, LINE) and share[name].null_count() < share.height}
