"""How the table macros may be called: pruning, data sets, arguments, a query's own names, the catalog, headers."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import duckdb
import pytest
from macro_lake import CALLS, CHANGES, PAIRS, call, put_subset

from tracklake.pipeline.lake import QueryError, connect
from tracklake.pipeline.lake.macros import MACROS
from tracklake.pipeline.lake.query import LakeConnection
from tracklake.schemas import TRACKS


@pytest.fixture(scope="module")
def several(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three subsets, one of which stands in both data sets."""
    root = tmp_path_factory.mktemp("several")
    for dataset, subset in (("highd", "a"), ("highd", "b"), ("ngsim", "b"), ("ngsim", "c")):
        put_subset(root, PAIRS[: {"a": 9, "b": 7, "c": 4}[subset]], subset=subset, dataset=dataset)
    return root


@pytest.fixture(scope="module")
def opened(several: Path) -> Iterator[LakeConnection]:
    with connect(several) as connection:
        yield connection


@pytest.fixture(scope="module")
def unreadable(several: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LakeConnection]:
    """The same lake, where nothing but subset a can be read."""
    root = shutil.copytree(several, tmp_path_factory.mktemp("unreadable") / "lake")
    for file in root.glob(".files/*/*/subset=[bc]/*.parquet"):
        file.write_bytes(b"x" * file.stat().st_size)
    with connect(root) as connection:
        yield connection


@pytest.mark.parametrize("name", CALLS)
def test_a_macro_reads_its_subset_and_no_other(opened: LakeConnection, unreadable: LakeConnection, name: str):
    expected = opened.sql(f"FROM {call(name)}").fetchall()
    assert unreadable.sql(f"FROM {call(name)}").fetchall() == expected
    for subset, parameters in (("'a'", None), ("$asked", {"asked": "a"})):
        explained = f"EXPLAIN (ANALYZE, FORMAT json) FROM {call(name, subset)}"
        plan = opened.sql(explained, parameters).fetchall()[0][1]
        # Of four, or of one where the others were left out even earlier; for every reading there is.
        counts = re.findall(r'"Scanning Files": "(\d+)/[14]"', plan)
        assert counts == ["1"] * plan.count('"Function": "READ_PARQUET"')
    with pytest.raises(QueryError):
        unreadable.sql("SELECT sum(x_m) FROM tracks").fetchall()


def test_a_subset_of_two_data_sets_gives_both_apart(tmp_path: Path):
    here = {"highd": PAIRS + CHANGES, "ngsim": [{**row, "x_m": row["x_m"] + 10.0} for row in PAIRS[:7] + CHANGES]}
    expected: dict[str, list] = {name: [] for name in CALLS}
    for dataset, entries in here.items():
        put_subset(tmp_path / dataset, entries, dataset=dataset)
        put_subset(tmp_path / "both", entries, dataset=dataset)
        with connect(tmp_path / dataset) as connection:
            for name, rows in expected.items():
                rows += connection.sql(f"FROM {call(name)}").fetchall()
    with connect(tmp_path / "both") as connection:
        for name, rows in expected.items():
            assert connection.sql(f"FROM {call(name)}").fetchall() == rows, name
            assert {row[0] for row in rows} == set(here), name


@pytest.fixture(scope="module")
def counts(opened: LakeConnection) -> dict[str, dict[str, int]]:
    """Rows that each macro gives of subsets a and c, where it gives any."""
    counted = {
        name: {subset: opened.sql(f"FROM {call(name, repr(subset))}").count() for subset in ("a", "c")}
        for name in CALLS
    }
    return {name: {subset: rows for subset, rows in own.items() if rows} for name, own in counted.items()}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize(
    "alias",
    [
        *("subsets", "entry", "tracks"),
        *(pytest.param(name, marks=pytest.mark.thorough) for name in ("asked", "recording", "follower", "vehicle")),
    ],
)
def test_arguments_may_be_columns_whatever_their_table_is_called(opened: LakeConnection, counts, name: str, alias: str):
    """Never taken for a column of the macro's own tables, which would give every subset's rows for each."""
    for argument in (f'"{alias}".subset', "subset"):
        found = opened.sql(
            f'SELECT asked_for, count(*) FROM (SELECT subset, subset AS asked_for FROM subsets) AS "{alias}",'
            f" {call(name, argument)} AS given WHERE asked_for <> 'b' GROUP BY ALL"
        ).fetchall()
        assert dict(found) == counts[name]


