"""`tracklake check`, and a session's end that is done again: damage is found, named and mended."""

import json
import os
import shutil
from pathlib import Path

import duckdb
import pytest
from small_recordings import copy_lake, write_highd

from tracklake.pipeline.lake import DamagedFileError, is_settled, load, open_for_writing
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.registry import STAGE_BY_NAME

pytestmark = pytest.mark.usefixtures("plain_flows", "empty_charts")


def flip(path: Path, place: int = 100) -> None:
    """Flip the bits of one byte, as a bad disk does: neither the size nor the times change."""
    status = path.stat()
    with path.open("r+b") as stream:
        stream.seek(place)
        byte = stream.read(1)
        stream.seek(place)
        stream.write(bytes([byte[0] ^ 0xFF]))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def find_live(root: Path, table: str) -> Path:
    return root / load(root).live(table)[0].path


@pytest.fixture(scope="module")
def ingested(command, plain_flows, tmp_path_factory) -> Path:
    """A folder with raw/ of two recordings, and a lake into which they were ingested."""
    del plain_flows
    folder = tmp_path_factory.mktemp("ingested")
    for recording in ("01", "02"):
        write_highd(folder / "raw", recording)
    assert command.here("ingest", folder / "raw", "--lake", folder / "my lake", "--quiet").code == 0
    return folder


@pytest.fixture
def small(ingested, tmp_path) -> tuple[Path, Path]:
    """Source and lake, of one's own; the lake remembers the files where this test has them."""
    return copy_lake(ingested, tmp_path, "my lake")


def test_flipped_bits_are_found_and_made_again(command, small):
    raw, root = small
    whole = command.here("check", "--lake", root)
    assert whole.code == 0
    assert "all as they were written" in whole.out
    target = find_live(root, "tracks")
    before = target.read_bytes()
    flip(target)
    assert "nothing to do" in command.here("ingest", raw, "--lake", root).out, (
        "sizes and times are all that it compares"
    )
    found = command.here("check", "--lake", root)
    assert found.code == 1
    assert f"damaged: {target}: its bytes are not those that were written" in found.err
    assert f"`tracklake run {raw} --lake '{root}'`" in found.err
    assert json.loads(command.here("check", "--lake", root, "--json").out)["damaged"][0]["path"] == str(
        target.relative_to(root)
    )
    again = command.here("ingest", raw, "--lake", root, "--json")
    assert json.loads(again.out)["built"] == {"ingest": 1}, "only the damaged recording"
    assert target.read_bytes() == before
    assert command.here("check", "--lake", root).code == 0
    assert "nothing to do" in command.here("ingest", raw, "--lake", root).out


@pytest.mark.parametrize("damage", [lambda path: path.write_bytes(b"x" * path.stat().st_size), Path.unlink])
def test_other_content_of_the_same_size_and_missing_files_are_found(command, small, damage):
    raw, root = small
    target = find_live(root, "vehicles")
    before = target.read_bytes()
    damage(target)
    found = command.here("check", "--lake", root, "--json")
    assert found.code == 1
    (said,) = json.loads(found.out)["damaged"]
    assert said["key"] == "ingest/highd/01"
    assert command.here("ingest", raw, "--lake", root, "--quiet").code == 0
    assert target.read_bytes() == before
    assert command.here("check", "--lake", root).code == 0


