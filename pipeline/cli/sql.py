"""`tracklake sql`: a query's result, for people or for programs."""

import errno
import sys
from collections.abc import Sequence
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO, TypeVar, cast

import polars as pl
import typer

from tracklake.pipeline.cli.command import command, read_settings, refuse_address
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import LakeOption, require_choice
from tracklake.pipeline.cli.tables import GAP, cut_text, print_table
from tracklake.pipeline.lake import LakeResult, connect, refuse_lake
from tracklake.pipeline.lake import query as run_query
from tracklake.pipeline.lake.catalog import build_catalog, list_columns, sql_type
from tracklake.pipeline.lake.files import TABLE_BY_NAME
from tracklake.pipeline.lake.history import load_as_of
from tracklake.pipeline.lake.macros import MACROS
from tracklake.schemas import TABLES
from tracklake.schemas.errors import TracklakeError, UsageError, explain_file_errors
from tracklake.schemas.files import write_output
from tracklake.schemas.text import make_visible, suggest_name

if TYPE_CHECKING:
    from io import IOBase

T = TypeVar("T")

FORMATS = ("table", "csv", "json", "jsonl", "parquet", "arrow")
BINARY = ("parquet", "arrow")
"""Formats that are no text."""
SUFFIXES = {".csv": "csv", ".json": "json", ".jsonl": "jsonl", ".ndjson": "jsonl", ".parquet": "parquet"}
SUFFIXES |= {".arrow": "arrow", ".feather": "arrow"}
"""Formats by the ending of the file that --out names."""
DATABASE = ".duckdb"
"""Ending of a file that --out names for the whole catalog, without a query."""

MAX_ROWS = 40
"""Most rows of a result that a terminal shows; what is piped or written to a file holds all."""

MAX_CELL_CHARS = 120
"""Longest cell printed in a terminal table, in characters."""

ELLIPSIS = "…"
"""Column that stands for those for which the terminal is too narrow."""

SLICE_ROWS = 100_000
"""Rows of a piped table that are written at once."""

LISTED = ("column", "type", "unit", "meaning")
"""Headings of a table's columns."""

NUMERIC = ("TINYINT", "SMALLINT", "INTEGER", "BIGINT", "HUGEINT", "UBIGINT", "UINTEGER", "FLOAT", "DOUBLE", "DECIMAL")
"""Beginnings of the names of DuckDB's types whose columns are aligned to the right."""


def sql(
    query: Annotated[
        str | None, typer.Argument(help="One SELECT; `-` reads it from standard input. With --list: a name.")
    ] = None,
    lake: LakeOption = None,
    format: Annotated[
        str | None,
        typer.Option(
            "--format", help="table, csv, json, jsonl, parquet or arrow; default: the ending of --out, or table."
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Same as --format json.")] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Write the result to this file; without QUERY and as .duckdb: the catalog."),
    ] = None,
    as_of: Annotated[
        str | None,
        typer.Option(
            "--as-of", metavar="GENERATION|TIME", help="Show an earlier state of the lake; `tracklake info` lists them."
        ),
    ] = None,
    names: Annotated[
        bool, typer.Option("--list", help="List the tables and macros; with the name of one, its columns.")
    ] = False,
) -> None:
    """Query the tables with SQL, read-only, from anywhere."""
    with command(json=json) as terminal:
        require_choice("--format", format, FORMATS)
        if names:
            show_names(terminal) if query is None else show_name(terminal, query)
            return
        refuse_lake(out)
        if query is None and out is not None and out.suffix == DATABASE:
            root = refuse_address(read_settings(lake=lake, in_folder=False))
            write_output(out, build_catalog(root, load_as_of(root, as_of)))
            return
        if query is None:
            raise typer.BadParameter("give one SELECT, `-` to read it from standard input, or --list")
        form = choose_format(format, out, json=json)
        with connect(read_settings(lake=lake, in_folder=False).lake, as_of) as connection:
            relation = run_query(connection, sys.stdin.read() if query == "-" else query)
            write_result(relation, form, out, terminal)


