"""The one-pass check of a table against Pandera's own verdict on the same frame."""

import math

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pandera.errors import SchemaErrors

from tracklake.schemas import TABLES
from tracklake.schemas.columns import StructureError, Table, column

TABLE = Table(
    "things",
    "One row per thing.",
    key=("id", "part"),
    partition=(),
    columns={
        "id": column(pl.Int32, "of the thing", ge=0, lt=5),
        "part": column(pl.Int16, "of the thing; null sorts first", nullable=True),
        "size_m": column(pl.Float64, "of the part", gt=0, le=10),
        "speed_mps": column(pl.Float32, "of the part", nullable=True, ge=-1.5),
        "kind": column(pl.String, "of the part", nullable=True, isin=("a", "b")),
    },
)
ROWS = st.tuples(
    st.integers(-1, 6),
    st.sampled_from([None, -1, 0, 1]),
    st.sampled_from([None, 0.0, 0.001, 10.0, 10.001, math.nan, math.inf]),
    st.sampled_from([None, -1.5, -1.6, 0.0, math.nan, -math.inf]),
    st.sampled_from([None, "a", "b", "c", ""]),
)


def accepted_by_pandera(frame):
    try:
        TABLE.schema.validate(frame, lazy=True)
    except SchemaErrors:
        return False
    return True


@given(rows=st.lists(ROWS, max_size=4), in_order=st.booleans())
@settings(max_examples=105, deadline=None)
def test_one_pass_admits_what_pandera_admits(rows, in_order):
    if in_order:
        rows = sorted(rows, key=lambda row: (row[0], -9 if row[1] is None else row[1]))
    frame = pl.DataFrame(rows, schema=TABLE.dtypes, orient="row")
    assert frame.select(TABLE._holds).item() == accepted_by_pandera(frame)


GOOD = (0, 0, 1.0, 0.0, "a")


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"id": -1}, "id: greater_than_or_equal_to"),
        ({"id": 5}, "id: less_than"),
        ({"id": None}, "id: not_nullable"),
        ({"size_m": 0.0}, "size_m: greater_than"),
        ({"size_m": 10.5}, "size_m: less_than_or_equal_to"),
        ({"size_m": math.nan}, "size_m: not_nullable"),
        ({"kind": "c"}, "kind: isin"),
    ],
)
def test_every_structural_rule_fires_by_name(changed, said):
    good = pl.DataFrame([GOOD], schema=TABLE.dtypes, orient="row")
    assert TABLE.validate(good, where="here") is good
    row = dict(zip(TABLE.dtypes, GOOD, strict=True)) | changed
    with pytest.raises(StructureError, match=rf"^here: the table `things`.*\n  {said}"):
        TABLE.validate(pl.DataFrame([row], schema=TABLE.dtypes), where="here")


@pytest.mark.parametrize(
    "frame",
    [
        pl.DataFrame([GOOD, GOOD], schema=TABLE.dtypes, orient="row"),
        pl.DataFrame([GOOD], schema=TABLE.dtypes, orient="row").drop("kind"),
        pl.DataFrame([GOOD], schema=TABLE.dtypes, orient="row").with_columns(more=1),
        pl.DataFrame([GOOD], schema=TABLE.dtypes, orient="row").cast({"id": pl.Int64}),
    ],
    ids=["a key twice", "a column missing", "a column too many", "another dtype"],
)
def test_what_concerns_the_whole_frame_is_refused_too(frame):
    with pytest.raises(StructureError, match="here: the table `things` breaks its schema"):
        TABLE.validate(frame, where="here")


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_an_empty_frame_is_admitted(table):
    assert table.empty().select(table._holds).item() is True


def a_value(declared, dtype):
    """One that the column admits: 1 lies within the bounds of all numbers that are declared."""
    if declared.isin is not None:
        return declared.isin[0]
    if isinstance(dtype, pl.Enum):
        return dtype.categories[0]
    if dtype == pl.String:
        return "a"
    return [] if dtype.is_nested() else 1


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_the_tables_of_the_lake_admit_what_their_columns_admit(table):
    row = {name: [a_value(declared, table.dtypes[name])] for name, declared in table.columns.items()}
    frame = pl.DataFrame(row, schema=table.dtypes, strict=False)
    assert frame.null_count().sum_horizontal().item() == 0
    assert frame.select(table._holds).item() is True
