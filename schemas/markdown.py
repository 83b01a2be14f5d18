"""Page of the tables as Markdown, and Markdown tables for the other derived pages: see `make docs`."""

import sys
from collections.abc import Iterable, Iterator, Sequence

from tracklake.schemas import SCHEMA_VERSION, TABLES, Table
from tracklake.schemas.comparisons import COMPARISON_TABLES
from tracklake.schemas.evaluations import EVALUATIONS
from tracklake.schemas.raw_highd import RAW_HIGHD_RECORDING, RAW_HIGHD_TRACKS, RAW_HIGHD_VEHICLES
from tracklake.schemas.raw_i24 import RAW_I24
from tracklake.schemas.raw_levelx import (
    RAW_EXID_TRACKS,
    RAW_LEVELX_RECORDING,
    RAW_LEVELX_VEHICLES,
    RAW_URBAN_TRACKS,
)
from tracklake.schemas.raw_ngsim import RAW_NGSIM
from tracklake.schemas.raw_tgsim import RAW_TGSIM, RAW_TGSIM_CENTRELINES

RAW_TABLES = (
    *(RAW_NGSIM, RAW_HIGHD_RECORDING, RAW_HIGHD_VEHICLES, RAW_HIGHD_TRACKS),
    *(RAW_TGSIM, RAW_TGSIM_CENTRELINES, RAW_I24),
    *(RAW_LEVELX_RECORDING, RAW_LEVELX_VEHICLES, RAW_EXID_TRACKS, RAW_URBAN_TRACKS),
)

SCORE_TABLES = (EVALUATIONS, *COMPARISON_TABLES)

HEADINGS = ("column", "dtype", "unit", "null", "bounds", "meaning")
"""Titles above the declaration of a table."""

HEAD = f"""# Tables

Derived from `schemas/`; do not edit (`make docs` writes it). Schema version {SCHEMA_VERSION}.

In SQL, `vehicles` also shows the columns of `vehicle_starts`, and `subsets` those of `subset_status`: null where that
stage has not run. Every file is sorted by its table's key, which is unique within a file.
"""

RAW_HEAD = """## Raw files

The columns read, under the publishers' names and in their units. A line outside the bounds is written to `rejects`.
"""


SCORE_HEAD = """## Scores

Files that `tracklake evaluate` writes; they are no tables of the lake.
"""


def format_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table; a bar in a cell becomes a slash."""
    cells = (headings, ("---",) * len(headings), *rows)
    return [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in cells]


def write_tables() -> str:
    """Write the whole page."""
    parts = [HEAD, *(_write_section(table, "##") for table in TABLES), SCORE_HEAD]
    parts += [*(_write_section(table, "###") for table in SCORE_TABLES), RAW_HEAD]
    parts += [_write_section(table, "###") for table in RAW_TABLES]
    return "\n".join(parts)


def _write_section(table: Table, level: str) -> str:
    """Write the section of a table."""
    partition = f", partitioned by {', '.join(table.partition)}" if table.partition else ""
    return "\n".join(
        [
            f"{level} {table.name}",
            "",
            table.meaning,
            "",
            f"Key: {', '.join(table.key)}{partition}.",
            "",
            *format_table(HEADINGS, _describe(table)),
            "",
        ]
    )


def _describe(table: Table) -> Iterator[tuple[str, ...]]:
    """Yield the cells of each column's row."""
    for row in table.describe():
        low, high = table.bounds.get(row["column"], (None, None))
        bounds = "" if low is high is None else f"{_format_bound(low)} to {_format_bound(high)}"
        yield f"`{row['column']}`", row["dtype"], row["unit"], row["null"], bounds, row["meaning"]


def _format_bound(value: float | None) -> str:
    """Format a bound; None is no bound."""
    return "any" if value is None else f"{value:,g}"


if __name__ == "__main__":
    sys.stdout.write(write_tables())