def test_macros_take_named_arguments_and_parameters(several: Path):
    with connect(several) as connection:
        expected = connection.sql("FROM track('a', 1)").fetchall()
        assert connection.sql("FROM track(vehicle := 1, subset := 'a')").fetchall() == expected
        assert connection.sql("FROM track($subset, $id)", {"subset": "a", "id": 1}).fetchall() == expected
        assert connection.sql("FROM track((SELECT min(subset) FROM subsets), 1)").fetchall() == expected
        with pytest.raises(QueryError, match=r"track\(subset, vehicle\)"):
            connection.sql("FROM track('a')")
        for statement in ("CREATE OR REPLACE MACRO track(a) AS TABLE SELECT 1", "DROP MACRO TABLE track"):
            with pytest.raises(QueryError, match="read-only"):
                connection.sql(statement)


@pytest.mark.parametrize("name", CALLS)
def test_a_querys_own_tables_do_not_take_the_lakes_place(opened: LakeConnection, name: str):
    names = ("tracks", "vehicles", "subsets", "asked", "entry", "recording", "counted", "cells", "lanes", "section")
    own = ", ".join(f"{name} AS (SELECT 1 AS one)" for name in names)
    expected = opened.sql(f"FROM {call(name)}").fetchall()
    assert opened.sql(f"WITH {own} FROM {call(name)}").fetchall() == expected


def test_the_catalogs_macros_read_their_own_lake_also_beside_another(opened, several: Path, tmp_path: Path):
    put_subset(tmp_path / "other", [{**row, "x_m": row["x_m"] + 10.0} for row in PAIRS], subset="a")
    with duckdb.connect() as plain:
        for name, root in (("other", tmp_path / "other"), ("several", several)):
            plain.execute(f"ATTACH '{root / 'catalog.duckdb'}' AS {name} (READ_ONLY)")
        plain.execute("USE other")
        for name in CALLS:
            assert plain.sql(f"FROM several.{call(name)}").fetchall() == opened.sql(f"FROM {call(name)}").fetchall()
        moved = plain.sql("SELECT max(x_m) FROM track('a', 1)").fetchone()
        assert moved == plain.sql("SELECT max(x_m) + 10 FROM several.track('a', 1)").fetchone()


@pytest.mark.parametrize("macro", MACROS, ids=lambda macro: macro.name)
def test_a_macro_says_what_it_gives(opened: LakeConnection, macro):
    """Its file's header: meaning, parameters with theirs, and all columns in order."""
    header = [line.removeprefix("--").strip() for line in macro.statement.splitlines() if line.startswith("--")]
    paragraphs = [part.split("\n") for part in "\n".join(header).split("\n\n")]
    assert paragraphs[0][0] == macro.meaning
    assert tuple(line.split(":")[0] for line in paragraphs[-2]) == macro.parameters
    columns = opened.sql(f"FROM {call(macro.name)}").columns
    listed = opened.sql(
        f"SELECT parameters, comment FROM duckdb_functions() WHERE function_name = '{macro.name}' AND NOT internal"
    )
    assert listed.fetchall() == [(list(macro.parameters), macro.meaning)]
    if macro.name == "track":
        assert columns == list(TRACKS.dtypes)
    else:
        named = [name for line in paragraphs[-1] for name in line.split(":")[0].split(", ")]
        assert columns == named
