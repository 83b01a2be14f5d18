"""Declaration of tables: columns, dtypes, units, keys and structural rules.

A table is declared once, as data: its columns, dtypes, meanings, units, key and structural rules. The writer, the
catalog, the validation and the documentation all read that one declaration.
"""

import operator
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import polars as pl

from tracklake.schemas.errors import TracklakeError

if TYPE_CHECKING:
    import pandera.polars as pa
    from pandera.errors import SchemaErrors

FOOT_M = 0.3048
"""Metres in one international foot, exactly."""
Dataset = Literal["ngsim", "highd", "exid", "ind", "round", "tgsim", "i24", "custom", "v2v"]
DATASETS: tuple[Dataset, ...] = get_args(Dataset)
Origin = Literal["recorded", "synthetic"]
ORIGINS: tuple[Origin, ...] = get_args(Origin)
VEHICLE_CLASSES = ("car", "truck", "motorcycle")
SEVERITIES = ("error", "warning", "info")
PARTS = ("train", "val", "eval")
LATERAL_MANEUVERS = ("keep", "left", "right")
LONGITUDINAL_MANEUVERS = ("normal", "brake")

DType = type[pl.DataType] | pl.DataType


@dataclass(frozen=True)
class Column:
    """Declaration of one column of a table.

    Args:
        dtype: Polars dtype, exact.
        description: what a value means: origin, sign, and null where it needs saying.
        unit: SI symbol, or None for a pure number, a name or a flag.
        nullable: whether null is a legal value; NaN never is.
        ge: least value; a value outside these bounds is a wrong unit or a wrong column, not a bad measurement.
        gt: bound that a value exceeds.
        le: greatest value.
        lt: bound that a value stays under.
        isin: the only values.
        added: whether files of earlier lakes of the same schema version lack the column, which then is null.
    """

    dtype: DType
    description: str
    _: KW_ONLY
    unit: str | None = None
    nullable: bool = False
    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    isin: tuple[str, ...] | None = None
    added: bool = False

    @property
    def comment(self) -> str:
        """Meaning with the unit before it, as shown in databases: `[m] front centre ...`."""
        return self.description if self.unit is None else f"[{self.unit}] {self.description}"

    def make_pandera_column(self) -> "pa.Column":
        """Return the column as Pandera checks it."""
        import pandera.polars as pa

        given = ((name, getattr(self, name)) for name in (*BOUNDS, "isin"))
        checks = [getattr(pa.Check, name)(limit) for name, limit in given if limit is not None]
        return pa.Column(self.dtype, checks=checks, nullable=self.nullable, description=self.description)

    def list_rules(self, values: pl.Expr) -> list[pl.Expr]:
        """Return expressions, one boolean each, that are all true for a valid column; an empty one keeps every bound.

        Args:
            values: the column in a frame of the table's dtypes.
        """
        rules = [
            holds(getattr(values, end)(), limit).fill_null(value=True)
            for name, (holds, end) in BOUNDS.items()
            if (limit := getattr(self, name)) is not None
        ]
        if self.isin is not None:
            rules.append(values.is_in(list(self.isin)).all())
        if not self.nullable:
            rules.append(values.null_count() == 0)
            if self.dtype in (pl.Float32, pl.Float64):
                rules.append(~values.is_nan().any())
        return rules


BOUNDS: Mapping[str, tuple[Callable[[pl.Expr, Any], pl.Expr], str]] = {
    "ge": (operator.ge, "min"),
    "gt": (operator.gt, "min"),
    "le": (operator.le, "max"),
    "lt": (operator.lt, "max"),
}
"""Bounds of a column by name: the comparison, and whether the least or the greatest value is compared."""

column = Column

DATASET = column(
    pl.String,
    "ngsim, highd, exid, ind, round, tgsim, i24, custom (read with --columns), or v2v (drives)",
    isin=DATASETS,
)
SUBSET = column(pl.String, "one carriageway (arterials: one direction) of one recording; v2v: one drive")
PLACE = {"dataset": DATASET, "subset": SUBSET}
"""Columns that say where a row belongs, the folders of most tables."""
PROTOCOL = column(pl.String, "named, hashed recipe of sampling, split and metrics")


def key_increases(key: tuple[str, ...]) -> pl.Expr:
    """Return an expression that is true where a row's key is lexicographically greater than that of the row before.

    One such check over a whole table proves that it is sorted, that its key is unique and that frames increase
    within a vehicle, for the price of one comparison per key column.
    """
    increases = pl.lit(value=False)
    for name in reversed(key):
        now, before = pl.col(name), pl.col(name).shift(1)
        increases = (now > before) | (now.eq_missing(before) & increases)
    return increases | (pl.int_range(pl.len()) == 0)