def test_a_stage_refuses_what_it_would_read_damaged(small):
    _, root = small
    target = find_live(root, "tracks")
    flip(target, place=target.stat().st_size // 2)
    settings = Settings(lake=root)
    with open_for_writing(root) as writer:
        jobs, _ = Planner(root, writer.manifest, settings).find_outstanding("validate")
        first, second = jobs
        with pytest.raises(DamagedFileError, match=r"tracks.*damaged.*tracklake check"):
            build_job(STAGE_BY_NAME["validate"], root, first, settings)
        assert build_job(STAGE_BY_NAME["validate"], root, second, settings).files["vehicle_scores"]


def test_a_run_that_meets_damage_makes_it_again_and_goes_on(command, small):
    raw, root = small
    before = find_live(root, "tracks").read_bytes()
    flip(find_live(root, "tracks"))
    done = command.here("run", raw, "--lake", root, "--json")
    assert done.code == 0, done.err
    said = json.loads(done.out)
    assert (said["built"]["ingest"], said["built"]["validate"]) == (1, 2)
    assert any("damaged" in note for note in said["notes"])
    assert find_live(root, "tracks").read_bytes() == before
    assert command.here("check", "--lake", root).code == 0
    # A stage of its own has no raw files to make them of.
    flip(find_live(root, "tracks"))
    failed = command.here("validate", "--lake", root, TRACKLAKE_THRESHOLDS='{"high_acceleration_mps2": 2.5}')
    assert failed.code == 1
    assert "damaged" in failed.err
    assert "tracklake run SOURCE" in failed.err


@pytest.mark.parametrize("state", ["deleted", "garbage", "staging"])
def test_nothing_to_do_is_said_only_where_all_agrees(command, small, state):
    raw, root = small
    if state == "staging":
        (root / ".staging").mkdir()
        (root / ".writer").write_text("process 1")
        shutil.rmtree(root / "tracks")
    else:
        (root / "catalog.duckdb").unlink()
        if state == "garbage":
            (root / "catalog.duckdb").write_bytes(b"x" * 5000)
    again = command.here("ingest", raw, "--lake", root)
    assert again.code == 0
    assert "nothing to do" not in again.out
    assert "catalog and folders do not agree with the manifest" in again.out
    assert is_settled(root, load(root))
    assert "nothing to do" in command.here("ingest", raw, "--lake", root).out
    with duckdb.connect(str(root / "catalog.duckdb"), read_only=True) as plain:
        assert ("tracks",) in plain.execute("SHOW TABLES").fetchall()
    assert any((root / "tracks").rglob("*.parquet"))


def test_check_reads_a_lake_that_another_process_writes(command, small):
    _, root = small
    flip(find_live(root, "tracks"))
    with open_for_writing(root):
        done = command.here("check", "--lake", root)
    assert done.code == 1
    assert "note: " in done.err
    assert "is writing to this lake" in done.err
    assert "catalog and folders did not agree with the manifest, and were left so" in done.out
    assert "its bytes are not those that were written" in done.err
    last = root / load(root).live("vehicles")[-1].path  # not the first, whose columns are looked at on opening
    last.write_bytes(b"x" * last.stat().st_size)
    asked = command.here("sql", "FROM vehicles", "--lake", root)
    assert (asked.code, "`tracklake check`" in asked.err, "Macros:" in asked.err) == (1, True, False), asked.err


def test_a_damaged_copy_in_a_folder_is_found_and_linked_again(command, small):
    """Copying a lake makes copies of its links, with their times."""
    _, root = small
    copied = root.with_name("copied")
    shutil.copytree(root, copied)
    shown = next((copied / "tracks").rglob("*.parquet"))
    before = shown.read_bytes()
    with open_for_writing(copied):
        shown.unlink()  # a copy in the place of a link
        shown.write_bytes(before)
        flip(shown)
        left = command.here("check", "--lake", copied)
    assert (left.code, "1 copies are damaged" in left.err) == (1, True), left.err
    shown.unlink(missing_ok=True)
    shown.write_bytes(before)
    flip(shown)
    done = command.here("check", "--lake", copied)
    assert done.code == 0
    assert f"damaged: {shown}: not the bytes of the live file" in done.err
    assert "are up to date again" in done.out
    assert shown.read_bytes() == before
    assert command.here("check", "--lake", copied).err == ""


def test_check_mends_a_session_that_was_broken_off(command, small):
    _, root = small
    (root / "catalog.duckdb").unlink()
    done = command.here("check", "--lake", root)
    assert done.code == 0
    assert "are up to date again" in done.out
    assert is_settled(root, load(root))
