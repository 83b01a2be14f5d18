"""The catalog: views over the live Parquet files, table macros over the views, and catalog.duckdb for other programs.

Every program opens catalog.duckdb from any folder, also attached beside other catalogs: its paths are absolute, and its
macros read the files themselves, as DuckDB looks for a macro's tables in the database in use. Tables of few rows are
stored in it. A lake that was moved or copied gets another catalog when tracklake next opens it (`writer.follow_move`).
"""

import re
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl
from polars.datatypes import DataTypeClass

from tracklake.pipeline.lake.errors import LakeError
from tracklake.pipeline.lake.files import STAGING, read_partition, scan
from tracklake.pipeline.lake.macros import MACROS
from tracklake.pipeline.lake.manifest import LakeFile, Manifest
from tracklake.pipeline.lake.object_access import READABLE, FileLocations, admit_place, quote
from tracklake.pipeline.lake.origin import Origin, find_origin
from tracklake.pipeline.lake.places import LakePlace
from tracklake.pipeline.lake.transfers import fetch_objects
from tracklake.schemas import SUBSET_STATUS, SUBSETS, TABLES, VEHICLE_STARTS, VEHICLES, Table
from tracklake.schemas.columns import Column
from tracklake.schemas.files import write_file
from tracklake.schemas.text import quote_shell

if TYPE_CHECKING:
    import duckdb

CATALOG = "catalog.duckdb"
"""Name of the database file in the lake."""

JOINED: dict[str, tuple[Table, tuple[str, ...]]] = {
    VEHICLES.name: (VEHICLE_STARTS, ("eligible", "starts_late", "fully_tracked", "early")),
    SUBSETS.name: (SUBSET_STATUS, ("backward_vehicles", "excluded", "excluded_reason")),
}
"""Views that show columns of a later stage beside those that ingestion wrote."""

ADDED = "added_columns"
"""Fact of a commit: columns in its files that files of earlier lakes of the same schema version lack."""

_TABLE = r"\bmain\.(\w+)"
"""Pattern of a table's name in a macro's statement."""

STORED_ROWS = 20_000
"""Most rows of a table that catalog.duckdb stores; a larger one is a view of its files."""

MANY_FILES = 100
"""Number of a table's files above which Polars reads them for DuckDB, which takes long to open each."""

_SQL_TYPES: dict[pl.DataType, str] = {
    pl.String(): "VARCHAR",
    pl.Boolean(): "BOOLEAN",
    pl.Int8(): "TINYINT",
    pl.Int16(): "SMALLINT",
    pl.Int32(): "INTEGER",
    pl.Int64(): "BIGINT",
    pl.Float32(): "FLOAT",
    pl.Float64(): "DOUBLE",
    pl.Datetime("us"): "TIMESTAMP",
}


def sql_type(dtype: pl.DataType | DataTypeClass) -> str:
    """Return DuckDB's name of a Polars dtype."""
    if isinstance(dtype, pl.List):
        return f"{sql_type(dtype.inner)}[]"
    if isinstance(dtype, pl.Struct):
        inner = ", ".join(f'"{field.name}" {sql_type(field.dtype)}' for field in dtype.fields)
        return f"STRUCT({inner})"
    if isinstance(dtype, pl.Enum):
        return "VARCHAR"
    instance = dtype() if isinstance(dtype, type) else dtype
    return _SQL_TYPES[instance]


def escape_pattern(path: str) -> str:
    """Return a path in which DuckDB finds no pattern."""
    return re.sub(r"[*?\[]", r"[\g<0>]", path)


def list_columns(table: Table) -> dict[str, Column]:
    """Return the columns that a table has in SQL: its own, and those of a later stage."""
    later, names = JOINED.get(table.name, (table, ()))
    return {**table.columns, **{name: later.columns[name] for name in names}}