@dataclass(frozen=True, eq=False)  # declared once and compared by identity, so that a table can be a key
class Table:
    """Declaration of one table of the lake.

    Args:
        key: columns that are unique together and by which every file is sorted.
        partition: columns of the hive folders, which are in a file's path and not in the file.
    """

    name: str
    meaning: str
    key: tuple[str, ...]
    columns: Mapping[str, Column]
    partition: tuple[str, ...] = ("dataset", "subset")

    @cached_property
    def dtypes(self) -> dict[str, pl.DataType]:
        """Column names and Polars dtypes, in order."""
        kinds = {name: declared.dtype for name, declared in self.columns.items()}
        return {name: kind() if isinstance(kind, type) else kind for name, kind in kinds.items()}

    @cached_property
    def schema(self) -> "pa.DataFrameSchema":
        """Pandera schema of the table: exactly these columns, no silent casts, the key sorted and unique."""
        import pandera.polars as pa  # a third of the time that a query's command takes to start

        return pa.DataFrameSchema(
            columns={name: declared.make_pandera_column() for name, declared in self.columns.items()},
            checks=[
                pa.Check(
                    lambda data: data.lazyframe.select(key_increases(self.key)),
                    name="key_is_unique_and_sorted",
                    error=f"({', '.join(self.key)}) strictly increases from row to row",
                )
            ],
            strict=True,
            coerce=False,
            name=self.name,
            description=self.meaning,
        )

    @cached_property
    def bounds(self) -> dict[str, tuple[float | None, float | None]]:
        """Least and greatest value of the columns that declare a bound, itself included or not."""
        limits = {
            name: (one.gt if one.ge is None else one.ge, one.lt if one.le is None else one.le)
            for name, one in self.columns.items()
        }
        return {name: found for name, found in limits.items() if found != (None, None)}

    @cached_property
    def required(self) -> frozenset[str]:
        """Columns in which null is no legal value."""
        return frozenset(name for name, declared in self.columns.items() if not declared.nullable)

    @cached_property
    def added(self) -> dict[str, pl.DataType]:
        """Columns that files of earlier lakes lack, and their dtypes."""
        return {name: self.dtypes[name] for name, declared in self.columns.items() if declared.added}

    def empty(self) -> pl.DataFrame:
        """Return a frame without rows."""
        return pl.DataFrame(schema=self.dtypes)

    def conform(self, frame: pl.LazyFrame) -> pl.LazyFrame:
        """Select the table's columns in order and cast them; a missing column is an error, a lossy cast as well."""
        return frame.select(pl.col(name).cast(dtype) for name, dtype in self.dtypes.items())

    def validate(self, frame: pl.DataFrame, *, where: str) -> pl.DataFrame:
        """Check a frame against every structural rule and return it; `where` names its recording or file.

        Raises:
            StructureError: naming the table, the place, each broken rule, how many rows break it and one of them.
        """
        if dict(frame.schema) == self.dtypes and frame.select(self._holds).item():
            return frame
        from pandera.errors import SchemaErrors

        try:
            return self.schema.validate(frame, lazy=True)
        except SchemaErrors as broken:
            raise StructureError(self, where, broken) from None

    @cached_property
    def _holds(self) -> pl.Expr:
        """Expression that is true for a valid frame: all checks in one pass, where Pandera takes one for each.

        Pandera then explains what is wrong with an invalid frame.
        """
        rules = [rule for name, declared in self.columns.items() for rule in declared.list_rules(pl.col(name))]
        return pl.all_horizontal(key_increases(self.key).all(), *rules)

    def describe(self) -> list[dict[str, str]]:
        """Describe each column in a row: column, dtype, unit, null, meaning."""
        return [
            {
                "column": name,
                "dtype": "Enum" if isinstance(self.dtypes[name], pl.Enum) else str(self.dtypes[name]),
                "unit": declared.unit or "",
                "null": "yes" if declared.nullable else "",
                "meaning": declared.description,
            }
            for name, declared in self.columns.items()
        ]


class StructureError(TracklakeError):
    """A frame breaks the structural rules of its table; the recording it came from cannot enter the lake."""

    def __init__(self, table: Table, where: str, broken: "SchemaErrors") -> None:
        """Put pandera's failure cases (never printed whole: one row per bad value) into a few lines."""
        cases: Any = broken.failure_cases
        lines = [
            f"  {column_name or 'table'}: {check}: {rows} row(s), for example {example}"
            for column_name, check, rows, example in cases.group_by("column", "check", maintain_order=True)
            .agg(pl.len().alias("rows"), pl.col("failure_case").first().alias("example"))
            .iter_rows()
        ]
        super().__init__(f"{where}: the table `{table.name}` breaks its schema\n" + "\n".join(lines))
