"""What a lake admits of SQL: one SELECT at a time, and no function by which that would do more than read."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tracklake.pipeline.lake.errors import QueryError
from tracklake.pipeline.lake.files import STORE
from tracklake.pipeline.lake.macros import MACROS
from tracklake.schemas import TABLES

if TYPE_CHECKING:
    import duckdb

_EXPLAIN = re.compile(r"^(\s|--[^\n]*\n)*EXPLAIN(\s+ANALYZE)?(\s*\([^)]*\))?\s+", re.IGNORECASE)
_WORD = re.compile(r'\w+|"(""|[^"])*"')
_SWITCHES = {
    *("enable_logging", "disable_logging", "enable_profiling", "disable_profiling"),
    *("query", "json_execute_serialized_sql", "duckdb_secrets"),
}
"""Functions that show how an object store is signed in to; by which a SELECT changes a setting in spite of the locked
configuration; or that run a text it made up. What they would write is refused by the file system all the same, but
DuckDB then ends the whole process."""

_PIVOT_HINT = (
    " A PIVOT that finds out the values by itself creates a type first; with the values named it is one SELECT: "
    "PIVOT ... ON lane IN (1, 2, 3)."
)


def admit_select(connection: "duckdb.DuckDBPyConnection", sql: str) -> str:
    """Return the only statement of a text, which reads.

    Raises:
        QueryError: it is none, there are more, or DuckDB cannot parse it.
    """
    import duckdb

    with query_errors():
        statements = connection.extract_statements(sql)
    kinds = [statement.type for statement in statements]
    allowed = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)
    if len(statements) != 1 or kinds[0] not in allowed:
        asked = ", ".join(str(kind).rpartition(".")[2] for kind in kinds) or "nothing"
        hint = _PIVOT_HINT if any(word.lower() == "pivot" for word in _split_words(sql)) else ""
        raise QueryError(f"one SELECT or EXPLAIN at a time; got {asked}. The lake is read-only.{hint}")
    with query_errors():
        if kinds[0] == duckdb.StatementType.EXPLAIN:
            _refuse_explained_writes(connection, statements[0].query)
    refuse_switches(sql)
    return statements[0].query


def _refuse_explained_writes(connection: "duckdb.DuckDBPyConnection", sql: str) -> None:
    """EXPLAIN ANALYZE runs what it explains, so that must be a SELECT as well."""
    import duckdb

    inner = _EXPLAIN.sub("", sql)
    kinds = [statement.type for statement in connection.extract_statements(inner)]
    if kinds != [duckdb.StatementType.SELECT]:
        raise QueryError("EXPLAIN explains a SELECT here; the lake is read-only.")


def refuse_switches(sql: str) -> None:
    """Refuse calls of functions that change a setting or run a text.

    Raises:
        QueryError: there is one.
    """
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
    except duckdb.ConnectionException as closed:
        raise QueryError(
            "the lake was closed before this result was fetched; fetch it first, or open it again"
        ) from closed
    except duckdb.Error as failed:
        unread = isinstance(failed, duckdb.InvalidInputException | duckdb.IOException)
        if unread and f"{STORE}/" in str(failed):  # the file's path
            raise QueryError(f"{failed}\nThe file is damaged; `tracklake check` says how it is made again.") from failed
        tables = ", ".join(table.name for table in TABLES)
        macros = ", ".join(macro.signature for macro in MACROS)
        raise QueryError(f"{failed}\nTables: {tables}.\nMacros: {macros}.") from failed