def _write_select(table: Table, read: Callable[[Table], str]) -> str:
    """Return the SELECT of a table with the columns of a later stage, given what selects the rows of one table."""
    rows = read(table)
    if table.name not in JOINED:
        return rows
    later, columns = JOINED[table.name]
    key = ", ".join((*table.partition, *(name for name in table.key if name not in table.partition)))
    shown = ", ".join(f"later.{name}" for name in columns)
    return f"SELECT ingested.*, {shown} FROM ({rows}) AS ingested LEFT JOIN ({read(later)}) AS later USING ({key})"


def _select_nothing(table: Table) -> str:
    """Return the SELECT of a table without rows."""
    columns = ", ".join(f'CAST(NULL AS {sql_type(dtype)}) AS "{name}"' for name, dtype in table.dtypes.items())
    return f"SELECT {columns} WHERE false"


def _write_read(table: Table, manifest: Manifest, locations: FileLocations) -> str:
    live = manifest.live(table.name)
    complete = _are_complete(table, manifest)
    if not live:
        return _select_nothing(table)
    # Qualified, as a macro's parameter takes the place of every other name like it.
    columns = ", ".join(f'file."{name}"' for name in table.dtypes)
    files = [quote(escape_pattern(locations.find(file))) for file in live]
    if not table.partition:
        read = _read_files(table, files, "hive_partitioning = false", complete=complete)
        return f"SELECT {columns} FROM {read} AS file"
    above = escape_pattern(locations.root).lower()
    if any(f"/{name}=" in above for name in table.partition):
        # A folder above the lake looks like a partition, and DuckDB would believe it.
        return " UNION ALL ".join(_write_read_of_file(table, file, locations, complete=complete) for file in live)
    types = ", ".join(f"'{name}': {sql_type(table.dtypes[name])}" for name in table.partition)
    options = f"hive_partitioning = true, hive_types = {{{types}}}"
    return f"SELECT {columns} FROM {_read_files(table, files, options, complete=complete)} AS file"


def _read_files(table: Table, files: list[str], options: str, *, complete: bool) -> str:
    """Return what reads files given as literals; where they are not complete, with null for columns that they lack."""
    if complete:
        return f"read_parquet([{', '.join(files)}], {options})"
    nothing = ", ".join(f'CAST(NULL AS {sql_type(dtype)}) AS "{name}"' for name, dtype in table.added.items())
    read = f"read_parquet([{', '.join(files)}], {options}, union_by_name = true)"
    return f"(SELECT {nothing} WHERE false UNION ALL BY NAME SELECT * FROM {read})"


def _are_complete(table: Table, manifest: Manifest) -> bool:
    """Return whether no file of a table lacks a column; to look into each would take longer than all else."""
    commits = manifest.commits.values() if table.added else ()
    return all({*table.added} <= {*commit.info.get(ADDED, ())} for commit in commits if table.name in commit.files)


def _write_read_of_file(table: Table, file: LakeFile, locations: FileLocations, *, complete: bool) -> str:
    stated = read_partition(table, file.path)
    columns = ", ".join(
        f'CAST({quote(stated[name])} AS {sql_type(dtype)}) AS "{name}"' if name in stated else f'file."{name}"'
        for name, dtype in table.dtypes.items()
    )
    path = quote(escape_pattern(locations.find(file)))
    read = _read_files(table, [path], "hive_partitioning = false", complete=complete)
    return f"SELECT {columns} FROM {read} AS file"


def create_views(
    connection: "duckdb.DuckDBPyConnection", place: LakePlace, manifest: Manifest, *, stored: Collection[str] = ()
) -> FileLocations:
    """Create the views and the macros over them, and return where the views read.

    One transaction: each statement in its own takes a third longer.

    Args:
        connection: connection to an empty database.
        place: the lake's folder, or its address, which the connection was admitted to.
        manifest: live files of the lake.
        stored: names of tables that are read at once, instead of by each statement.

    Raises:
        LakeError: a live file is missing or unreadable.
    """
    if isinstance(place, Path) and (origin := find_origin(place)) is not None:
        _admit_origin(connection, place, origin, [file for table in TABLES for file in manifest.live(table.name)])
    connection.begin()
    locations = FileLocations(place)
    for table, (name, select) in zip(TABLES, _write_selects(locations, manifest).items(), strict=True):
        if name in stored:
            connection.execute(f'CREATE TABLE "{name}" AS {_write_select(table, _select_nothing)}')
            _insert_rows(connection, place, manifest, table, select)
        else:
            _create(connection, place, name, f'CREATE VIEW "{name}" AS {select}')
    for macro in MACROS:
        connection.execute(macro.statement)
    connection.commit()
    return locations


