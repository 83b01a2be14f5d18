"""Tables of many files, which Polars reads for DuckDB: the same rows and types as DuckDB reads, in the catalog too."""

from collections.abc import Callable
from pathlib import Path

import duckdb
import polars as pl
import pytest
from small_lake import SUBSETS, make_starts, put, write_every_kind, write_round

from tracklake.pipeline.lake import LakeError, catalog, load, open_for_writing, open_stored, scan
from tracklake.schemas import SUBSET_STATUS, TABLES, VEHICLE_STARTS

Contents = dict[str, tuple[list[tuple[object, ...]], list[tuple[object, ...]]]]


def read_all(connection: duckdb.DuckDBPyConnection) -> Contents:
    """Return columns and rows of every table of a catalog."""
    return {
        table.name: (
            connection.execute(f'DESCRIBE "{table.name}"').fetchall(),
            connection.execute(f'FROM "{table.name}" ORDER BY ALL').fetchall(),
        )
        for table in TABLES
    }


def read_catalog(root: Path, copy: Path) -> Contents:
    copy.write_bytes(catalog.build_catalog(root, load(root)))
    with duckdb.connect(str(copy), read_only=True) as connection:
        return read_all(connection)


def read_stored(root: Path, _copy: Path) -> Contents:
    with open_stored(root, load(root), TABLES) as connection:
        return read_all(connection)


@pytest.mark.parametrize("read", [read_catalog, read_stored])
def test_both_readers_find_the_same_in_every_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[Path, Path], Contents]
):
    root = tmp_path / "lake"
    write_every_kind(root)
    write_round(root, 3)
    scanned: list[str] = []
    monkeypatch.setattr(
        catalog, "scan", lambda place, manifest, table: scanned.append(table.name) or scan(place, manifest, table)
    )
    by_duckdb = read(root, tmp_path / "one.duckdb")
    assert not scanned
    monkeypatch.setattr(catalog, "MANY_FILES", 0)
    by_polars = read(root, tmp_path / "other.duckdb")
    assert {table.name for table in TABLES if load(root).live(table.name)} <= {*scanned}
    assert by_polars == by_duckdb
    rows = [*zip(*by_duckdb["vehicles"][1], strict=True)]
    assert len(rows[0]) == 3
    assert None not in rows[-1]  # a column of a later stage


@pytest.mark.parametrize("folder", ["lake", "subset=other", "x=1 dataset=ngsim"])
def test_one_scan_finds_the_rows_of_all_partitions(tmp_path: Path, folder: str):
    root = tmp_path / folder
    names = [
        *SUBSETS,
        "it's",
        "a=b",
        "a/b",
        "..",
        "ünï 東",
        "50%",
        "%41",
        "a+b",
        "*",
        "[a]",
        "01",
        "true",
        "null",
        "a\\b",
    ]
    with open_for_writing(root) as writer:
        for number, name in enumerate(names):
            values = {"dataset": ("highd", "ngsim")[number % 2], "subset": name}
            made = make_starts(name, number + 1, values["dataset"])
            writer.commit(put(root, f"starts/{number}", number, made, VEHICLE_STARTS, **values))
    found = scan(root, load(root), VEHICLE_STARTS)
    expected = {(("highd", "ngsim")[number % 2], name): number + 1 for number, name in enumerate(names)}
    counted = found.group_by("dataset", "subset").len().collect().rows()
    assert {(dataset, subset): rows for dataset, subset, rows in counted} == expected
    assert found.collect().schema == pl.Schema(VEHICLE_STARTS.dtypes)
    assert found.filter(subset="50%").collect().height == expected["ngsim", "50%"]


@pytest.mark.parametrize("most", [catalog.MANY_FILES, 0], ids=["duckdb", "polars"])
@pytest.mark.parametrize("is_there", [True, False])
def test_a_catalog_has_views_of_damaged_files_and_none_of_missing_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, is_there: bool
):
    monkeypatch.setattr(catalog, "MANY_FILES", most)
    root, copy = tmp_path / "lake", tmp_path / "copy.duckdb"
    write_round(root, 3)
    file = root / load(root).live(SUBSET_STATUS.name)[-1].path
    file.unlink()
    if is_there:
        file.write_bytes(b"PAR1")
    message = f"`tracklake run SOURCE --lake {root}` on the raw files makes"
    with pytest.raises(LakeError, match=message):
        open_stored(root, load(root), [SUBSET_STATUS])
    if not is_there:
        with pytest.raises(LakeError, match=message):
            catalog.build_catalog(root, load(root))
        return
    copy.write_bytes(catalog.build_catalog(root, load(root)))
    asked = "SELECT table_type FROM information_schema.tables WHERE table_name = 'subset_status'"
    with duckdb.connect(str(copy), read_only=True) as connection:
        assert connection.execute(asked).fetchall() == [("VIEW",)]
