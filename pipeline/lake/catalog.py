"""The lake as SQL: views over the live Parquet files, in catalog.duckdb and on sandboxed in-memory connections."""

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl
from polars.datatypes import DataTypeClass

from pipeline.lake.errors import LakeError, QueryError
from pipeline.lake.files import partition_values
from pipeline.lake.manifest import Manifest, load, write_aside
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


_EXPLAIN = re.compile(r"^(\s|--[^\n]*\n)*EXPLAIN(\s+ANALYZE)?(\s*\([^)]*\))?\s+", re.IGNORECASE)
_SWITCHES = re.compile(
    r"""\b((enable|disable)_(logging|profiling)\b|query"?(\s|/\*.*?\*/|--[^\n]*\n)*\()""", re.IGNORECASE | re.DOTALL
)
"""Functions by which a SELECT changes a setting in spite of the locked configuration, or runs a text it made up. What
they would write is refused by the file system all the same, but DuckDB then ends the whole process."""


def sql_type(dtype: pl.DataType | DataTypeClass) -> str:
    """DuckDB's name of a Polars dtype."""
    if isinstance(dtype, pl.List):
        return f"{sql_type(dtype.inner)}[]"
    if isinstance(dtype, pl.Struct):
        inner = ", ".join(f'"{field.name}" {sql_type(field.dtype)}' for field in dtype.fields)
        return f"STRUCT({inner})"
    instance = dtype() if isinstance(dtype, type) else dtype
    return _SQL_TYPES[instance]


def quote(text: str) -> str:
    """A SQL string literal."""
    return "'" + text.replace("'", "''") + "'"


def _literally(path: str) -> str:
    """A path in which DuckDB finds no pattern."""
    return re.sub(r"[*?\[]", r"[\g<0>]", path)


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
        return " UNION ALL ".join(_one_file(table, path, locate) for path in paths)
    types = ", ".join(f"'{name}': {sql_type(table.dtypes[name])}" for name in table.partition)
    return (
        f"SELECT {columns} FROM read_parquet([{', '.join(files)}], hive_partitioning = true, hive_types = {{{types}}})"
    )


def _one_file(table: Table, path: str, locate: Callable[[str], str]) -> str:
    stated = partition_values(table, path)
    columns = ", ".join(
        f'CAST({quote(stated[name])} AS {sql_type(dtype)}) AS "{name}"' if name in stated else f'"{name}"'
        for name, dtype in table.dtypes.items()
    )
    return f"SELECT {columns} FROM read_parquet([{quote(locate(path))}], hive_partitioning = false)"


def _create_views(
    connection: "duckdb.DuckDBPyConnection", root: Path, manifest: Manifest, locate: Callable[[str], str]
) -> None:
    import duckdb

    for table, statement in zip(TABLES, view_statements(manifest, locate), strict=True):
        try:
            connection.execute(statement)
        except duckdb.Error as failed:
            reason = str(failed).splitlines()[0]
            raise LakeError(
                f"{root}: the table `{table.name}` cannot be read: {reason}\nIf its files were removed or damaged, "
                f"`tracklake run SOURCE --lake {root}` on the raw files makes them again."
            ) from failed


def rebuild(root: Path, manifest: Manifest) -> None:
    """Replace catalog.duckdb, the last step of a session; its views hold paths relative to the lake's folder.

    It is made in a temporary folder, where the lake goes by a link. Views are checked on creation against files
    relative to DuckDB's search path, which is a list of patterns without a way to quote, and "?" in a database's path
    starts its options; a lake may be called "a,b" or "c[1]?".

    Raises:
        LakeError: a live file is missing or unreadable; the catalog of before stays.
    """
    import duckdb

    with tempfile.TemporaryDirectory() as elsewhere:
        made, link = Path(elsewhere) / CATALOG, Path(elsewhere) / "lake"
        link.symlink_to(root.resolve(), target_is_directory=True)
        with duckdb.connect(str(made)) as connection:
            connection.execute(f"SET file_search_path = {quote(str(link))}")
            _create_views(connection, root, manifest, locate=str)
            for table in TABLES:
                connection.execute(f'COMMENT ON VIEW "{table.name}" IS {quote(table.meaning)}')
        content = made.read_bytes()
    # What a client that wrote to the old catalog left would be replayed into the new one.
    (root / f"{CATALOG}.wal").unlink(missing_ok=True)
    write_aside(root / CATALOG, content)


Parameters = Mapping[str, Any] | Sequence[Any]


