"""A lake opened for SQL: an in-memory connection with its views and macros, read-only in fact."""

import re
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import polars as pl

from tracklake.pipeline.lake.catalog import create_views, escape_pattern, quote
from tracklake.pipeline.lake.errors import QueryError
from tracklake.pipeline.lake.files import TABLE_BY_NAME
from tracklake.pipeline.lake.macros import MACROS
from tracklake.pipeline.lake.manifest import Manifest, load
from tracklake.schemas import TABLES
from tracklake.schemas.errors import MissingExtraError
from tracklake.schemas.text import make_visible

if TYPE_CHECKING:
    import duckdb
    import pyarrow
    from duckdb.sqltypes import DuckDBPyType

_EXPLAIN = re.compile(r"^(\s|--[^\n]*\n)*EXPLAIN(\s+ANALYZE)?(\s*\([^)]*\))?\s+", re.IGNORECASE)
_WORD = re.compile(r'\w+|"(""|[^"])*"')
_SWITCHES = {
    *("enable_logging", "disable_logging", "enable_profiling", "disable_profiling"),
    *("query", "json_execute_serialized_sql"),
}
"""Functions by which a SELECT changes a setting in spite of the locked configuration, or runs a text it made up. What
they would write is refused by the file system all the same, but DuckDB then ends the whole process."""

_PIVOT_HINT = (
    " A PIVOT that finds out the values by itself creates a type first; with the values named it is one SELECT: "
    "PIVOT ... ON lane IN (1, 2, 3)."
)

_PLAIN = {
    *("boolean", "varchar", "enum", "sqlnull", "float", "double", "decimal"),
    *(f"{sign}{size}int" for sign in ("", "u") for size in ("tiny", "small", "big", "huge")),
    *("integer", "uinteger"),
}
"""DuckDB's types whose values any format holds as they are."""
_POLARS_TYPES = {
    *_PLAIN,
    *("blob", "uuid", "date", "time", "timestamp", "timestamp_s", "timestamp_ms", "timestamp_ns"),
    "timestamp with time zone",
}
"""DuckDB's types that Polars holds; others, such as INTERVAL, UNION and BIT, become text in a frame."""

SHOWN_ROWS = 20
"""Most rows of a result that `show` and notebooks print."""

Parameters = Mapping[str, Any] | Sequence[Any]


