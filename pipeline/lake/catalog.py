"""The catalog: views over the live Parquet files, table macros over the views, and catalog.duckdb with both."""

import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl
from polars.datatypes import DataTypeClass

from tracklake.pipeline.lake.errors import LakeError
from tracklake.pipeline.lake.files import STAGING, read_partition
from tracklake.pipeline.lake.macros import MACROS
from tracklake.pipeline.lake.manifest import Manifest
from tracklake.schemas import SUBSET_STATUS, SUBSETS, TABLES, VEHICLE_STARTS, VEHICLES, Table
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

_SQL_TYPES: dict[pl.DataType, str] = {
    pl.String(): "VARCHAR",
    pl.Boolean(): "BOOLEAN",
    pl.Int8(): "TINYINT",
    pl.Int16(): "SMALLINT",
    pl.Int32(): "INTEGER",
    pl.Int64(): "BIGINT",
    pl.Float32(): "FLOAT",
    pl.Float64(): "DOUBLE",
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


def quote(text: str) -> str:
    """Return a text as a SQL string literal."""
    return "'" + text.replace("'", "''") + "'"


def escape_pattern(path: str) -> str:
    """Return a path in which DuckDB finds no pattern."""
    return re.sub(r"[*?\[]", r"[\g<0>]", path)


def list_view_statements(manifest: Manifest, locate: Callable[[str], str]) -> list[str]:
    """Return CREATE VIEW statements for every table of the lake.

    Args:
        manifest: live files of the lake.
        locate: turns a path relative to the lake into the path to write into the view.
    """
    return [f'CREATE VIEW "{table.name}" AS {_write_select(table, manifest, locate)}' for table in TABLES]


def _write_select(table: Table, manifest: Manifest, locate: Callable[[str], str]) -> str:
    rows = _write_read(table, manifest, locate)
    if table.name not in JOINED:
        return rows
    later, columns = JOINED[table.name]
    key = ", ".join((*table.partition, *(name for name in table.key if name not in table.partition)))
    shown = ", ".join(f"later.{name}" for name in columns)
    return (
        f"SELECT ingested.*, {shown} FROM ({rows}) AS ingested "
        f"LEFT JOIN ({_write_read(later, manifest, locate)}) AS later USING ({key})"
    )


def _write_read(table: Table, manifest: Manifest, locate: Callable[[str], str]) -> str:
    paths = [file.path for file in manifest.live(table.name)]
    files = [quote(locate(path)) for path in paths]
    if not files:
        columns = ", ".join(f'CAST(NULL AS {sql_type(dtype)}) AS "{name}"' for name, dtype in table.dtypes.items())
        return f"SELECT {columns} WHERE false"
    columns = ", ".join(f'"{name}"' for name in table.dtypes)
    if not table.partition:
        return f"SELECT {columns} FROM read_parquet([{', '.join(files)}], hive_partitioning = false)"
    if any(f"/{name}=" in locate(path).removesuffix(path).lower() for path in paths[:1] for name in table.partition):
        # A folder above the lake looks like a partition, and DuckDB would believe it.
        return " UNION ALL ".join(_write_read_of_file(table, path, locate) for path in paths)
    types = ", ".join(f"'{name}': {sql_type(table.dtypes[name])}" for name in table.partition)
    return (
        f"SELECT {columns} FROM read_parquet([{', '.join(files)}], hive_partitioning = true, hive_types = {{{types}}})"
    )


def _write_read_of_file(table: Table, path: str, locate: Callable[[str], str]) -> str:
    stated = read_partition(table, path)
    columns = ", ".join(
        f'CAST({quote(stated[name])} AS {sql_type(dtype)}) AS "{name}"' if name in stated else f'"{name}"'
        for name, dtype in table.dtypes.items()
    )
    return f"SELECT {columns} FROM read_parquet([{quote(locate(path))}], hive_partitioning = false)"


def create_views(
    connection: "duckdb.DuckDBPyConnection", root: Path, manifest: Manifest, locate: Callable[[str], str]
) -> None:
    """Create the views, the macros over them, and a comment on each with its meaning.

    Args:
        connection: connection to an empty database.
        root: the lake's folder, for messages.
        manifest: live files of the lake.
        locate: turns a path relative to the lake into the path to write into the views.

    Raises:
        LakeError: a live file is missing or unreadable.
    """
    import duckdb

    for table, statement in zip(TABLES, list_view_statements(manifest, locate), strict=True):
        try:
            connection.execute(statement)
        except duckdb.Error as failed:
            reason = str(failed).splitlines()[0]
            raise LakeError(
                f"{root}: the table `{table.name}` cannot be read: {reason}\nIf its files were removed or damaged, "
                f"`tracklake run SOURCE --lake {quote_shell(root)}` on the raw files makes them again."
            ) from failed
        connection.execute(f'COMMENT ON VIEW "{table.name}" IS {quote(table.meaning)}')
    for macro in MACROS:
        connection.execute(macro.statement)
        connection.execute(f"COMMENT ON MACRO TABLE {macro.name} IS {quote(macro.meaning)}")


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
    """Return the content of catalog.duckdb, whose views hold paths relative to the lake's folder.

    It is made in a temporary folder, where the lake goes by a link. Views are checked on creation against files
    relative to DuckDB's search path, which is a list of patterns without a way to quote, and "?" in a database's path
    starts its options; a lake may be called "a,b" or "c[1]?".
    """
    import duckdb

    with tempfile.TemporaryDirectory() as elsewhere:
        made, link = Path(elsewhere) / CATALOG, Path(elsewhere) / "lake"
        link.symlink_to(root.resolve(), target_is_directory=True)
        with duckdb.connect(str(made)) as connection:
            connection.execute(f"SET file_search_path = {quote(str(link))}")
            connection.begin()  # or each statement is written to disk by itself
            create_views(connection, root, manifest, locate=str)
            connection.commit()
        return made.read_bytes()
