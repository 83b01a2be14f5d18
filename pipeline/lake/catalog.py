"""The lake as SQL: views over the live Parquet files, in catalog.duckdb and on sandboxed in-memory connections."""

import uuid
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from pipeline.lake.errors import QueryError
from pipeline.lake.manifest import Manifest, load, sync_folder
from schemas import SUBSET_STATUS, SUBSETS, TABLES, VEHICLE_STARTS, VEHICLES, Table

if TYPE_CHECKING:
    import duckdb

CATALOG = "catalog.duckdb"

JOINED: dict[str, tuple[Table, tuple[str, ...]]] = {
    VEHICLES.name: (VEHICLE_STARTS, ("eligible", "starts_late", "fully_tracked", "early")),
    SUBSETS.name: (SUBSET_STATUS, ("backward_vehicles", "excluded", "excluded_reason")),
}
"""Views that show what a later stage found out beside what ingestion wrote."""

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


def sql_type(dtype: pl.DataType) -> str:
    """DuckDB's name of a Polars dtype."""
    if isinstance(dtype, pl.List):
        return f"{sql_type(pl.List(dtype.inner).inner)}[]"  # type: ignore[arg-type]  # inner may be a class
    if isinstance(dtype, pl.Struct):
        inner = ", ".join(f'"{field.name}" {sql_type(field.dtype)}' for field in dtype.fields)  # type: ignore[arg-type]
        return f"STRUCT({inner})"
    instance = dtype() if isinstance(dtype, type) else dtype
    return _SQL_TYPES[instance]


def quote(text: str) -> str:
    """A SQL string literal."""
    return "'" + text.replace("'", "''") + "'"


def view_statements(manifest: Manifest, locate: Callable[[str], str]) -> list[str]:
    """CREATE VIEW statements for every table of the lake.

    Args:
        manifest: which files are live.
        locate: turns a path relative to the lake into the path to write into the view.
    """
    return [f'CREATE VIEW "{table.name}" AS {_select(table, manifest, locate)}' for table in TABLES]


def _select(table: Table, manifest: Manifest, locate: Callable[[str], str]) -> str:
    rows = _rows(table, manifest, locate)
    if table.name not in JOINED:
        return rows
    later, columns = JOINED[table.name]
    key = ", ".join((*table.partition, *(name for name in table.key if name not in table.partition)))
    shown = ", ".join(f"later.{name}" for name in columns)
    return (
        f"SELECT ingested.*, {shown} FROM ({rows}) AS ingested "
        f"LEFT JOIN ({_rows(later, manifest, locate)}) AS later USING ({key})"
    )


def _rows(table: Table, manifest: Manifest, locate: Callable[[str], str]) -> str:
    files = [quote(locate(file.path)) for file in manifest.live(table.name)]
    if not files:
        columns = ", ".join(f'CAST(NULL AS {sql_type(dtype)}) AS "{name}"' for name, dtype in table.dtypes.items())
        return f"SELECT {columns} WHERE false"
    columns = ", ".join(f'"{name}"' for name in table.dtypes)
    if not table.partition:
        return f"SELECT {columns} FROM read_parquet([{', '.join(files)}], hive_partitioning = false)"
    types = ", ".join(f"'{name}': {sql_type(table.dtypes[name])}" for name in table.partition)
    return (
        f"SELECT {columns} FROM read_parquet([{', '.join(files)}], hive_partitioning = true, hive_types = {{{types}}})"
    )


def rebuild(root: Path, manifest: Manifest) -> None:
    """Write catalog.duckdb aside and put it in place; its views hold paths relative to the lake's folder."""
    import duckdb

    aside = root / f".{CATALOG}.{uuid.uuid4().hex}.tmp"
    with duckdb.connect(str(aside)) as connection:
        # Views are checked on creation against files relative to the search path, and store the relative names.
        connection.execute(f"SET file_search_path = {quote(str(root.resolve()))}")
        for statement in view_statements(manifest, locate=str):
            connection.execute(statement)
        for table in TABLES:
            connection.execute(f'COMMENT ON VIEW "{table.name}" IS {quote(table.meaning)}')
    aside.replace(root / CATALOG)
    sync_folder(root)


def connect(lake: Path | str) -> "duckdb.DuckDBPyConnection":
    """Open a lake for SQL: an in-memory DuckDB with the views, read-only in fact.

    Nothing but the lake's tables can be read, nothing can be written, no extension loaded, no setting changed.

    Args:
        lake: the lake's folder, wherever it stands now.

    Raises:
        LakeMissingError: no lake there.
    """
    import duckdb

    root = Path(lake).resolve()
    manifest = load(root)
    connection = duckdb.connect(
        ":memory:",
        config={
            "autoinstall_known_extensions": False,
            "autoload_known_extensions": False,
            "allow_community_extensions": False,
        },
    )
    for statement in view_statements(manifest, locate=lambda path: str(root / path)):
        connection.execute(statement)
    folders = ", ".join(quote(str(root / table.name)) for table in TABLES)
    for setting in (
        "temp_directory = ''",
        "python_enable_replacements = false",
        "allow_persistent_secrets = false",
        f"allowed_directories = [{folders}]",
        "enable_external_access = false",
        "lock_configuration = true",
    ):
        connection.execute(f"SET {setting}")
    return connection


def query(connection: "duckdb.DuckDBPyConnection", sql: str) -> "duckdb.DuckDBPyRelation":
    """Run one SELECT (or EXPLAIN of one) and return its result.

    Raises:
        QueryError: not exactly one SELECT, or DuckDB's own message with the list of tables.
    """
    import duckdb

    try:
        statements = connection.extract_statements(sql)
        kinds = [statement.type for statement in statements]
        allowed = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)
        if len(statements) != 1 or kinds[0] not in allowed:
            asked = ", ".join(str(kind).rpartition(".")[2] for kind in kinds) or "nothing"
            raise QueryError(f"one SELECT or EXPLAIN at a time; got {asked}. The lake is read-only.")
        if kinds[0] == duckdb.StatementType.EXPLAIN:
            _refuse_explained_writes(connection, statements[0].query)
        return connection.sql(statements[0].query)
    except duckdb.Error as failed:
        raise QueryError(f"{failed}\nTables: {', '.join(table.name for table in TABLES)}.") from failed


def _refuse_explained_writes(connection: "duckdb.DuckDBPyConnection", sql: str) -> None:
    """EXPLAIN ANALYZE runs what it explains, so that must be a SELECT as well."""
    import re

    import duckdb

    inner = re.sub(r"^\s*EXPLAIN(\s+ANALYZE)?(\s*\([^)]*\))?\s+", "", sql, flags=re.IGNORECASE)
    kinds = [statement.type for statement in connection.extract_statements(inner)]
    if kinds != [duckdb.StatementType.SELECT]:
        raise QueryError("EXPLAIN explains a SELECT here; the lake is read-only.")