def choose_format(asked: str | None, out: Path | None, *, json: bool) -> str:
    """Return the format that was asked for, or else that of the file's ending.

    Raises:
        UsageError: --json beside another format, or an ending that stands for none.
    """
    if json and asked not in (None, "json"):
        raise UsageError(f"--json is --format json; got --format {asked}, too")
    if json or asked is not None or out is None:
        return asked or ("json" if json else "table")
    if out.suffix.lower() not in SUFFIXES:
        raise UsageError(
            f"{out}: expected a name that ends in {', '.join(SUFFIXES)}, or --format {'|'.join(FORMATS[1:])}"
        )
    return SUFFIXES[out.suffix.lower()]


def is_screen() -> bool:
    """Return whether standard output is a terminal, which people look at."""
    return sys.stdout.isatty()


def write_result(relation: LakeResult, form: str, out: Path | None, terminal: Terminal) -> None:
    """Write a result to a file, or to standard output.

    Args:
        relation: result of `pipeline.lake.query`.
        form: table (aligned), csv (with header), json (an array), jsonl (an object a line), parquet or arrow.
        out: file to write; none: standard output.
        terminal: terminal of the command, for a table or the number of rows written.

    Raises:
        UsageError: a table for people would go to a file.
        TracklakeError: what is no text would go to a terminal.
        FileAccessError: the file cannot be written.
    """
    if form == "table" and out is not None:
        raise UsageError(f"--format table goes to the terminal only: with --out, choose {', '.join(FORMATS[1:])}")
    if form == "table":
        _show_rows(relation, terminal)
        return
    if form in BINARY and out is None and is_screen():
        raise TracklakeError(f"{form} is no text: give --out FILE, or redirect standard output to a file")
    frame = (relation if form in BINARY else relation.to_text(flat=form == "csv")).pl()
    if out is not None:
        write_output(out, lambda stream: _write(frame, form, stream))
        _print_count(terminal, frame.height, f" in {out}")
        return
    if is_screen():
        text = BytesIO()
        _write(frame, form, text)
        sys.stdout.write(make_visible(text.getvalue().decode(), keep="\n"))
        return
    with explain_file_errors(Path("standard output")):
        _write(frame, form, sys.stdout.buffer)
    sys.stdout.buffer.flush()


def _show_rows(relation: LakeResult, terminal: Terminal) -> None:
    """Print a result as a table, and on stderr how many rows there are: to a terminal the first, to a pipe all."""
    on_screen = is_screen()
    rows = relation.limit(MAX_ROWS + 1).to_text(flat=not on_screen, numbers=not on_screen).fetchall()
    if len(rows) > MAX_ROWS and not on_screen:
        _print_count(terminal, _write_lines(relation))
        return
    longest = min(MAX_CELL_CHARS, terminal.out.width) if on_screen else sys.maxsize
    cells = [[_format_cell(value, longest) for value in row] for row in rows[:MAX_ROWS]]
    numeric = _find_numeric(relation)
    shown = list(range(len(numeric)))
    if on_screen and not any("\n" in cell for row in cells for cell in row):
        widths = [max(map(len, column)) for column in zip(relation.columns, *cells, strict=True)]
        shown = choose_columns(widths, terminal.out.width)
    table = [list(relation.columns), *cells]
    hidden = len(numeric) - len(shown)
    gap = next((place for place, column in enumerate(shown) if place != column), len(shown))
    head, *body = [_select_cells(row, shown, gap if hidden else None, ELLIPSIS) for row in table]
    print_table(terminal, head, body, right=_select_cells(numeric, shown, gap if hidden else None, False))
    notes = [f"{len(shown)} of {len(numeric)} columns; a wider terminal, a pipe or --out shows all"] if hidden else []
    if len(rows) > MAX_ROWS:
        notes.insert(0, f"the first {MAX_ROWS} of {relation.count():,} rows; a pipe or --out FILE.csv gives all")
        terminal.err.print(f"[dim]{'; '.join(notes)}[/]")
    else:
        _print_count(terminal, len(rows), "".join(f"; {note}" for note in notes))


def _select_cells(row: Sequence[T], shown: Sequence[int], gap: int | None, filling: T) -> list[T]:
    """Return the cells of the columns shown, with one more where columns are left out."""
    cells = [row[column] for column in shown]
    return cells if gap is None else [*cells[:gap], filling, *cells[gap:]]