class LakeResult:
    """The result of a SELECT; DuckDB computes it when it is fetched.

    Not DuckDB's own relation: that writes files and creates tables, and runs any statement by its `query`. Whatever
    reads Arrow streams takes it as it is: `pl.DataFrame(result)`, `pyarrow.table(result)`.

    Args:
        relation: DuckDB's result.
        owner: connection that the relation needs, where no other object holds it.
    """

    def __init__(self, relation: "duckdb.DuckDBPyRelation", owner: "duckdb.DuckDBPyConnection | None" = None) -> None:
        self._relation = relation
        self._owner = owner

    def __repr__(self) -> str:
        """Name the columns; nothing is computed."""
        columns = ", ".join(f"{name} {kind}" for name, kind in zip(self.columns, self.types, strict=True))
        return f"LakeResult({columns}); rows by .show(), .pl(), .df(), .arrow(), .fetchall()"

    def _repr_html_(self) -> str:
        """Show the first rows in a notebook."""
        frame, note = _take_first(self, SHOWN_ROWS)
        return f"{frame._repr_html_()}<small>{note}</small>"

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """Hand the rows to whatever reads Arrow streams, with the types of `pl`."""
        return self.pl().__arrow_c_stream__(requested_schema)

    @property
    def columns(self) -> list[str]:
        """Names of the columns, in order."""
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
        """Return all rows that were not fetched yet."""
        return self._relation.fetchall()

    def fetchone(self) -> tuple[Any, ...] | None:
        """Return the next row, or None after the last one."""
        return self._relation.fetchone()

    def count(self) -> int:
        """Return the number of rows, by a query of its own."""
        ((rows,),) = self._relation.count("*").fetchall()
        return int(rows)

    def pl(self) -> pl.DataFrame:
        """Return the rows as a Polars frame; whole numbers of 128 bits, as DuckDB's sums are, in 64 where they fit.

        Where they do not, they are Decimal, which JSON writes as text. Types that Polars lacks become text.
        """
        frame = self._cast(_POLARS_TYPES).pl()
        wide = [column for column, kind in zip(frame, self.types, strict=True) if str(kind) in ("HUGEINT", "UHUGEINT")]
        fitting = [column.cast(pl.Int64, strict=False) for column in wide]
        return frame.with_columns(
            narrow for column, narrow in zip(wide, fitting, strict=True) if narrow.null_count() == column.null_count()
        )

    def arrow(self) -> "pyarrow.Table":
        """Return the rows as a PyArrow table, with the types of `pl`."""
        return self.pl().to_arrow()

    def df(self) -> Any:  # noqa: ANN401  (pandas need not be installed)
        """Return the rows as a pandas DataFrame, with the types of `pl`.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        if find_spec("pandas") is None:
            raise MissingExtraError(
                "a pandas DataFrame needs pandas: `pip install pandas`, or use `.pl()` or `.arrow()`"
            )
        return self.pl().to_pandas()

    def show(self, rows: int = SHOWN_ROWS) -> None:
        """Print the first rows as a table, and how many there are."""
        frame, note = _take_first(self, rows)
        with pl.Config(tbl_rows=rows, tbl_hide_dataframe_shape=True):
            sys.stdout.write(f"{make_visible(str(frame), keep=chr(10))}\n{note}\n")

    def to_text(self, *, flat: bool = False, numbers: bool = False) -> "LakeResult":
        """Return the rows with values that JSON does not know (dates, intervals, bytes, UUIDs ...) as DuckDB's text.

        Args:
            flat: whether lists, structs and maps become text as a whole, for CSV.
            numbers: whether numbers and truth values become text, too.
        """
        return LakeResult(self._cast({"varchar"} if numbers else _PLAIN, flat=flat), self._owner)

    def _cast(self, kept: Set[str], *, flat: bool = False) -> "duckdb.DuckDBPyRelation":
        """Return the relation with types other than those kept, and other than lists and structs of them, as text."""
        wanted = [_name_cast(kind, kept, flat=flat) for kind in self.types]
        if all(name is None for name in wanted):
            return self._relation
        columns = []
        for place, (column, name) in enumerate(zip(self.columns, wanted, strict=True), start=1):
            value = f"#{place}" if name is None else f"CAST(#{place} AS {name})"
            columns.append(f"{value} AS {_quote_name(column)}")
        return self._relation.project(", ".join(columns))

    def limit(self, n: int, offset: int = 0) -> "LakeResult":
        """Return at most n rows, after the first `offset`."""
        return LakeResult(self._relation.limit(n, offset), self._owner)

    def project(self, expressions: str) -> "LakeResult":
        """Return other columns computed from these by a list of SQL expressions.

        Raises:
            QueryError: not admitted, or DuckDB's own message.
        """
        _refuse_switches(expressions)
        with query_errors():
            return LakeResult(self._relation.project(expressions), self._owner)


def _take_first(result: LakeResult, rows: int) -> tuple[pl.DataFrame, str]:
    """Return the first rows of a result, and a text that says how many there are."""
    frame = result.limit(rows + 1).pl()
    if frame.height <= rows:
        return frame, f"{frame.height:,} {'row' if frame.height == 1 else 'rows'}"
    return frame.head(rows), f"the first {rows:,} of {result.count():,} rows"


def _quote_name(name: str) -> str:
    """Return a name as a SQL identifier."""
    return '"' + name.replace('"', '""') + '"'


def _name_cast(kind: "DuckDBPyType", kept: Set[str], *, flat: bool) -> str | None:
    """Return the type to cast a column to, with text for types that are not kept; None: it stays as it is."""
    if kind.id in kept:
        return None
    if flat or kind.id not in ("list", "array", "struct", "map"):
        return "VARCHAR"
    # An array's second child is its length.
    children = cast("list[tuple[str, DuckDBPyType]]", [each for each in kind.children if each[0] != "size"])
    inner = [_name_cast(child, kept, flat=False) for _, child in children]
    if all(name is None for name in inner):
        return None
    names = [name or str(child) for name, (_, child) in zip(inner, children, strict=True)]
    if kind.id == "struct":
        fields = (f"{_quote_name(field)} {name}" for (field, _), name in zip(children, names, strict=True))
        return f"STRUCT({', '.join(fields)})"
    return f"MAP({names[0]}, {names[1]})" if kind.id == "map" else f"{names[0]}[]"


class LakeConnection:
    """A lake opened for SQL; made by `connect`. One SELECT at a time, and nothing else, as in `query`.

    What it returns is a `LakeResult`: `.pl()`, `.fetchall()`, `.columns` and the rest of what reads.
    """

    def __init__(self, raw: "duckdb.DuckDBPyConnection") -> None:
        self._raw = raw

    def sql(
        self,
        statement: str,
        parameters: Parameters | None = None,
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
        return _select_only(self._lend(frames) if frames else self._raw, statement, parameters)

    def _lend(self, frames: Mapping[str, Any]) -> "duckdb.DuckDBPyConnection":
        """Return a connection of its own with the frames, which those of a later query do not replace."""
        import duckdb

        own = self._raw.cursor()
        for name, frame in frames.items():
            if name.lower() in TABLE_BY_NAME:
                raise QueryError(f"a frame cannot be called {name}, as a table of the lake is. Give it another name.")
            try:
                own.register(name, frame.pl() if isinstance(frame, LakeResult) else frame)
            except (duckdb.Error, TypeError) as refused:
                raise QueryError(
                    f"{name}: expected a table of Polars, pandas or Arrow; got {type(frame).__name__}"
                ) from refused
        return own

    execute = sql
    """Same as `sql`, under the name that DuckDB's connections have."""

    def close(self) -> None:
        """Close the connection and the lake's files; a query that still runs, as after Ctrl-C, is broken off."""
        self._raw.interrupt()  # or closing waits for its end
        self._raw.close()

    def __enter__(self) -> "LakeConnection":
        """Use the connection in a `with` block."""
        return self

    def __exit__(self, *_raised: object) -> None:
        """Close the connection after a `with` block."""
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
    create_views(connection, root, manifest)
    live = [str(root / file.path) for table in TABLES for file in manifest.live(table.name)]
    # Files, not folders: some functions that a SELECT may call would write new files into an allowed folder.
    allowed = ", ".join(quote(path) for path in {*live, *map(escape_pattern, live)})
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


