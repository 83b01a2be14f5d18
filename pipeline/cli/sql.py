"""`tracklake sql`: a query's result, for people or for programs."""

import errno
import sys
from difflib import get_close_matches
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO, cast

import polars as pl
import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import LakeOption, require_choice
from tracklake.pipeline.cli.tables import cut_text, print_table
from tracklake.pipeline.lake import LakeResult, connect, query_errors, refuse_lake
from tracklake.pipeline.lake import query as run_query
from tracklake.pipeline.lake.catalog import list_columns, sql_type
from tracklake.pipeline.lake.files import TABLE_BY_NAME
from tracklake.pipeline.lake.macros import MACROS
from tracklake.schemas import TABLES
from tracklake.schemas.errors import TracklakeError, UsageError, explain_file_errors
from tracklake.schemas.files import write_output
from tracklake.schemas.text import make_visible

if TYPE_CHECKING:
    from io import IOBase

FORMATS = ("table", "csv", "json", "parquet")

MAX_ROWS = 40
"""Rows of a result printed as a table; csv, json and parquet hold all."""

MAX_CELL_CHARS = 120
"""Longest cell printed in a terminal table, in characters."""

LISTED = ("column", "type", "unit", "meaning")
"""Headings of a table's columns."""

NUMERIC = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "UBIGINT", "UINTEGER", "FLOAT", "DOUBLE", "DECIMAL")
"""Beginnings of the names of DuckDB's types whose columns are aligned to the right."""


def sql(
    query: Annotated[
        str | None, typer.Argument(help="One SELECT; `-` reads it from standard input. With --list: a name.")
    ] = None,
    lake: LakeOption = None,
    format: Annotated[str, typer.Option("--format", help="table, csv, json or parquet.")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="Write the result to this file.")] = None,
    names: Annotated[
        bool, typer.Option("--list", help="List the tables and macros; with the name of one, its columns.")
    ] = False,
) -> None:
    """Query the tables with SQL, read-only, from anywhere."""
    with command() as terminal:
        require_choice("--format", format, FORMATS)
        if names:
            show_names(terminal) if query is None else show_name(terminal, query)
            return
        refuse_lake(out)
        if query is None:
            raise typer.BadParameter("give one SELECT, `-` to read it from standard input, or --list")
        with connect(read_settings(lake=lake).lake) as connection:
            relation = run_query(connection, sys.stdin.read() if query == "-" else query)
            with query_errors():  # DuckDB computes while the result is fetched
                write_result(relation, format, out, terminal)


def write_result(relation: LakeResult, form: str, out: Path | None, terminal: Terminal) -> None:
    """Write a result to a file, or to standard output.

    Args:
        relation: result of `pipeline.lake.query`.
        form: table (the first rows, aligned), csv (with header), json (an array of objects) or parquet.
        out: file to write; none: standard output.
        terminal: terminal of the command, for a table or the number of rows written.

    Raises:
        UsageError: a table for people would go to a file.
        TracklakeError: Parquet, which is no text, would go to a terminal.
        FileAccessError: the file cannot be written.
    """
    if form == "table" and out is None:
        _show_rows(relation, terminal)
        return
    if form == "table":
        raise UsageError("--format table goes to the terminal only: with --out, choose csv, json or parquet")
    if form == "parquet" and out is None and sys.stdout.isatty():
        raise TracklakeError("Parquet is no text: give --out FILE, or redirect standard output to a file")
    frame = (relation if form == "parquet" else relation.to_text(flat=form == "csv")).pl()
    if out is not None:
        write_output(out, lambda stream: _write(frame, form, stream))
        _print_count(terminal, frame.height, f" in {out}")
        return
    if sys.stdout.isatty():
        text = BytesIO()
        _write(frame, form, text)
        sys.stdout.write(make_visible(text.getvalue().decode(), keep="\n"))
        return
    with explain_file_errors(Path("standard output")):
        _write(frame, form, sys.stdout.buffer)
    sys.stdout.buffer.flush()


def _show_rows(relation: LakeResult, terminal: Terminal) -> None:
    """Print a query's first rows as a table with every column, and on stderr how many rows there are."""
    rows = relation.limit(MAX_ROWS + 1).to_text().fetchall()
    numeric = [str(kind).startswith(NUMERIC) and not str(kind).endswith("]") for kind in relation.types]
    cells = [[_format_cell(value) for value in row] for row in rows[:MAX_ROWS]]
    print_table(terminal, list(relation.columns), cells, right=numeric)
    if len(rows) > MAX_ROWS:
        rest = f"the first {MAX_ROWS} of {relation.count():,} rows; --format csv, json or parquet gives all"
        terminal.err.print(f"[dim]{rest}[/]")
    else:
        _print_count(terminal, len(rows))


def _print_count(terminal: Terminal, rows: int, where: str = "") -> None:
    """Print the number of rows on stderr, which is no part of the result."""
    terminal.err.print(make_visible(f"{rows:,} {'row' if rows == 1 else 'rows'}{where}"), style="dim", markup=False)


def _format_cell(value: object) -> str:
    if value is None:
        return "null"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if "\n" in text else cut_text(text, MAX_CELL_CHARS)  # a query plan has many lines


def show_names(terminal: Terminal) -> None:
    """Print every table and macro with its meaning; they are the same in all lakes."""
    for title, meanings in (
        (
            "Tables (columns: tracklake sql --list tracks)",
            {table.name: _take_first_sentence(table.meaning) for table in TABLES},
        ),
        ("Macros (call: FROM track('01-upper', 5))", {macro.signature: macro.meaning for macro in MACROS}),
    ):
        terminal.print_line(title, style="bold")
        width = max(map(len, meanings)) + 2
        for name, meaning in meanings.items():
            terminal.print_line(f"  {name:<{width}}{meaning}")


def show_name(terminal: Terminal, name: str) -> None:
    """Print the columns of a table with type, unit and meaning, or the parameters and columns of a macro.

    Raises:
        UsageError: no table or macro has this name.
    """
    table, macro = TABLE_BY_NAME.get(name), next((each for each in MACROS if each.name == name), None)
    if table is not None:
        columns = list_columns(table).items()
        rows = [(column, sql_type(each.dtype), each.unit or "", each.description) for column, each in columns]
        print_table(terminal, LISTED, rows, title=table.meaning, right=[False] * len(LISTED))
    elif macro is not None:
        terminal.print_line(macro.signature, style="bold")
        terminal.print_line(macro.explanation)
    else:
        known = [*TABLE_BY_NAME, *(each.name for each in MACROS)]
        near = get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise UsageError(f"no table or macro {name!r}{hint} `tracklake sql --list` shows all.")


def _take_first_sentence(text: str) -> str:
    return text.split(". ")[0].removesuffix(".") + "."


def _write(frame: pl.DataFrame, form: str, target: BinaryIO) -> None:
    try:
        if form == "csv":
            frame.write_csv(target)
        elif form == "json":
            # Any binary file will do, though Polars declares it otherwise than for the other forms.
            frame.write_json(cast("IOBase", target))
        else:
            frame.write_parquet(target)
    except OSError as error:
        if f"(os error {errno.EPIPE})" in str(error):  # Polars raises the system's error without its number
            raise BrokenPipeError from error
        raise