def choose_columns(widths: Sequence[int], limit: int) -> list[int]:
    """Return the columns that fit on a line, from both ends inwards, so that those left out stand in the middle.

    Args:
        widths: width of each column in characters.
        limit: width of the line in characters; the first column is shown however wide it is.
    """
    count = len(widths)
    if sum(widths) + GAP * (count - 1) <= limit:
        return list(range(count))
    inwards = sorted(range(count), key=lambda place: (min(place, count - 1 - place), place))
    used = accumulate((widths[place] + GAP for place in inwards), initial=len(ELLIPSIS))
    return sorted(place for place, total in zip(inwards, [*used][1:], strict=True) if total <= limit or place == 0)


def _find_numeric(relation: LakeResult) -> list[bool]:
    return [str(kind).startswith(NUMERIC) and not str(kind).endswith("]") for kind in relation.types]


def _write_lines(relation: LakeResult) -> int:
    """Write all rows to a pipe as aligned lines, and return how many there are."""
    frame = relation.to_text(flat=True, numbers=True).pl()
    aligned = []
    for name, to_right in zip(frame.columns, _find_numeric(relation), strict=True):
        text = pl.col(name).fill_null("null")
        odd = (
            frame.lazy().select(text).filter(pl.col(name).str.contains(r"[\p{C}\p{Zl}\p{Zp}]")).unique().collect()[name]
        )
        if len(odd):
            text = text.replace(odd, pl.Series([make_visible(value, keep="\n") for value in odd]))
        width = max(len(name), frame.select(text.str.len_chars().max()).item())
        aligned.append((name, text, width, to_right))
    parts = [text.str.pad_start(width) if to_right else text.str.pad_end(width) for _, text, width, to_right in aligned]
    line = pl.concat_str(parts, separator=" " * GAP).str.strip_chars_end(" ").alias("line")
    head = [name.rjust(width) if to_right else name.ljust(width) for name, _, width, to_right in aligned]
    with explain_file_errors(Path("standard output")):
        sys.stdout.write((" " * GAP).join(head).rstrip() + "\n")
        sys.stdout.flush()
        for part in frame.iter_slices(SLICE_ROWS):
            _write(part.select(line), "lines", sys.stdout.buffer)
    sys.stdout.buffer.flush()
    return frame.height


def _print_count(terminal: Terminal, rows: int, where: str = "") -> None:
    """Print the number of rows on stderr, which is no part of the result."""
    terminal.err.print(make_visible(f"{rows:,} {'row' if rows == 1 else 'rows'}{where}"), style="dim", markup=False)


def _format_cell(value: object, longest: int) -> str:
    if value is None:
        return "null"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if "\n" in text else cut_text(text, longest)  # a query plan has many lines


def show_names(terminal: Terminal) -> None:
    """Print every table and macro with its meaning; they are the same in all lakes."""
    tables = {table.name: _take_first_sentence(table.meaning) for table in TABLES}
    macros = {macro.signature: macro.meaning for macro in MACROS}
    terminal.print_json({"tables": tables, "macros": macros})
    for title, meanings in (
        ("Tables (columns: tracklake sql --list tracks)", tables),
        ("Macros (call: FROM track('01-upper', 5))", macros),
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
        listed = [dict(zip(LISTED, row, strict=True)) for row in rows]
        terminal.print_json({"table": name, "meaning": table.meaning, "columns": listed})
    elif macro is not None:
        terminal.print_line(macro.signature, style="bold")
        terminal.print_line(macro.explanation)
        terminal.print_json({"macro": macro.signature, "meaning": macro.explanation})
    else:
        known = [*TABLE_BY_NAME, *(each.name for each in MACROS)]
        raise UsageError(f"no table or macro {name!r} (`tracklake sql --list` shows all); {suggest_name(name, known)}")


def _take_first_sentence(text: str) -> str:
    return text.split(". ")[0].removesuffix(".") + "."


def _write(frame: pl.DataFrame, form: str, target: BinaryIO) -> None:
    try:
        if form == "csv":
            frame.write_csv(target)
        elif form == "lines":
            frame.write_csv(target, include_header=False, quote_style="never")
        elif form == "json":
            # Any binary file will do, though Polars declares it otherwise than for the other forms.
            frame.write_json(cast("IOBase", target))
        elif form == "jsonl":
            frame.write_ndjson(target)
        elif form == "arrow":
            frame.write_ipc(target)
        else:
            frame.write_parquet(target)
    except OSError as error:
        if f"(os error {errno.EPIPE})" in str(error):  # Polars raises the system's error without its number
            raise BrokenPipeError from error
        raise
