"""The lake as SQL: what its connection admits, and what its results hand on."""

import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from importlib.util import find_spec
from pathlib import Path

import polars as pl
import pyarrow as pa
import pytest
from small_lake import write_every_kind, write_round

from tracklake.pipeline.lake import QueryError, connect, query
from tracklake.pipeline.lake.lake import open_lake
from tracklake.pipeline.lake.query import LakeConnection
from tracklake.schemas import TABLES
from tracklake.schemas.errors import MissingExtraError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a lake that no test may change, and a file outside of it."""
    made = tmp_path_factory.mktemp("sandbox")
    write_every_kind(made / "lake")
    (made / "secret.csv").write_text("a\n1\n")
    return made


@pytest.fixture
def lake(folder: Path) -> Path:
    return folder / "lake"


@pytest.fixture(scope="module")
def opened(folder: Path) -> Iterator[LakeConnection]:
    """One connection for all: no statement may spoil it for the next."""
    with connect(folder / "lake") as connection:
        yield connection


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("sql", "first"),
    [
        ("SELECT count(*) FROM vehicles", 3),
        ("with v as (select * from vehicles) select max(vehicle_id) from v;", 2),
        ("FROM vehicles SELECT min(vehicle_id)", 0),
        ("-- how many\nSELECT count(*) FROM splits", 2),
        ("/* how many */ SELECT count(*) FROM splits", 2),
        ("VALUES (5)", 5),
        ("DESCRIBE vehicles", "dataset"),
        ("SUMMARIZE splits", "split"),
        ("SHOW TABLES", min(table.name for table in TABLES)),
        ("EXPLAIN SELECT * FROM vehicles", "physical_plan"),
        ("EXPLAIN (FORMAT json) SELECT * FROM vehicles", "physical_plan"),
        ("-- why\nEXPLAIN ANALYZE SELECT * FROM vehicles", "analyzed_plan"),
        ("explain analyze select 1", "analyzed_plan"),
        ("SELECT text FROM rejects", "it's"),
        # Names of switches that switch nothing: in comments, in texts, of a WITH, of columns.
        ("-- a query (x)\nSELECT /* enable_logging() */ 'disable_logging()'", "disable_logging()"),
        ('WITH query (x, "y") AS (SELECT 3, 4) SELECT y FROM query', 4),
        ('WITH a AS (SELECT 1), Query (x) -- (\n AS (SELECT 5) FROM "query"', 5),
        ('SELECT $$query(\'$$ AS "query("', "query('"),
        ("SELECT 'ü' AS enable_profiling", "ü"),
        ("PIVOT (SELECT 1 AS lane, 8 AS n) ON lane IN (1, 2) USING sum(n)", 8),
    ],
)
def test_what_reads_is_admitted(opened: LakeConnection, sql: str, first: object):
    row = query(opened, sql).fetchone()
    assert row is not None
    assert row[0] == first


@pytest.mark.parametrize(
    "sql",
    [
        "", ";", "SELECT 1; SELECT 2", "SELECT 1; COPY (SELECT 1) TO '{lake}/splits/x.csv'",
        "COPY (SELECT 1) TO '{lake}/splits/x.csv'", "COPY vehicles TO '{out}'", "EXPORT DATABASE '{out}'",
        "ATTACH '{out}' AS other", "ATTACH '{lake}/catalog.duckdb' AS other", "USE memory", "DETACH memory",
        "CREATE TABLE x (a INT)", "CREATE TEMP TABLE x AS SELECT 1", "CREATE OR REPLACE VIEW vehicles AS SELECT 1",
        "CREATE MACRO f() AS 1", "CREATE SECRET s (TYPE s3)", "DROP VIEW vehicles", "ALTER VIEW vehicles RENAME TO v",
        "INSERT INTO vehicles VALUES (1)", "WITH x AS (SELECT 1) INSERT INTO vehicles FROM x", "DELETE FROM vehicles",
        "UPDATE vehicles SET vehicle_id = 1", "TRUNCATE vehicles", "SET threads = 1", "RESET threads",
        "SET enable_external_access = true", "PRAGMA threads = 1", "PRAGMA enable_profiling", "INSTALL httpfs",
        "LOAD httpfs", "CALL pragma_version()", "CALL enable_logging()", "BEGIN", "COMMIT", "CHECKPOINT", "VACUUM",
        "ANALYZE", "PREPARE p AS SELECT 1", "EXECUTE p", "IMPORT DATABASE '{out}'", "SELECT 1 INTO x",
        "EXPLAIN ANALYZE COPY (SELECT 1) TO '{lake}/splits/x.csv'", "EXPLAIN COPY (SELECT 1) TO '{out}'",
        "EXPLAIN (ANALYZE) COPY (SELECT 1) TO '{lake}/splits/x.csv'",
        "EXPLAIN (ANALYZE, FORMAT json) CREATE TABLE x AS SELECT 1",
        "EXPLAIN /* SELECT */ ANALYZE COPY (SELECT 1) TO '{lake}/splits/x.csv'",
        "/* /* */ EXPLAIN SELECT 1 -- */ */ EXPLAIN ANALYZE COPY (SELECT 1) TO '{lake}/splits/x.csv'",
        "-- \nEXPLAIN ANALYZE CREATE TABLE x AS SELECT 1",
        "FROM enable_logging(storage = 'file', storage_path = '{lake}/splits')",
        "FROM query('FROM enable_' || 'logging()')", 'FROM "query" /* */ (\'SELECT 1\')',
        "FROM query('COPY (SELECT 1) TO ''{lake}/splits/x.csv''')", "FROM query -- (x) AS (\n('SELECT 1')",
        "FROM main.query('SELECT 1') AS materialized (x)", "WITH query (x) AS (FROM query('SELECT 1')) FROM query",
        "SELECT 'ü', * FROM query('SELECT 1')", "FROM (query('SELECT 1')) AS t",
        "FROM json_execute_serialized_sql(json_serialize_sql('FROM enable_' || 'logging()'))",
        "FROM Enable_Profiling(format = 'json', save_location = '{lake}/splits/x.json')",
        "FROM '{secret}'", "FROM read_csv('{secret}')", "FROM read_text('/etc/passwd')", "FROM '/etc/passwd'",
        "FROM read_blob('{lake}/manifest.json')", "FROM read_text('{lake}/catalog.duckdb')", "FROM glob('/etc/*')",
        "FROM glob('{lake}/*')", "FROM read_parquet('{lake}/splits/../../secret.csv')", "DESCRIBE '{secret}'",
        "SUMMARIZE '{secret}'", "FROM sniff_csv('{secret}')", "FROM parquet_metadata('{secret}')",
        "FROM read_csv('https://example.org/x.csv')", "FROM 's3://bucket/x.parquet'", "FROM lake", "SELECT ?",
    ],
)  # fmt: skip
def test_what_writes_or_looks_elsewhere_is_refused(opened: LakeConnection, lake: Path, folder: Path, sql: str):
    filled = sql.format(lake=lake, out=folder / "out", secret=folder / "secret.csv")
    before = snapshot(folder)
    # Some are refused on asking, the others when DuckDB first touches the file.
    with pytest.raises(QueryError):
        query(opened, filled).fetchall()
    assert opened.execute("SELECT count(*) FROM vehicles").fetchall() == [(3,)]
    assert opened.execute("SELECT count(*) FROM duckdb_tables()").fetchall() == [(0,)]
    assert snapshot(folder) == before


def test_a_switch_that_gets_past_us_writes_nothing(lake: Path, folder: Path):
    """The file system itself refuses; a process of its own, because DuckDB may end it."""
    before = snapshot(folder)
    script = (
        "import sys; from tracklake.pipeline.lake import connect; connection = connect(sys.argv[1]);"
        "options = f\"storage = 'file', storage_path = '{sys.argv[1]}/splits'\";"
        "raw = connection._raw;"  # past the admission of statements
        "raw.execute(f'FROM enable_logging({options})').fetchall();"
        "raw.execute('SELECT count(*) FROM vehicles').fetchall()"
    )
    done = subprocess.run([sys.executable, "-c", script, str(lake)], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "file system operations are disabled" in done.stderr
    assert snapshot(folder) == before


@pytest.mark.parametrize(
    "statement",
    [
        "COPY (SELECT 42 AS x) TO '{live}' (FORMAT parquet, USE_TMP_FILE false)",
        "CREATE TABLE mine AS SELECT 1",
        "ATTACH '{live}.db' AS other",
        "SET memory_limit = '1GB'",
        "SELECT 1; DROP VIEW tracks",
    ],
)
def test_a_connection_admits_nothing_that_writes(lake: Path, folder: Path, statement: str):
    before = snapshot(folder)
    live = next(iter(sorted(lake.rglob("*.parquet"))))
    with connect(lake) as connection:
        for run in (connection.sql, connection.execute):
            with pytest.raises(QueryError, match="read-only"):
                run(statement.format(live=live))
        assert connection.execute("SELECT $x AS y", {"x": 2}).fetchall() == [(2,)]
    assert snapshot(folder) == before


def test_a_result_reads_and_has_no_method_that_writes(lake: Path):
    with connect(lake) as connection:
        found = connection.sql("SELECT vehicle_id, class FROM vehicles ORDER BY 1")
        assert {name for name in dir(found) if not name.startswith("_")} == {
            "arrow", "columns", "count", "description", "df", "fetchall", "fetchone", "limit", "pl", "project", "show",
            "to_text", "types",
        }  # fmt: skip
        assert {name for name in dir(connection) if not name.startswith("_")} == {"close", "execute", "sql"}
        assert found.columns == [column[0] for column in found.description] == ["vehicle_id", "class"]
        assert [str(kind) for kind in found.types] == ["INTEGER", "VARCHAR"]
        assert found.pl().rows() == [(0, "car"), (1, "car"), (2, "car")]
        assert (found.count(), found.limit(2).count(), query(connection, "DESCRIBE splits").count()) == (3, 2, 9)
        assert found.limit(1, 1).fetchall() == [(1, "car")]
        assert found.project("vehicle_id + 10 AS more").fetchall() == [(10,), (11,), (12,)]
        for expressions in ("(FROM enable_logging())", "1; CREATE TABLE x (a INT)"):
            with pytest.raises(QueryError):
                found.project(expressions)
        assert (found.fetchone(), found.fetchall()) == ((0, "car"), [(1, "car"), (2, "car")])


def test_a_result_is_handed_to_other_libraries(lake: Path, capsys: pytest.CaptureFixture[str]):
    with connect(lake) as connection:
        found = connection.sql("SELECT vehicle_id, sum(entries) AS n, length_m FROM vehicles GROUP BY ALL ORDER BY 1")
        rows = [(0, 9, 4.5), (1, 9, 4.5), (2, 9, 4.5)]
        assert found.arrow().schema.types == [pa.int32(), pa.int64(), pa.float32()]
        assert found.arrow().to_pylist() == [dict(zip(found.columns, row, strict=True)) for row in rows]
        assert pl.DataFrame(found).rows() == pl.DataFrame(pa.table(found)).rows() == rows
        assert "<td>4.5</td>" in found._repr_html_()
        assert repr(found).startswith("LakeResult(vehicle_id INTEGER, n HUGEINT, length_m FLOAT)")
        found.show(2)
        assert capsys.readouterr().out.endswith("the first 2 of 3 rows\n")
        if find_spec("pandas") is None:
            with pytest.raises(MissingExtraError, match="pip install pandas"):
                found.df()
        else:
            assert [tuple(row) for row in found.df().itertuples(index=False)] == rows


def test_frames_of_ones_own_are_tables_of_that_query(lake: Path):
    mine = pl.DataFrame({"vehicle_id": [0, 2], "label": ["a", "b"]})
    asked = "SELECT label FROM vehicles JOIN mine USING (vehicle_id) ORDER BY 1"
    with connect(lake) as connection:
        first = connection.sql(asked, mine=mine)
        other = connection.sql(asked, mine=mine.with_columns(label=pl.lit("c")).to_arrow())
        # Computed only now: each with its own frame.
        assert (first.fetchall(), other.fetchall(), first.pl().rows()) == (
            [("a",), ("b",)],
            [("c",)] * 2,
            [("a",), ("b",)],
        )
        assert connection.sql(asked + " LIMIT $n", {"n": 1}, mine=mine.lazy()).fetchall() == [("a",)]
        assert connection.sql("FROM made WHERE label = 'b'", made=first).fetchall() == [("b",)]
        with pytest.raises(QueryError, match="mine"):
            connection.sql("FROM mine").fetchall()
        with pytest.raises(QueryError, match=r"parameters: expected values .* got DataFrame\. Give a frame another"):
            connection.sql("FROM parameters", mine)
        assert connection.sql("FROM statement LIMIT 1", statement=mine).fetchall() == [(0, "a")]
        with pytest.raises(QueryError, match="a frame cannot be called Tracks"):
            connection.sql("FROM tracks", Tracks=mine)
        for wrong in (5, [1], {"a": [1]}, "vehicles"):
            with pytest.raises(QueryError, match="mine: expected a table of Polars, pandas or Arrow; got "):
                connection.sql("FROM mine", mine=wrong)
        for refused in ("COPY mine TO 'x.csv'", "FROM read_text('/etc/passwd'), mine", "SET threads = 1"):
            with pytest.raises(QueryError):
                connection.sql(refused, mine=mine).fetchall()


def test_results_do_not_disturb_each_other(lake: Path):
    """DuckDB reads 2,048 rows at once; more of them show whether the rest is still there."""
    numbers = "SELECT n FROM range(9000) AS t(n) ORDER BY 1"
    with connect(lake) as connection:
        one, other = connection.sql(numbers), connection.sql(numbers)
        assert (one.fetchone(), other.fetchone(), one.fetchone()) == ((0,), (0,), (1,))
        assert (one.count(), one.pl().height, one.limit(5).pl().height) == (9000, 9000, 5)
        assert (len(one.fetchall()), len(other.fetchall())) == (8998, 8999)
        with ThreadPoolExecutor(4) as pool:
            found = pool.map(lambda _: len(connection.sql(numbers).fetchall()), range(20))
        assert list(found) == [9000] * 20


def test_a_result_outlives_the_next_commit(tmp_path: Path):
    write_round(tmp_path, 1)
    opened = open_lake(tmp_path)
    before = opened.sql("SELECT backward_vehicles FROM subset_status")
    write_round(tmp_path, 2)
    assert opened.sql("SELECT backward_vehicles FROM subset_status").fetchall() == [(2,), (2,)]
    assert before.fetchall() == [(1,), (1,)]


def test_whole_numbers_come_as_such_where_64_bits_hold_them(lake: Path):
    with connect(lake) as connection:
        found = connection.sql(
            "SELECT sum(n) AS s, 6::UHUGEINT AS u, sum(n) + 9223372036854775807 - 6 AS most, most + 1 AS more,"
            " NULL::HUGEINT AS none, sum(n::DECIMAL(9, 1)) AS exact FROM (VALUES (1), (2), (3)) AS t(n)"
        ).pl()
    wide = pl.Decimal(38, 0)
    assert found.dtypes == [pl.Int64, pl.Int64, pl.Int64, wide, pl.Int64, pl.Decimal(38, 1)]
    assert found.row(0) == (6, 6, 2**63 - 1, Decimal(2**63), None, Decimal("6.0"))


def test_a_pivot_without_values_is_told_what_works(lake: Path):
    with connect(lake) as connection, pytest.raises(QueryError, match=r"PIVOT \.\.\. ON lane IN \(1, 2, 3\)"):
        connection.sql("PIVOT (SELECT 1 AS lane, 8 AS n) ON lane USING sum(n)")


def test_python_variables_are_no_tables(lake: Path):
    hidden = pl.DataFrame({"a": [1]})
    with connect(lake) as connection, pytest.raises(QueryError, match="hidden"):
        query(connection, "SELECT * FROM hidden")
    assert hidden.height == 1


@pytest.mark.parametrize(
    ("sql", "says"),
    [
        ("SELECT * FROM track", "Did you mean"),
        ("SELECT speed FROM tracks", "speed"),
        ("SELEC 1", "syntax error"),
        ("SELECT CAST(text AS INT) FROM rejects", "Could not convert"),
    ],
)
def test_a_wrong_query_gets_duckdbs_message_and_the_tables(lake: Path, sql: str, says: str):
    with connect(lake) as connection, pytest.raises(QueryError, match=re.escape(says)) as caught:
        query(connection, sql).fetchall()
    *_, tables, macros = str(caught.value).splitlines()
    assert tables == f"Tables: {', '.join(table.name for table in TABLES)}."
    assert macros.startswith("Macros: around_ego(drive, at_s), ")
    assert " lane_changes(subset), leader_follower(subset), " in macros
