"""The tables as Markdown, derived from their declarations: `python -m tracklake.schemas.markdown > docs/tables.md`."""

import sys
from collections.abc import Iterator

from tracklake.schemas import SCHEMA_VERSION, TABLES, Table
from tracklake.schemas.raw_highd import RAW_HIGHD_RECORDING, RAW_HIGHD_TRACKS, RAW_HIGHD_VEHICLES
from tracklake.schemas.raw_ngsim import RAW_NGSIM

RAW_TABLES = (RAW_NGSIM, RAW_HIGHD_RECORDING, RAW_HIGHD_VEHICLES, RAW_HIGHD_TRACKS)

HEAD = f"""# Tables

Derived from `schemas/`; do not edit (`make docs` writes it). Schema version {SCHEMA_VERSION}.

In SQL, `vehicles` also shows the columns of `vehicle_starts`, and `subsets` those of `subset_status`: null where that
stage has not run. Every file is sorted by its table's key, which is unique within a file.
"""

RAW_HEAD = """## Raw files

The columns read, under the publishers' names and in their units. A line outside the bounds stands in `rejects`.
"""


def write_tables() -> str:
    """The whole page."""
    parts = [HEAD, *(_section(table, "##") for table in TABLES), RAW_HEAD]
    parts += [_section(table, "###") for table in RAW_TABLES]
    return "\n".join(parts)


def _section(table: Table, level: str) -> str:
    partition = f", partitioned by {', '.join(table.partition)}" if table.partition else ""
    return "\n".join(
        [
            f"{level} {table.name}",
            "",
            table.meaning,
            "",
            f"Key: {', '.join(table.key)}{partition}.",
            "",
            *_rows(table),
            "",
        ]
    )


def _rows(table: Table) -> Iterator[str]:
    headings = ("column", "dtype", "unit", "null", "bounds", "meaning")
    yield f"| {' | '.join(headings)} |"
    yield f"|{' --- |' * len(headings)}"
    for row in table.describe():
        low, high = table.bounds.get(row["column"], (None, None))
        bounds = "" if low is high is None else f"{_bound(low)} to {_bound(high)}"
        cells = (f"`{row['column']}`", row["dtype"], row["unit"], row["null"], bounds, row["meaning"])
        yield f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _bound(value: float | None) -> str:
    return "any" if value is None else f"{value:,g}"


if __name__ == "__main__":
    sys.stdout.write(write_tables())
