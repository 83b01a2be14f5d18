"""The lake as SQL: the views, their types, odd folder names, moved lakes, and what the sandbox admits."""

import errno
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from decimal import Decimal
from importlib.util import find_spec
from pathlib import Path

import duckdb
import polars as pl
import pyarrow as pa
import pytest
from small_lake import SUBSETS, check_lake, make_splits, make_starts, make_status, put, write_round

from tracklake.pipeline.lake import (
    QueryError,
    catalog,
    connect,
    is_settled,
    load,
    open_for_writing,
    query,
    query_errors,
    scan,
)
from tracklake.pipeline.lake.errors import DamagedFileError
from tracklake.pipeline.lake.lake import open_lake
from tracklake.pipeline.lake.query import LakeConnection
from tracklake.schemas import REJECTS, SPLITS, SUBSET_STATUS, TABLES, VEHICLE_STARTS, VEHICLES
from tracklake.schemas import SUBSETS as SUBSETS_TABLE
from tracklake.schemas.errors import FileAccessError, MissingExtraError

SQL_NAMES = {
    pl.String: "VARCHAR", pl.Boolean: "BOOLEAN", pl.Int8: "TINYINT", pl.Int16: "SMALLINT", pl.Int32: "INTEGER",
    pl.Int64: "BIGINT", pl.Float32: "FLOAT", pl.Float64: "DOUBLE", pl.Enum: "VARCHAR",
}  # fmt: skip
JOINED = {
    "vehicles": {"eligible": "BOOLEAN", "starts_late": "BOOLEAN", "fully_tracked": "BOOLEAN", "early": "BOOLEAN"},
    "subsets": {"backward_vehicles": "INTEGER", "excluded": "BOOLEAN", "excluded_reason": "VARCHAR"},
}
UPPER = {"dataset": "highd", "subset": "01-upper"}


def sql_name(dtype: pl.DataType) -> str:
    if isinstance(dtype, pl.List):
        return sql_name(dtype.inner) + "[]"
    if isinstance(dtype, pl.Struct):
        return "STRUCT(" + ", ".join(f"{field.name} {sql_name(field.dtype)}" for field in dtype.fields) + ")"
    return SQL_NAMES[dtype if isinstance(dtype, type) else type(dtype)]


def make_vehicles(rows: int, subset: str = "01-upper") -> pl.DataFrame:
    facts = {
        "dataset": "highd", "subset": subset, "class": "car", "length_m": 4.5, "width_m": 2.0, "first_frame": 1,
        "last_frame": 9, "entries": 9, "entries_announced": None, "start_x_m": 0.0, "end_x_m": 9.0, "start_lane": 1,
        "mean_speed_mps": 3.0, "lane_changes": 0,
    }  # fmt: skip
    found = [{**facts, "vehicle_id": i, "source_vehicle_id": i} for i in range(rows)]
    return pl.DataFrame(found, schema=VEHICLES.dtypes)


def make_subset(subset: str = "01-upper") -> pl.DataFrame:
    facts = {
        "dataset": "highd", "subset": subset, "recording": "01", "site": "1", "origin": "recorded",
        "direction": "upper", "freeway": True, "frame_rate_hz": 25.0, "lanes": 2, "seconds": 9.0, "first_frame": 1,
        "last_frame": 9, "vehicles": 3, "entries": 27, "flow_vphpl": None, "vehicles_per_lane_s": None, "ids_split": 0,
        "on_ramp_lanes": [], "lane_markings_m": [0.0, 3.75],
        "columns_missing": ["lane"], "source_files": [{"file": "a.csv", "sha256": "00"}],
    }  # fmt: skip
    return pl.DataFrame([facts], schema=SUBSETS_TABLE.dtypes)


def make_rejects(text: str) -> pl.DataFrame:
    row = {"dataset": "highd", "recording": None, "file": "a", "line": 1, "reason": "short", "text": text}
    return pl.DataFrame([row], schema=REJECTS.dtypes)


def build(root: Path) -> None:
    """Every kind of partition, list and struct columns, two stages beside what they judge."""
    with open_for_writing(root) as writer:
        writer.commit(put(root, "a", 1, make_vehicles(3), VEHICLES, **UPPER))
        writer.commit(put(root, "b", 1, make_subset(), SUBSETS_TABLE, **UPPER))
        writer.commit(put(root, "c", 1, make_rejects("it's"), REJECTS, dataset="highd"))
        writer.commit(put(root, "d", 1, make_splits(2), SPLITS))


def refuse_to_write(target: Path, _content: bytes) -> None:
    """As on a file system mounted read-only."""
    raise FileAccessError(f"{target}: {os.strerror(errno.EROFS)}")


def types_of(connection: duckdb.DuckDBPyConnection, view: str) -> dict[str, str]:
    return {name: kind.replace('"', "") for name, kind, *_ in connection.execute(f'DESCRIBE "{view}"').fetchall()}