def query(connection: LakeConnection, sql: str) -> LakeResult:
    """Run one SELECT and return its result; EXPLAIN of one, DESCRIBE, SUMMARIZE and SHOW are selects, too.

    DuckDB computes a result when it is fetched: what fails only then fails there, see `query_errors`.

    Raises:
        QueryError: not exactly one SELECT, or DuckDB's own message with the lists of tables and macros.
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
            hint = _PIVOT_HINT if any(word.lower() == "pivot" for word in _split_words(sql)) else ""
            raise QueryError(f"one SELECT or EXPLAIN at a time; got {asked}. The lake is read-only.{hint}")
        if kinds[0] == duckdb.StatementType.EXPLAIN:
            _refuse_explained_writes(connection, statements[0].query)
        _refuse_switches(sql)
        return LakeResult(connection.sql(statements[0].query, params=parameters or None), connection)


def _refuse_switches(sql: str) -> None:
    words = _split_words(sql)
    for place, word in enumerate(words):
        name, following = word.strip('"').lower(), words[place + 1 :]
        if name in _SWITCHES and following[:1] == ["("] and not _continues_as_with(following):
            raise QueryError(f"{name}(...) is not available here; the lake is read-only.")


def _split_words(sql: str) -> list[str]:
    """Return a statement's words and signs, as DuckDB itself reads it: without comments, and a quote for every text."""
    import duckdb

    text, tokens = sql.encode(), duckdb.tokenize(sql)
    starts = [*(start for start, _ in tokens), len(text)]
    words = []
    for (start, kind), end in zip(tokens, starts[1:], strict=True):
        token = text[start:end].decode()  # with the blanks and comments behind it
        word = _WORD.match(token)
        words.append("'" if kind == duckdb.token_type.string_const else word[0] if word else token[0])
    return words


def _continues_as_with(following: list[str]) -> bool:
    """Return whether a name's following words are `(x, y) AS (`, as in a WITH and after no function call."""
    end = following.index(")") if ")" in following else 0
    is_list = all(word == "," or _WORD.fullmatch(word) for word in following[1:end])
    return is_list and [word.upper() for word in following[end + 1 : end + 3]] == ["AS", "("]


@contextmanager
def query_errors() -> Iterator[None]:
    """Turn what DuckDB raises, also on fetching, into a QueryError with the lists of tables and macros."""
    import duckdb

    try:
        yield
    except duckdb.Error as failed:
        tables = ", ".join(table.name for table in TABLES)
        macros = ", ".join(macro.signature for macro in MACROS)
        raise QueryError(f"{failed}\nTables: {tables}.\nMacros: {macros}.") from failed


def _refuse_explained_writes(connection: "duckdb.DuckDBPyConnection", sql: str) -> None:
    """EXPLAIN ANALYZE runs what it explains, so that must be a SELECT as well."""
    import duckdb

    inner = _EXPLAIN.sub("", sql)
    kinds = [statement.type for statement in connection.extract_statements(inner)]
    if kinds != [duckdb.StatementType.SELECT]:
        raise QueryError("EXPLAIN explains a SELECT here; the lake is read-only.")