def _admit_origin(
    connection: "duckdb.DuckDBPyConnection", root: Path, origin: Origin, files: Sequence[LakeFile]
) -> None:
    """Let a connection read the files that a folder with a part of a lake lacks, where they are."""
    locations = FileLocations(root)
    lacking = [file for file in files if locations.find(file).startswith(origin.address)]
    if lacking and origin.address.startswith(READABLE):
        admit_place(connection, origin.address)
    else:
        fetch_objects(origin, lacking)


def describe_views(connection: "duckdb.DuckDBPyConnection") -> None:
    """Comment on each view and macro with its meaning."""
    views = (f'VIEW "{table.name}" IS {quote(table.meaning)}' for table in TABLES)
    macros = (f"MACRO TABLE {macro.name} IS {quote(macro.meaning)}" for macro in MACROS)
    connection.begin()
    connection.execute(";".join(f"COMMENT ON {each}" for each in (*views, *macros)))
    connection.commit()


def _write_selects(locations: FileLocations, manifest: Manifest) -> dict[str, str]:
    """Return a SELECT of the live rows of every table, by name."""
    return {table.name: _write_select(table, lambda own: _write_read(own, manifest, locations)) for table in TABLES}


def _insert_rows(
    connection: "duckdb.DuckDBPyConnection", place: LakePlace, manifest: Manifest, table: Table, select: str
) -> None:
    """Insert a table's live rows, which a SELECT reads; many files are read by Polars, in a fifth of DuckDB's time.

    Raises:
        LakeError: a live file is missing or unreadable.
    """
    frames: dict[str, pl.DataFrame] = {}
    if len(manifest.live(table.name)) > MANY_FILES:
        with _explain_damage(place, table.name):
            for own in (table, *JOINED.get(table.name, ())[:1]):
                frames[f"rows of {own.name}"] = scan(place, manifest, own).collect().rechunk()
        select = _write_select(table, lambda own: f'SELECT * FROM "rows of {own.name}"')
    for name, frame in frames.items():
        connection.register(name, frame)
    _create(connection, place, table.name, f'INSERT INTO "{table.name}" {select}')
    for name in frames:
        connection.unregister(name)


def _create(connection: "duckdb.DuckDBPyConnection", place: LakePlace, name: str, statement: str) -> None:
    with _explain_damage(place, name):
        connection.execute(statement)


@contextmanager
def _explain_damage(place: LakePlace, name: str) -> Iterator[None]:
    """Turn the error of a reader of a table's files into one that says how to make them again."""
    import duckdb

    try:
        yield
    except (duckdb.Error, pl.exceptions.PolarsError, OSError) as failed:
        reason = str(failed).splitlines()[0]
        raise LakeError(
            f"{place}: the table `{name}` cannot be read: {reason}\nIf its files were removed or damaged, "
            f"`tracklake run SOURCE --lake {quote_shell(place)}` on the raw files makes them again."
        ) from failed


def rebuild_catalog(root: Path, manifest: Manifest) -> None:
    """Replace catalog.duckdb, towards a session's end.

    Raises:
        LakeError: a live file is missing or unreadable; the earlier catalog stays.
    """
    content = build_catalog(root, manifest)
    # What a client that wrote to the old catalog left would be replayed into the new one.
    (root / f"{CATALOG}.wal").unlink(missing_ok=True)
    if (root / CATALOG).is_dir():  # not by us; a file cannot take a folder's name
        (root / STAGING).mkdir(exist_ok=True)
        (root / CATALOG).rename(root / STAGING / CATALOG)
    write_file(root / CATALOG, content)


