"""A query's result, for people or for programs."""

import errno
import sys
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

from tracklake.pipeline.cli.console import Terminal, show_relation
from tracklake.schemas.errors import FileAccessError, TracklakeError

if TYPE_CHECKING:
    from io import IOBase

    import polars as pl

    from tracklake.pipeline.lake import LakeResult

FORMATS = ("table", "csv", "json", "parquet")


def write_result(relation: "LakeResult", form: str, out: Path | None, terminal: Terminal) -> None:
    """Write a result to a file, or to standard output.

    Args:
        relation: of `pipeline.lake.query`.
        form: table (the first rows, aligned), csv (with header), json (an array of objects) or parquet.
        out: the file; none: standard output.
        terminal: for tables, and to say how many rows went to the file.

    Raises:
        TracklakeError: Parquet, which is no text, was asked for on a terminal.
        FileAccessError: the file cannot be written.
    """
    if form == "table" and out is None:
        show_relation(relation, terminal)
        return
    if form == "parquet" and out is None and sys.stdout.isatty():
        raise TracklakeError("Parquet is no text: give --out FILE, or redirect standard output to a file")
    try:
        frame = _flat(relation).pl() if form == "csv" else relation.pl()
        _write(frame, form, out or sys.stdout.buffer)
    except OSError as error:
        # Polars raises the system's error without its number.
        if f"(os error {errno.EPIPE})" in str(error):
            raise BrokenPipeError from error
        raise FileAccessError(f"{out or 'standard output'}: {error}") from error
    if out is None:
        sys.stdout.buffer.flush()
    else:
        terminal.say(f"{frame.height:,} {'row' if frame.height == 1 else 'rows'} in {out}")


def show_names(terminal: Terminal) -> None:
    """Print every table and macro with what it is; the same for all lakes."""
    from tracklake.pipeline.lake.macros import MACROS
    from tracklake.schemas import TABLES

    for title, meanings in (
        ("Tables (columns: DESCRIBE tracks)", {table.name: _first_sentence(table.meaning) for table in TABLES}),
        ("Macros (call: FROM track('01-upper', 5))", {macro.signature: macro.meaning for macro in MACROS}),
    ):
        terminal.say(title, style="bold")
        width = max(map(len, meanings)) + 2
        for name, meaning in meanings.items():
            terminal.say(f"  {name:<{width}}{meaning}")


def _first_sentence(text: str) -> str:
    return text.split(". ")[0].removesuffix(".") + "."


def _write(frame: "pl.DataFrame", form: str, target: Path | IO[bytes]) -> None:
    if form == "csv":
        frame.write_csv(target)
    elif form == "json":
        # Any binary file will do, though Polars declares it otherwise than for the other forms.
        frame.write_json(cast("Path | IOBase", target))
    elif form == "parquet":
        frame.write_parquet(target)
    else:
        raise TracklakeError("--format table goes to the terminal only: with --out, choose csv, json or parquet")


def _flat(relation: "LakeResult") -> "LakeResult":
    """Lists and structs as text, which is all that CSV can hold."""
    columns = []
    for name, kind in zip(relation.columns, relation.types, strict=True):
        quoted = '"' + name.replace('"', '""') + '"'
        nested = str(kind).endswith("]") or str(kind).startswith(("STRUCT", "MAP"))
        columns.append(f"CAST({quoted} AS VARCHAR) AS {quoted}" if nested else quoted)
    return relation.project(", ".join(columns))
