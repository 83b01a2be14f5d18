"""The folders that other programs read: right after a replacement, during one, after kills, copies and moves."""

import json
import os
import shutil
import signal
import time
from contextlib import suppress
from pathlib import Path

import duckdb
import polars as pl
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from manifests import read_unsharded, write_unsharded
from small_lake import (
    SUBSETS,
    Nursery,
    check_folder,
    check_lake,
    commit_round,
    find_files,
    make_status,
    put,
    read_folder,
    write_round,
)

from tracklake.pipeline.lake import follow_move, is_settled, load, open_for_writing, scan
from tracklake.pipeline.lake.live_folders import list_names
from tracklake.schemas import SUBSET_STATUS

TABLE = "subset_status"
UPPER = f"{TABLE}/dataset=highd/subset=01-upper/part-01-upper.parquet"


def count_by_all(root: Path, table: str = TABLE) -> list[int]:
    """Rows of a table as Polars, PyArrow and DuckDB find them in its folder, by folder and by pattern."""
    folder = root / table
    found = duckdb.sql(f"SELECT count(*) FROM read_parquet('{folder}/*/*/*.parquet', hive_partitioning = true)")
    return [
        pl.scan_parquet(folder).select(pl.len()).collect().item(),
        pl.scan_parquet(folder / "**" / "*.parquet").select(pl.len()).collect().item(),
        ds.dataset(folder, partitioning="hive").count_rows(),
        found.fetchall()[0][0],
    ]


def test_every_reader_counts_what_is_live(tmp_path: Path):
    for number in (3, 4, 1, 2):
        write_round(tmp_path, number)
        assert count_by_all(tmp_path) == [2] * 4
        assert count_by_all(tmp_path, "vehicle_starts") == [2 * number] * 4
        check_folder(tmp_path)
    with open_for_writing(tmp_path) as writer:
        writer.remove({"validate/highd/01-upper"})
        assert count_by_all(tmp_path) == [1] * 4, "within the session, too"
    check_folder(tmp_path)
    write_round(tmp_path, 5)  # no vehicle starts
    assert not (tmp_path / "vehicle_starts").exists()
    check_folder(tmp_path)


def test_a_commit_is_shown_at_once_and_a_rebuild_shows_nothing_old(tmp_path: Path):
    write_round(tmp_path, 1)
    with open_for_writing(tmp_path) as writer:
        commit_round(writer, 2)
        assert read_folder(tmp_path)["backward_vehicles"].to_list() == [2, 2]
    with open_for_writing(tmp_path, rebuild=True) as writer:
        assert read_folder(tmp_path).is_empty()
        commit_round(writer, 2)
        assert read_folder(tmp_path)["backward_vehicles"].to_list() == [2, 2]
    check_folder(tmp_path)


def test_readers_that_have_a_file_open_keep_reading_it(tmp_path: Path):
    write_round(tmp_path, 1)
    by_arrow = pq.ParquetFile(tmp_path / UPPER)
    with (tmp_path / UPPER).open("rb") as stream:
        for number in (2, 3, 4, 5):
            write_round(tmp_path, number)
        assert pl.read_parquet(stream)["backward_vehicles"].to_list() == [1]
    assert by_arrow.read()["backward_vehicles"].to_pylist() == [1]
    assert pl.read_parquet(tmp_path / UPPER)["backward_vehicles"].to_list() == [5]


def read_again(root: Path) -> pl.DataFrame:
    """Read with Polars, which reads the first file's footer and then opens it again.

    It fails if the file is replaced in between, of which there are twenty chances a second here.
    """
    for _ in range(5):
        with suppress(pl.exceptions.PolarsError, pl.exceptions.PanicException):
            return read_folder(root)
    raise AssertionError("Polars was disturbed five times in a row")


def test_folders_are_right_while_files_are_replaced(tmp_path: Path):
    """One process replaces everything again and again; each reader finds each subset once, and never an older state."""
    root = tmp_path / "lake"
    write_round(root, 0)
    nursery = Nursery(root)
    child = nursery.ask("loop 1")
    try:
        newest, began, rounds = 0, time.monotonic(), 0
        while newest < 4 or rounds < 4:
            assert time.monotonic() - began < 120, f"{newest} replacements and {rounds} rounds in two minutes"
            found = [
                read_again(root).select("subset", "backward_vehicles").rows(),
                ds.dataset(root / TABLE, partitioning="hive")
                .to_table(columns=["subset", "backward_vehicles"])
                .to_pylist(),
                duckdb.sql(
                    f"SELECT subset, backward_vehicles FROM read_parquet('{root}/{TABLE}/*/*/*.parquet', "
                    "hive_partitioning = true)"
                ).fetchall(),
            ]
            for rows in ([tuple(row.values()) if isinstance(row, dict) else row for row in each] for each in found):
                assert sorted(subset for subset, _ in rows) == sorted(SUBSETS)
                assert min(number for _, number in rows) >= newest - 1  # the subsets follow one another
                newest = max(newest, *(number for _, number in rows))
            rounds += 1
    finally:
        os.kill(child, signal.SIGKILL)
        nursery.close()
    write_round(root, 1)
    check_lake(root)
    check_folder(root)


