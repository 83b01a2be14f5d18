"""A lake opened for SQL: an in-memory connection with its views and macros, read-only in fact."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from tracklake.pipeline.lake.admission import admit_select, query_errors
from tracklake.pipeline.lake.catalog import create_views, describe_views, escape_pattern
from tracklake.pipeline.lake.errors import QueryError
from tracklake.pipeline.lake.files import TABLE_BY_NAME
from tracklake.pipeline.lake.history import load_as_of
from tracklake.pipeline.lake.manifest import Manifest
from tracklake.pipeline.lake.object_access import admit_place, quote
from tracklake.pipeline.lake.places import find_place
from tracklake.pipeline.lake.results import LakeResult
from tracklake.schemas import TABLES, Table

if TYPE_CHECKING:
    import duckdb

Parameters = Mapping[str, Any] | Sequence[Any]
MOST_STORED_ROWS = 1_000_000
"""Most rows of a table that `open_stored` holds in memory."""


class LakeConnection:
    """A lake opened for SQL; made by `connect`. One SELECT at a time, and nothing else, as in `query`.

    What it returns is a `LakeResult`: `.pl()`, `.fetchall()`, `.columns` and the rest of what reads. Each has its own
    cursor: on a shared one another query ends a result that is being fetched, and threads disturb each other.
    """

    def __init__(self, raw: "duckdb.DuckDBPyConnection") -> None:
        self._raw = raw
        self._cursors: WeakSet[duckdb.DuckDBPyConnection] = WeakSet()

    def sql(
        self,
        statement: str,
        parameters: object = None,
        /,
        **frames: Any,  # noqa: ANN401  (of any library)
    ) -> LakeResult:
        """Return the result of a statement.

        Args:
            statement: one SELECT.
            parameters: values of its $names, or of its question marks in order.
            frames: tables of the user's own by name: Polars, pandas, Arrow, or another result.

        Raises:
            QueryError: see `query`; or a frame has a name of the lake's, or is no table.
        """
        if not isinstance(parameters, Mapping | Sequence | None):
            kind = type(parameters).__name__
            raise QueryError(f"parameters: expected values by name or in order; got {kind}. Give a frame another name.")
        with query_errors():
            cursor = self._raw.cursor()
        self._cursors.add(cursor)
        _lend_frames(cursor, frames)
        admitted = admit_select(cursor, statement)
        with query_errors():
            return LakeResult(cursor.sql(admitted, params=parameters or None), cursor)

    execute = sql
    """Same as `sql`, under the name that DuckDB's connections have."""

    def close(self) -> None:
        """Close the connection; a query that still runs, as after Ctrl-C, is broken off."""
        for cursor in list(self._cursors):
            cursor.interrupt()
        self._raw.close()

    def __enter__(self) -> "LakeConnection":
        """Use the connection in a `with` block."""
        return self

    def __exit__(self, *_raised: object) -> None:
        """Close the connection after a `with` block."""
        self.close()


def _lend_frames(cursor: "duckdb.DuckDBPyConnection", frames: Mapping[str, Any]) -> None:
    """Make frames tables of a cursor, which other cursors do not see."""
    import duckdb

    for name, frame in frames.items():
        if name.lower() in TABLE_BY_NAME:
            raise QueryError(f"a frame cannot be called {name}, as a table of the lake is. Give it another name.")
        try:
            cursor.register(name, frame.pl() if isinstance(frame, LakeResult) else frame)
        except (duckdb.Error, TypeError) as refused:
            raise QueryError(
                f"{name}: expected a table of Polars, pandas or Arrow; got {type(frame).__name__}"
            ) from refused


def connect(lake: Path | str, as_of: str | None = None) -> LakeConnection:
    """Open a lake for SQL: an in-memory DuckDB with the views, read-only in fact.

    Nothing but the lake's live files can be reached, no statement but a SELECT is admitted, no extension loaded, no
    setting changed.

    Args:
        lake: the lake's folder, wherever it stands now, or its address on an object store.
        as_of: generation or time of which it is shown, see `load_as_of`; None: as it is.

    Raises:
        LakeMissingError: no lake there.
        LakeError: a live file is missing or unreadable, or nothing is kept of `as_of`.
    """
    import duckdb

    place = find_place(lake)
    manifest = load_as_of(place, as_of)
    connection = duckdb.connect(
        ":memory:",
        config={
            "autoinstall_known_extensions": False,
            "autoload_known_extensions": False,
            "allow_community_extensions": False,
            "allow_persistent_secrets": False,
        },
    )
    admit_place(connection, place)
    locations = create_views(connection, place, manifest)
    describe_views(connection)
    live = [locations.find(file) for table in TABLES for file in manifest.live(table.name)]
    # Files, not folders: some functions that a SELECT may call would write new files into an allowed folder.
    allowed = ", ".join(quote(path) for path in {*live, *map(escape_pattern, live)})
    for setting in (
        "temp_directory = ''",
        "python_enable_replacements = false",
        f"allowed_paths = [{allowed}]",
        "enable_external_access = false",
        "lock_configuration = true",
    ):
        connection.execute(f"SET {setting}")
    return LakeConnection(connection)


def open_recordings(root: Path, manifest: Manifest, recordings: Collection[str]) -> "duckdb.DuckDBPyConnection":
    """Open some recordings for statements of our own: views as if the lake held only these (`dataset/recording`).

    One thread, as others work on other recordings. It is DuckDB's own connection: through LakeConnection's relations a
    large result of a statement with parameters takes ten times as long.

    Raises:
        LakeError: a live file is missing or unreadable.
    """
    import duckdb

    connection = duckdb.connect(":memory:", config={"threads": 1})
    create_views(connection, root, manifest.of_recordings(recordings))
    return connection


def open_stored(root: Path, manifest: Manifest, tables: Collection[Table]) -> "duckdb.DuckDBPyConnection":
    """Open a lake for many statements of our own: the files of some tables are opened once, not by each statement.

    Larger ones than MOST_STORED_ROWS are views as all others.

    Raises:
        LakeError: a live file is missing or unreadable.
    """
    import duckdb

    connection = duckdb.connect(":memory:")
    rows = {table.name: sum(file.rows or 0 for file in manifest.live(table.name)) for table in tables}
    stored = {name for name, count in rows.items() if 0 < count <= MOST_STORED_ROWS}
    create_views(connection, root, manifest, stored=stored)
    return connection


def query(connection: LakeConnection, sql: str) -> LakeResult:
    """Run one SELECT and return its result; EXPLAIN of one, DESCRIBE, SUMMARIZE and SHOW are selects, too.

    DuckDB computes a result when it is fetched, and what fails only then raises a QueryError there.

    Raises:
        QueryError: not exactly one SELECT, or DuckDB's own message with the lists of tables and macros.
    """
    return connection.sql(sql)