@pytest.mark.parametrize(("filled", "stored"), [(False, 20_000), (True, 20_000), (True, 0)])
def test_every_table_has_the_declared_columns_and_types(tmp_path: Path, monkeypatch, filled: bool, stored: int):
    monkeypatch.setattr(catalog, "STORED_ROWS", stored)
    if filled:
        build(tmp_path)
    else:
        with open_for_writing(tmp_path):
            pass
    with connect(tmp_path) as ours, duckdb.connect(str(tmp_path / "catalog.duckdb"), read_only=True) as plain:
        for connection in (ours, plain):
            names = {name for (name,) in connection.execute("SHOW TABLES").fetchall()}
            assert names == {table.name for table in TABLES}
            for table in TABLES:
                declared = {name: sql_name(dtype) for name, dtype in table.dtypes.items()}
                found = types_of(connection, table.name)
                assert list(found.items()) == list((declared | JOINED.get(table.name, {})).items()), table.name
        views = plain.execute("SELECT view_name FROM duckdb_views() WHERE NOT internal").fetchall()
        assert {name for (name,) in views} == {
            t.name for t in TABLES if sum(file.rows for file in load(tmp_path).live(t.name)) > stored
        }
        comments = plain.execute("SELECT table_name, column_name, comment FROM duckdb_columns() WHERE NOT internal")
        said = {(table, column): comment for table, column, comment in comments.fetchall()}
        assert said["tracks", "speed_mps"].startswith("[m/s] recorded, signed along the direction of travel: ")
        assert said["vehicles", "starts_late"] == "eligible and first seen beyond the cut-off"
        assert all(said.values())


def test_the_views_join_what_later_stages_found_out(tmp_path: Path):
    build(tmp_path)
    with connect(tmp_path) as connection:
        assert connection.execute("SELECT DISTINCT starts_late FROM vehicles").fetchall() == [(None,)]
        assert connection.execute("SELECT excluded, lane_markings_m FROM subsets").fetchall() == [(None, [0.0, 3.75])]
    with open_for_writing(tmp_path) as writer:
        writer.commit(put(tmp_path, "e", 1, make_starts("01-upper", 2), VEHICLE_STARTS, **UPPER))
        writer.commit(put(tmp_path, "f", 1, make_status("01-upper", 3), SUBSET_STATUS, **UPPER))
        # The same ids in another subset and in another dataset are other vehicles.
        for key, values in (
            ("g", {"dataset": "highd", "subset": "01-lower"}),
            ("h", {"dataset": "ngsim", "subset": "01-upper"}),
        ):
            others = make_starts(values["subset"], 3, values["dataset"]).with_columns(starts_late=False)
            writer.commit(put(tmp_path, key, 1, others, VEHICLE_STARTS, **values))
    with connect(tmp_path) as connection:
        found = connection.execute("SELECT vehicle_id, starts_late FROM vehicles ORDER BY 1").fetchall()
        assert found == [(0, True), (1, True), (2, None)]
        found = connection.execute("SELECT backward_vehicles, excluded, excluded_reason FROM subsets").fetchall()
        assert found == [(3, True, "round 3")]


@pytest.mark.parametrize(
    "name",
    [
        'it\'s a "lake"',
        "Straße 東京",
        "a,b;c",
        "a[1]*?{x}",
        "50%25",
        "exp=1 dataset=ngsim",
        "subset=other",
    ],
)
def test_a_lake_may_be_called_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str):
    root = tmp_path / name / "lake"
    write_round(root, 1)
    write_round(root, 2)
    check_lake(root)
    with connect(root) as connection:
        asked = "SELECT dataset, subset, backward_vehicles FROM subset_status ORDER BY 2"
        rows = [("highd", "01-lower", 2), ("highd", "01-upper", 2)]
        assert query(connection, asked).fetchall() == rows
        monkeypatch.setattr(catalog, "STORED_ROWS", 0)
        write_round(root, 2)
        monkeypatch.chdir(root)  # for DuckDB, "?" ends a database's path
        with duckdb.connect("catalog.duckdb", read_only=True) as plain:
            assert plain.execute(asked).fetchall() == rows
    frame = scan(root, load(root), SUBSET_STATUS).sort("subset").collect()
    assert frame.select("dataset", "subset", "backward_vehicles").rows() == rows
    assert frame.schema == pl.Schema(SUBSET_STATUS.dtypes)


@pytest.mark.parametrize("subset", ["it's", "a=b", "a/b", "..", "ünï 東", "50%", "a+b", "*", "[a]", "01", "a\\b"])
def test_a_subset_may_be_called_anything(tmp_path: Path, subset: str):
    values = {"dataset": "highd", "subset": subset}
    with open_for_writing(tmp_path) as writer:
        writer.commit(put(tmp_path, "a", 1, make_status(subset, 4), **values))
        writer.commit(put(tmp_path, "b", 1, make_status("01-upper", 5), **UPPER))
    manifest = load(tmp_path)
    found = scan(tmp_path, manifest, SUBSET_STATUS, subset=subset).collect()
    assert found.rows() == make_status(subset, 4).rows()
    with connect(tmp_path) as connection:
        asked = connection.execute("SELECT backward_vehicles FROM subset_status WHERE subset = ?", [subset])
        assert asked.fetchall() == [(4,)]
    files = manifest.live("subset_status")
    assert all(len(Path(file.path).parts) == 5 for file in files)
    assert tmp_path.resolve() in (tmp_path / files[0].path).resolve().parents


