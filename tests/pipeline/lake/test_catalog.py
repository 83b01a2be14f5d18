"""The lake as SQL: the views, their types, odd folder names, and lakes that were moved."""

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path

import duckdb
import polars as pl
import pytest
from small_lake import SUBSETS, UPPER, check_lake, make_starts, make_status, put, write_every_kind, write_round

from tracklake.pipeline.lake import (
    LakeLockedError,
    Manifest,
    catalog,
    connect,
    is_settled,
    load,
    open_for_writing,
    query,
    refuse_if_busy,
    scan,
)
from tracklake.pipeline.lake.errors import DamagedFileError
from tracklake.pipeline.lake.lake import open_lake
from tracklake.schemas import SPLITS, SUBSET_STATUS, TABLES, VEHICLE_STARTS, VEHICLES
from tracklake.schemas import SUBSETS as SUBSETS_TABLE
from tracklake.schemas.errors import FileAccessError

SQL_NAMES = {
    pl.String: "VARCHAR", pl.Boolean: "BOOLEAN", pl.Int8: "TINYINT", pl.Int16: "SMALLINT", pl.Int32: "INTEGER",
    pl.Int64: "BIGINT", pl.Float32: "FLOAT", pl.Float64: "DOUBLE", pl.Enum: "VARCHAR",
    pl.Datetime: "TIMESTAMP",
}  # fmt: skip
JOINED = {
    "vehicles": {"eligible": "BOOLEAN", "starts_late": "BOOLEAN", "fully_tracked": "BOOLEAN", "early": "BOOLEAN"},
    "subsets": {"backward_vehicles": "INTEGER", "excluded": "BOOLEAN", "excluded_reason": "VARCHAR"},
}


def sql_name(dtype: pl.DataType) -> str:
    if isinstance(dtype, pl.List):
        return sql_name(dtype.inner) + "[]"
    if isinstance(dtype, pl.Struct):
        return "STRUCT(" + ", ".join(f"{field.name} {sql_name(field.dtype)}" for field in dtype.fields) + ")"
    return SQL_NAMES[dtype if isinstance(dtype, type) else type(dtype)]


def refuse_to_write(target: Path, _content: bytes) -> None:
    """As on a file system mounted read-only."""
    raise FileAccessError(f"{target}: {os.strerror(errno.EROFS)}")


def types_of(connection: duckdb.DuckDBPyConnection, view: str) -> dict[str, str]:
    return {name: kind.replace('"', "") for name, kind, *_ in connection.execute(f'DESCRIBE "{view}"').fetchall()}


@pytest.mark.parametrize(("filled", "stored"), [(False, 20_000), (True, 20_000), (True, 0)])
def test_every_table_has_the_declared_columns_and_types(tmp_path: Path, monkeypatch, filled: bool, stored: int):
    monkeypatch.setattr(catalog, "STORED_ROWS", stored)
    if filled:
        write_every_kind(tmp_path)
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
        assert said["tracks", "speed_mps"].startswith("[m/s] recorded, signed along the direction of travel ")
        assert said["vehicles", "starts_late"] == "eligible and first seen beyond the cut-off"
        assert all(said.values())


def test_the_views_join_what_later_stages_found_out(tmp_path: Path):
    write_every_kind(tmp_path)
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
        'it\'s a "Straße", 東京;50%25',
        "a[1]*?{x}",
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


@pytest.mark.parametrize("stored", [0, 1_000])
@pytest.mark.parametrize("older", [("a",), ("b",), ("a", "b"), ()])
def test_files_of_an_earlier_lake_lack_a_column_that_is_null_then(tmp_path: Path, monkeypatch, older, stored: int):
    monkeypatch.setattr(catalog, "STORED_ROWS", stored)
    parts = {key: {"dataset": "tgsim", "subset": key} for key in ("a", "b")}
    with open_for_writing(tmp_path) as writer:
        for key, values in parts.items():
            row = {
                **dict.fromkeys(VEHICLES.dtypes), **values, "vehicle_id": 1, "source_vehicle_id": 1, "automated": True,
                "first_frame": 1, "last_frame": 2, "entries": 2, "start_x_m": 0.0, "end_x_m": 1.0,
                "mean_speed_mps": 5.0,
            }  # fmt: skip
            made = pl.DataFrame([row], schema=VEHICLES.dtypes)
            facts = {} if key in older else {catalog.ADDED: ["automated"]}
            writer.commit(replace(put(tmp_path, key, 1, made, VEHICLES, **values), info=facts))
            if key in older:
                (file,) = (one for one in load(tmp_path).live("vehicles") if f"subset={key}" in one.path)
                before = pl.read_parquet(tmp_path / file.path, hive_partitioning=False, glob=False).drop("automated")
                (tmp_path / file.path).unlink()
                before.write_parquet(tmp_path / file.path)
    expected = [(key, None if key in older else True) for key in parts]
    assert (
        scan(tmp_path, load(tmp_path), VEHICLES).select("subset", "automated").sort("subset").collect().rows()
        == expected
    )
    query_text = "SELECT subset, automated FROM vehicles ORDER BY subset"
    with connect(tmp_path) as ours, duckdb.connect(str(tmp_path / "catalog.duckdb"), read_only=True) as plain:
        assert ours.execute(query_text).fetchall() == plain.execute(query_text).fetchall() == expected


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


def test_no_session_begins_while_a_moved_lake_gets_its_catalog(tmp_path: Path, monkeypatch):
    """Its end would be recorded for a manifest whose catalog is not made yet."""
    write_round(tmp_path / "before", 2)
    moved = (tmp_path / "before").rename(tmp_path / "moved")
    rebuild, seen = catalog.rebuild_catalog, []

    def try_to_write(root: Path, manifest: Manifest) -> None:
        with pytest.raises(LakeLockedError):
            refuse_if_busy(root)
        seen.append(root)
        rebuild(root, manifest)

    monkeypatch.setattr(catalog, "rebuild_catalog", try_to_write)
    open_lake(moved)
    assert seen == [moved]
    assert is_settled(moved, load(moved))