@pytest.mark.parametrize("with_times", [True, False])
def test_a_copied_or_moved_lake_is_right_and_linked_again(tmp_path: Path, with_times: bool):
    write_round(tmp_path / "lake", 1)
    copy = tmp_path / "copy"
    shutil.copytree(tmp_path / "lake", copy, copy_function=shutil.copy2 if with_times else shutil.copy)
    assert read_folder(copy)["backward_vehicles"].to_list() == [1, 1]
    assert not is_settled(copy, load(copy))  # its catalog leads to the other lake
    follow_move(copy)
    assert is_settled(copy, load(copy)) == with_times
    with open_for_writing(copy):
        pass
    check_folder(copy, linked=True)
    (tmp_path / "lake").rename(tmp_path / "moved")
    assert not is_settled(tmp_path / "moved", load(tmp_path / "moved"))
    write_round(tmp_path / "moved", 2)
    check_folder(tmp_path / "moved", linked=True)


def test_without_hard_links_there_are_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", fail)
    for number in (1, 2):
        write_round(tmp_path, number)
        check_folder(tmp_path)
    inode = (tmp_path / UPPER).stat().st_ino
    assert is_settled(tmp_path, load(tmp_path))
    with open_for_writing(tmp_path):
        pass
    assert (tmp_path / UPPER).stat().st_ino == inode, "not copied again"
    monkeypatch.undo()
    with open_for_writing(tmp_path):
        pass
    check_folder(tmp_path, linked=True)


@pytest.mark.parametrize("rebuild", [False, True])
def test_a_lake_of_the_earlier_layout_is_read_and_carried_over(tmp_path: Path, rebuild: bool):
    write_round(tmp_path, 1)
    write_round(tmp_path, 2)
    make_old(tmp_path)
    manifest = load(tmp_path)
    assert scan(tmp_path, manifest, SUBSET_STATUS).collect()["backward_vehicles"].to_list() == [2, 2]
    assert read_folder(tmp_path).height == 4, "as it was"
    assert not is_settled(tmp_path, manifest)
    with open_for_writing(tmp_path, rebuild=rebuild) as writer:
        assert read_folder(tmp_path)["backward_vehicles"].to_list() == ([] if rebuild else [2, 2])
        assert len([path for path in find_files(tmp_path) if path.startswith(f".files/{TABLE}/")]) == 4
        assert {item.path for item in writer.manifest.retired} <= find_files(tmp_path), "kept for their readers"
        checksums = [file.sha256 for file in writer.manifest.live(TABLE)]
        assert None not in checksums
        if rebuild:
            commit_round(writer, 2)
    assert is_settled(tmp_path, load(tmp_path))
    check_lake(tmp_path)
    check_folder(tmp_path, linked=True)


def make_old(root: Path) -> None:
    """Turn a lake into one whose live and replaced files lie in the folders of tables, without checksums."""
    for name in list_names(load(root).commits.values()):
        (root / name).unlink()
    for path in find_files(root):
        if path.startswith(".files/"):
            (root / path).replace(root / path.removeprefix(".files/"))
    shutil.rmtree(root / ".files")
    (root / ".session").unlink()
    document = json.loads(json.dumps(read_unsharded(root)).replace(".files/", ""))
    groups = [group for entry in document["entries"].values() for group in entry["files"].values()]
    for item in (item for group in [*groups, document["retired"]] for item in group):
        del item["sha256"]
    write_unsharded(root, document)


def test_files_of_several_recordings_in_one_folder_have_their_own_names(tmp_path: Path):
    values = {"dataset": "highd", "subset": "x"}
    with open_for_writing(tmp_path) as writer:
        for key in ("validate/highd/01", "validate/highd/a b/ä%?*", "validate"):
            writer.commit(put(tmp_path, key, 1 + len(key), make_status("x", len(key)), **values))
    names = list_names(load(tmp_path).commits.values())
    assert sorted(Path(name).name for name in names) == [
        "part-0.parquet",
        "part-01.parquet",
        "part-a b%2Fä%25%3F%2A.parquet",
    ]
    assert count_by_all(tmp_path) == [3] * 4


def test_every_file_of_a_real_lake_has_a_name_of_its_own(lake):
    manifest = load(lake.root)
    tables = [file.path for commit in manifest.commits.values() for file in commit.all_files if file.rows is not None]
    assert sorted(list_names(manifest.commits.values()).values()) == sorted(tables)
    for table in ("tracks", "findings", "ingest_log", "splits"):
        rows = sum(file.rows or 0 for file in manifest.live(table))
        assert pl.scan_parquet(lake.root / table).select(pl.len()).collect().item() == rows
