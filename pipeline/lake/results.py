"""The result of a query: rows for Python, Polars, pandas and Arrow, as text, and for a look at the first."""

import sys
from collections.abc import Set
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, cast

import polars as pl

from tracklake.pipeline.lake.admission import query_errors, refuse_switches
from tracklake.schemas.errors import MissingExtraError
from tracklake.schemas.text import make_visible

if TYPE_CHECKING:
    import duckdb
    import pyarrow
    from duckdb.sqltypes import DuckDBPyType

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


class LakeResult:
    """The result of a SELECT; DuckDB computes it when it is fetched, and a QueryError says what fails then.

    Not DuckDB's own relation: that writes files and creates tables, and runs any statement by its `query`. Whatever
    reads Arrow streams takes it as it is: `pl.DataFrame(result)`, `pyarrow.table(result)`.

    Args:
        relation: DuckDB's result.
        cursor: connection of its own, which it keeps open.
    """

    def __init__(self, relation: "duckdb.DuckDBPyRelation", cursor: "duckdb.DuckDBPyConnection") -> None:
        self._relation = relation
        self._cursor = cursor
        self._is_executed = False

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
        with query_errors():
            return self._relation.fetchall()

    def fetchone(self) -> tuple[Any, ...] | None:
        """Return the next row, or None after the last one."""
        with query_errors():
            if not self._is_executed:
                self._relation.execute()  # as a whole; of a stream the next query, such as `count`, would drop the rest
                self._is_executed = True
            return self._relation.fetchone()

    def count(self) -> int:
        """Return the number of rows, by a query of its own."""
        with query_errors():
            ((rows,),) = self._relation.count("*").fetchall()
        return int(rows)

    def pl(self) -> pl.DataFrame:
        """Return the rows as a Polars frame; whole numbers of 128 bits, as DuckDB's sums are, in 64 where they fit.

        Where they do not, they are Decimal, which JSON writes as text. Types that Polars lacks become text.
        """
        with query_errors():
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
        return LakeResult(self._cast({"varchar"} if numbers else _PLAIN, flat=flat), self._cursor)

    def _cast(self, kept: Set[str], *, flat: bool = False) -> "duckdb.DuckDBPyRelation":
        """Return the relation with types other than those kept, and other than lists and structs of them, as text."""
        wanted = [_name_cast(kind, kept, flat=flat) for kind in self.types]
        if all(name is None for name in wanted):
            return self._relation.project("*")  # all rows, also of a result of which some were fetched
        columns = []
        for place, (column, name) in enumerate(zip(self.columns, wanted, strict=True), start=1):
            value = f"#{place}" if name is None else f"CAST(#{place} AS {name})"
            columns.append(f"{value} AS {_quote_name(column)}")
        return self._relation.project(", ".join(columns))

    def limit(self, n: int, offset: int = 0) -> "LakeResult":
        """Return at most n rows, after the first `offset`."""
        return LakeResult(self._relation.limit(n, offset), self._cursor)

    def project(self, expressions: str) -> "LakeResult":
        """Return other columns computed from these by a list of SQL expressions.

        Raises:
            QueryError: not admitted, or DuckDB's own message.
        """
        refuse_switches(expressions)
        with query_errors():
            return LakeResult(self._relation.project(expressions), self._cursor)


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