class LakeResult:
    """What a SELECT found; DuckDB computes it when it is fetched.

    Not DuckDB's own relation: that writes files and creates tables, and runs any statement by its `query`.
    """

    def __init__(self, relation: "duckdb.DuckDBPyRelation") -> None:
        self._relation = relation

    @property
    def columns(self) -> list[str]:
        """The columns' names."""
        return self._relation.columns

    @property
    def types(self) -> list[Any]:
        """The columns' DuckDB types; `str` gives their SQL names."""
        return list(self._relation.types)

    @property
    def description(self) -> list[tuple[Any, ...]]:
        """One tuple per column, as PEP 249 has it: its name, its type, and five that are unknown."""
        return list(self._relation.description)

    def fetchall(self) -> list[tuple[Any, ...]]:
        """All rows that were not fetched yet."""
        return self._relation.fetchall()

    def fetchone(self) -> tuple[Any, ...] | None:
        """The next row, or None after the last one."""
        return self._relation.fetchone()

    def pl(self) -> pl.DataFrame:
        """The rows as a Polars frame."""
        return self._relation.pl()

    def limit(self, n: int, offset: int = 0) -> "LakeResult":
        """At most n rows, after the first `offset`."""
        return LakeResult(self._relation.limit(n, offset))

    def project(self, expressions: str) -> "LakeResult":
        """Other columns computed of these, a list of SQL expressions.

        Raises:
            QueryError: not admitted, or DuckDB's own message.
        """
        _refuse_switches(expressions)
        with query_errors():
            return LakeResult(self._relation.project(expressions))


class LakeConnection:
    """A lake opened for SQL; made by `connect`. One SELECT at a time, and nothing else, as in `query`.

    What it returns is a `LakeResult`: `.pl()`, `.fetchall()`, `.columns` and the rest of what reads.
    """

    def __init__(self, raw: "duckdb.DuckDBPyConnection") -> None:
        self._raw = raw

    def sql(self, statement: str, parameters: Parameters | None = None) -> LakeResult:
        """The result of a statement.

        Args:
            statement: one SELECT.
            parameters: values of its $names, or of its question marks in order.

        Raises:
            QueryError: see `query`.
        """
        return _select_only(self._raw, statement, parameters)

    execute = sql
    """As DuckDB's connections have it."""

    def close(self) -> None:
        """Let go of the lake's files."""
        self._raw.close()

    def __enter__(self) -> "LakeConnection":
        """Use it in a `with` block."""
        return self

    def __exit__(self, *_raised: object) -> None:
        """Close it."""
        self.close()


def connect(lake: Path | str) -> LakeConnection:
    """Open a lake for SQL: an in-memory DuckDB with the views, read-only in fact.

    Nothing but the lake's live files can be reached, no statement but a SELECT is admitted, no extension loaded, no
    setting changed.

    Args:
        lake: the lake's folder, wherever it stands now.

    Raises:
        LakeMissingError: no lake there.
        LakeError: a live file is missing or unreadable.
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
    _create_views(connection, root, manifest, locate=lambda path: _literally(str(root / path)))
    live = [str(root / file.path) for table in TABLES for file in manifest.live(table.name)]
    # Files, not folders: some functions that a SELECT may call would write new files into an allowed folder.
    allowed = ", ".join(quote(path) for path in {*live, *map(_literally, live)})
    for setting in (
        "temp_directory = ''",
        "python_enable_replacements = false",
        "allow_persistent_secrets = false",
        f"allowed_paths = [{allowed}]",
        "enable_external_access = false",
        "lock_configuration = true",
    ):
        connection.execute(f"SET {setting}")
    return LakeConnection(connection)


def query(connection: LakeConnection, sql: str) -> LakeResult:
    """Run one SELECT and return its result; EXPLAIN of one, DESCRIBE, SUMMARIZE and SHOW are selects, too.

    DuckDB computes a result when it is fetched: what fails only then fails there, see `query_errors`.

    Raises:
        QueryError: not exactly one SELECT, or DuckDB's own message with the list of tables.
    """
    return connection.sql(sql)


def _select_only(connection: "duckdb.DuckDBPyConnection", sql: str, parameters: Parameters | None) -> LakeResult:
    import duckdb

    with query_errors():
        statements = connection.extract_statements(sql)
        kinds = [statement.type for statement in statements]
        allowed = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)
        if len(statements) != 1 or kinds[0] not in allowed:
            asked = ", ".join(str(kind).rpartition(".")[2] for kind in kinds) or "nothing"
            raise QueryError(f"one SELECT or EXPLAIN at a time; got {asked}. The lake is read-only.")
        if kinds[0] == duckdb.StatementType.EXPLAIN:
            _refuse_explained_writes(connection, statements[0].query)
        _refuse_switches(sql)
        return LakeResult(connection.sql(statements[0].query, params=parameters or None))


def _refuse_switches(sql: str) -> None:
    if switch := _SWITCHES.search(sql):
        raise QueryError(f"{switch[1]!r} is not available here; the lake is read-only.")


@contextmanager
def query_errors() -> Iterator[None]:
    """Turn what DuckDB raises, also while a result is fetched, into a QueryError with the list of tables."""
    import duckdb

    try:
        yield
    except duckdb.Error as failed:
        raise QueryError(f"{failed}\nTables: {', '.join(table.name for table in TABLES)}.") from failed


def _refuse_explained_writes(connection: "duckdb.DuckDBPyConnection", sql: str) -> None:
    """EXPLAIN ANALYZE runs what it explains, so that must be a SELECT as well."""
    import duckdb

    inner = _EXPLAIN.sub("", sql)
    kinds = [statement.type for statement in connection.extract_statements(inner)]
    if kinds != [duckdb.StatementType.SELECT]:
        raise QueryError("EXPLAIN explains a SELECT here; the lake is read-only.")
