"""A DuckLake catalog shows what SQL shows, to a DuckDB that knows nothing of tracklake, and stays as it was."""

import json
from pathlib import Path

import duckdb
import pytest
from small_lake import make_vehicles, put, write_every_kind, write_round

from tracklake.pipeline.lake import LakeError, connect, load, open_for_writing
from tracklake.pipeline.lake.ducklake import publish_ducklake
from tracklake.pipeline.lake.object_access import find_extension
from tracklake.schemas import TABLES, VEHICLES

pytest.importorskip("duckdb_extension_ducklake", reason="the extra [ducklake] is not installed")


def attach(path: Path) -> duckdb.DuckDBPyConnection:
    """Open a catalog as another program does."""
    client = duckdb.connect(config={"autoinstall_known_extensions": False})
    client.execute(f"LOAD '{find_extension('ducklake', 'ducklake')}'")
    client.execute(f"ATTACH 'ducklake:{path}' AS other (READ_ONLY)")
    return client


def check_same(root: Path) -> None:
    with connect(root) as lake, attach(root / "catalog.ducklake") as other:
        for table in TABLES:
            columns = ", ".join(f'"{name}"' for name in table.dtypes)
            query = f"SELECT {columns} FROM {{}}{table.name} ORDER BY ALL"
            expected = lake.sql(query.format("")).fetchall()
            assert other.sql(query.format("other.")).fetchall() == expected, table.name
        with pytest.raises(duckdb.Error, match="read-only"):
            other.execute("DELETE FROM other.vehicles")


def test_every_table_is_as_in_sql(tmp_path: Path):
    write_every_kind(tmp_path)
    done = publish_ducklake(tmp_path)
    assert done == (tmp_path / "catalog.ducklake", 1, 4, 4)
    check_same(tmp_path)
    with attach(tmp_path / "catalog.ducklake") as other:
        query = "SELECT comment FROM duckdb_columns() WHERE table_name = 'vehicles' AND column_name = 'length_m'"
        assert other.sql(query).fetchall() == [(VEHICLES.columns["length_m"].comment,)]
        ((author, message),) = other.sql("SELECT author, commit_message FROM other.snapshots() OFFSET 1").fetchall()
    assert (author, message) == ("tracklake", f"generation 1 of lake {load(tmp_path).lake_id}")


def test_a_catalog_stays_as_it_was_until_it_is_published_again(tmp_path: Path):
    write_round(tmp_path, 1)
    publish_ducklake(tmp_path)
    write_round(tmp_path, 2)
    question = "SELECT sum(backward_vehicles) FROM other.subset_status"
    with attach(tmp_path / "catalog.ducklake") as other:
        assert other.sql(question).fetchall() == [(2,)]
    publish_ducklake(tmp_path)
    check_same(tmp_path)
    with open_for_writing(tmp_path):
        pass
    assert (tmp_path / "catalog.ducklake").exists(), "a session lets it be"


@pytest.mark.parametrize("place", ["Dataset=x", "a/subset=y/b"])
def test_a_folder_above_the_lake_that_looks_like_a_partition_is_refused(tmp_path: Path, place: str):
    root = tmp_path / place / "lake"
    write_round(root, 1)
    with pytest.raises(LakeError, match=r"lies in a folder whose name begins with .*=.*Move the lake"):
        publish_ducklake(root)


def test_names_that_are_encoded_in_paths_are_read_back(tmp_path: Path):
    values = {"dataset": "highd", "subset": "a b/ä%?*'"}
    with open_for_writing(tmp_path) as writer:
        writer.commit(put(tmp_path, "x", 1, make_vehicles(2, values["subset"]), VEHICLES, **values))
    publish_ducklake(tmp_path)
    check_same(tmp_path)


def test_a_damaged_file_is_named_and_the_earlier_catalog_stays(tmp_path: Path):
    write_round(tmp_path, 1)
    publish_ducklake(tmp_path)
    before = (tmp_path / "catalog.ducklake").read_bytes()
    (tmp_path / load(tmp_path).live("subset_status")[0].path).write_bytes(b"PAR1")
    with pytest.raises(LakeError, match="the table `subset_status` cannot be read"):
        publish_ducklake(tmp_path)
    assert (tmp_path / "catalog.ducklake").read_bytes() == before


def test_the_command_says_what_it_wrote(command, tmp_path: Path):
    write_round(tmp_path, 1)
    done = command.here("publish", "ducklake", "--lake", tmp_path)
    assert done.code == 0, done.err
    assert f"{tmp_path}/catalog.ducklake: generation 1" in done.out
    said = json.loads(command.here("publish", "ducklake", "--lake", tmp_path, "--json").out)
    assert (said["generation"], said["tables"], said["files"]) == (1, 2, 4)
    missing = command.here("publish", "ducklake", "--lake", tmp_path / "nowhere")
    assert (missing.code, "no lake here" in missing.err) == (1, True)