def build_catalog(root: Path, manifest: Manifest) -> bytes:
    """Return the content of catalog.duckdb for a lake where it stands now.

    Raises:
        LakeError: a live file is missing or unreadable.
    """
    try:
        return _build_catalog(root, manifest, STORED_ROWS)
    except LakeError:
        return _build_catalog(root, manifest, 0)  # a view needs its first file only, and the others may be made again


def _build_catalog(root: Path, manifest: Manifest, stored_rows: int) -> bytes:
    """Return the catalog's content; tables of at most so many rows are stored in it."""
    selects = _write_selects(FileLocations(root), manifest)
    files = {table: manifest.live(table.name) for table in TABLES}
    filled = {table: sum(file.rows or 0 for file in live) for table, live in files.items() if live}

    def fill(connection: "duckdb.DuckDBPyConnection") -> None:
        for table, rows in filled.items():
            if rows <= stored_rows:
                _insert_rows(connection, root, manifest, table, selects[table.name])
            else:
                connection.execute(f'DROP TABLE "{table.name}"')
                _create(connection, root, table.name, f'CREATE VIEW "{table.name}" AS {selects[table.name]}')
                connection.execute(";".join(_write_comments(table, "VIEW")))
        _create_macros(connection, selects, {table.name for table in filled})

    return _edit_database(_make_empty_catalog(), fill)


@cache
def _make_empty_catalog() -> bytes:
    """Return a catalog of no rows. A process makes it once: most of a small catalog's time goes into the comments."""
    selects = _write_selects(FileLocations(Path()), Manifest(lake_id=""))

    def create(connection: "duckdb.DuckDBPyConnection") -> None:
        for table in TABLES:
            connection.execute(f'CREATE TABLE "{table.name}" AS {selects[table.name]}')
            connection.execute(";".join(_write_comments(table, "TABLE")))
        _create_macros(connection, selects, {table.name for table in TABLES})

    return _edit_database(b"", create)


def _create_macros(
    connection: "duckdb.DuckDBPyConnection", selects: Mapping[str, str], changed: Collection[str]
) -> None:
    """Create the macros that read one of the changed tables, each with the tables' SELECTs in place of their names."""
    for macro in MACROS:
        if not {found[1] for found in re.finditer(_TABLE, macro.statement)}.isdisjoint(changed):
            connection.execute(f"DROP MACRO TABLE IF EXISTS {macro.name}")
            connection.execute(re.sub(_TABLE, lambda found: f"({selects[found[1]]})", macro.statement))
            connection.execute(f"COMMENT ON MACRO TABLE {macro.name} IS {quote(macro.meaning)}")


def _edit_database(content: bytes, edit: Callable[["duckdb.DuckDBPyConnection"], None]) -> bytes:
    """Return a database file's content after a change in one transaction; no content is an empty database."""
    import duckdb

    # In a temporary folder, as DuckDB takes "?" in a database's path for the start of its options.
    with tempfile.TemporaryDirectory() as elsewhere:
        made = Path(elsewhere) / CATALOG
        if content:
            made.write_bytes(content)
        with duckdb.connect(str(made), config={"threads": 1}) as connection:  # small files: more only wait
            connection.begin()  # or each statement is written to disk by itself
            edit(connection)
            connection.commit()
        return made.read_bytes()


def _write_comments(table: Table, kind: str) -> list[str]:
    """Return the statements that write the meaning of a table and the unit and meaning of its columns into a database.

    Args:
        table: declaration of the table.
        kind: TABLE or VIEW.
    """
    columns = list_columns(table).items()
    return [
        f'COMMENT ON {kind} "{table.name}" IS {quote(table.meaning)}',
        *(f'COMMENT ON COLUMN "{table.name}"."{name}" IS {quote(declared.comment)}' for name, declared in columns),
    ]