def test_scan_reads_only_what_is_asked_for(tmp_path: Path):
    write_round(tmp_path, 3)
    manifest = load(tmp_path)
    every = scan(tmp_path, manifest, VEHICLE_STARTS).collect()
    assert every.group_by("subset").len().sort("subset").rows() == [(subset, 3) for subset in sorted(SUBSETS)]
    assert every.schema == pl.Schema(VEHICLE_STARTS.dtypes)
    shutil.rmtree(tmp_path / ".files" / "vehicle_starts" / "dataset=highd" / "subset=01-lower")
    assert scan(tmp_path, manifest, VEHICLE_STARTS, **UPPER).collect().height == 3
    with pytest.raises(DamagedFileError, match=r"01-lower.*a live file of the lake is missing; `tracklake run"):
        scan(tmp_path, manifest, VEHICLE_STARTS)
    nothing = scan(tmp_path, manifest, VEHICLE_STARTS, dataset="ngsim").collect()
    assert (nothing.height, nothing.schema) == (0, every.schema)
    assert scan(tmp_path, manifest, SUBSETS_TABLE).collect().equals(SUBSETS_TABLE.empty())
    for table, values in ((SPLITS, {"dataset": "highd"}), (VEHICLE_STARTS, {"vehicle_id": "3"})):
        with pytest.raises(ValueError, match="has no partition"):
            scan(tmp_path, manifest, table, **values)


def test_a_moved_lake_works_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_round(tmp_path / "before", 2)
    (tmp_path / "far").mkdir()
    shutil.move(tmp_path / "before", tmp_path / "far" / "after")
    check_lake(tmp_path / "far" / "after")
    monkeypatch.chdir(tmp_path / "far")
    with connect("after") as connection:  # relative, and still right after another change of folder
        monkeypatch.chdir(tmp_path)
        assert connection.execute("SELECT count(*) FROM subset_status").fetchall() == [(2,)]
    monkeypatch.chdir(tmp_path / "far" / "after")
    write_round(Path(), 3)
    check_lake(Path())


def read_catalog(root: Path) -> list[tuple[object, ...]]:
    with duckdb.connect(str(root / "catalog.duckdb"), read_only=True) as plain:
        return plain.execute("SELECT subset, backward_vehicles FROM subset_status ORDER BY 1").fetchall()


def test_the_catalog_of_a_moved_or_copied_lake_is_made_again_by_whoever_opens_it(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(catalog, "STORED_ROWS", 0)
    before, moved, copy = (tmp_path / name for name in ("before", "moved", "copy"))
    write_round(before, 2)
    expected = read_catalog(before)
    shutil.copytree(before, copy)
    before.rename(moved)
    for root in (moved, copy):
        with pytest.raises(duckdb.Error, match="before"):
            read_catalog(root)
        with monkeypatch.context() as patched:  # a lake that cannot be written to is read all the same
            patched.setattr(catalog, "write_file", refuse_to_write)
            assert open_lake(root).sql("SELECT count(*) FROM subset_status").fetchall() == [(2,)]
        open_lake(root)
        assert read_catalog(root) == expected
        assert is_settled(root, load(root))
        made = (root / "catalog.duckdb").stat().st_mtime_ns
        open_lake(root)
        assert (root / "catalog.duckdb").stat().st_mtime_ns == made


# ------------------------------------------------------------------------------------------- the sandbox


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a lake that no test may change, and a file outside of it."""
    made = tmp_path_factory.mktemp("sandbox")
    build(made / "lake")
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
    with pytest.raises(QueryError), query_errors():
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
        with pytest.raises(QueryError, match="a frame cannot be called Tracks"):
            connection.sql("FROM tracks", Tracks=mine)
        for wrong in (5, [1], {"a": [1]}, "vehicles"):
            with pytest.raises(QueryError, match="mine: expected a table of Polars, pandas or Arrow; got "):
                connection.sql("FROM mine", mine=wrong)
        for refused in ("COPY mine TO 'x.csv'", "FROM read_text('/etc/passwd'), mine", "SET threads = 1"):
            with pytest.raises(QueryError), query_errors():
                connection.sql(refused, mine=mine).fetchall()


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
    with connect(lake) as connection, pytest.raises(QueryError, match=re.escape(says)) as caught, query_errors():
        query(connection, sql).fetchall()
    *_, tables, macros = str(caught.value).splitlines()
    assert tables == f"Tables: {', '.join(table.name for table in TABLES)}."
    assert macros.startswith("Macros: flow_density(subset, seconds), lane_changes(subset), leader_follower(subset), ")
