"""Generations, sweeping, the lock, foreign folders, and manifests that are none."""

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import duckdb
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_lake import check_lake, commit_round, find_files, make_status, put, put_round, write_round

from tracklake.pipeline.lake import (
    Commit,
    LakeError,
    LakeFile,
    LakeLockedError,
    LakeMissingError,
    LakeVersionError,
    connect,
    is_intact,
    load,
    open_for_writing,
    scan,
    write_folder,
)
from tracklake.schemas import SCHEMA_VERSION, SUBSET_STATUS
from tracklake.schemas.errors import FileAccessError

UPPER = {"dataset": "highd", "subset": "01-upper"}
KEY = "validate/highd/01-upper"
HOLD = (
    "import os, sys, time\n"
    "from pathlib import Path\n"
    "from tracklake.pipeline.lake import open_for_writing\n"
    "with open_for_writing(Path(sys.argv[1])):\n"
    "    child = os.fork() if sys.argv[2] == 'fork' else 0\n"
    "    if child == 0 and sys.argv[2] == 'fork':\n"
    "        time.sleep(60)\n"
    "        os._exit(0)\n"
    "    if sys.argv[2] == 'spawn':\n"
    "        import subprocess\n"
    "        child = subprocess.Popen(['sleep', '60'], close_fds=False).pid\n"
    "    print(child, flush=True)\n"
    "    time.sleep(60)\n"
)


def status_path(number: int) -> str:
    return f".files/subset_status/dataset=highd/subset=01-upper/part-{number:016x}.parquet"


def commit_status(root: Path, number: int | None) -> None:
    """A session that replaces one table, or (None) changes nothing."""
    with open_for_writing(root) as writer:
        if number is not None:
            writer.commit(put(root, KEY, number, make_status("01-upper", number), **UPPER))


def test_a_replaced_file_is_deleted_two_generations_later_however_many_idle_sessions_pass(tmp_path: Path):
    commit_status(tmp_path, 0)
    commit_status(tmp_path, 1)  # replaces 0
    for _ in range(4):
        commit_status(tmp_path, None)
    assert (tmp_path / status_path(0)).exists()
    commit_status(tmp_path, 2)  # one generation later
    for _ in range(4):
        commit_status(tmp_path, None)
    assert (tmp_path / status_path(0)).exists()
    commit_status(tmp_path, 3)
    assert find_files(tmp_path) == {status_path(1), status_path(2), status_path(3)}
    assert load(tmp_path).generation == 4


def test_committing_the_same_again_is_no_generation(tmp_path: Path):
    commit_status(tmp_path, 0)
    commit_status(tmp_path, 0)
    assert load(tmp_path).generation == 1


def test_a_file_that_is_live_again_is_not_deleted(tmp_path: Path):
    for number in (0, 1, 0, 1, 0, 0, 2, 0, 3):
        commit_status(tmp_path, number)
        assert (tmp_path / status_path(number)).exists()
        check_files(tmp_path)


def check_files(root: Path) -> None:
    manifest = load(root)
    assert is_intact(root, (f for entry in manifest.commits.values() for group in entry.files.values() for f in group))
    retired = {item.path for item in manifest.retired}
    assert find_files(root) == manifest.live_paths() | retired
    assert not retired & manifest.live_paths()


@settings(max_examples=12, deadline=None)
@given(st.lists(st.lists(st.tuples(st.sampled_from(["a", "b"]), st.integers(0, 3)), max_size=3), max_size=6))
def test_any_sequence_of_sessions_keeps_exactly_what_is_live_or_lately_replaced(tmp_path_factory, sessions):
    root = tmp_path_factory.mktemp("lake") / "lake"
    contents: dict[str, int] = {}
    replaced: dict[str, int] = {}  # path -> generation, kept by hand
    generation = 0
    for session in sessions:
        changed = False
        with open_for_writing(root) as writer:
            for subset, number in session:
                values = {"dataset": "highd", "subset": subset}
                writer.commit(put(root, subset, number, make_status(subset, number), **values))
                if contents.get(subset) != number:
                    generation, changed = generation + (not changed), True
                    path = f".files/subset_status/dataset=highd/subset={subset}/part-"
                    if subset in contents:
                        replaced[f"{path}{contents[subset]:016x}.parquet"] = generation
                    replaced.pop(f"{path}{number:016x}.parquet", None)
                    contents[subset] = number
        replaced = {path: since for path, since in replaced.items() if since > generation - 2}
        live = {f".files/subset_status/dataset=highd/subset={s}/part-{n:016x}.parquet" for s, n in contents.items()}
        assert find_files(root) == live | replaced.keys()
        assert load(root).generation == generation
        found = scan(root, load(root), SUBSET_STATUS).collect()
        assert dict(found.select("subset", "backward_vehicles").iter_rows()) == contents


def test_readers_keep_working_through_the_next_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_round(tmp_path, 1)
    monkeypatch.chdir(tmp_path)
    ours, plain = connect(tmp_path), duckdb.connect("catalog.duckdb", read_only=True)
    question = "SELECT sum(backward_vehicles), (SELECT count(*) FROM vehicle_starts) FROM subset_status"
    for number in (2, 3):  # the replacement, and one later session
        write_round(tmp_path, number)
        for reader in (ours, plain):
            assert reader.execute(question).fetchall() == [(2, 2)]
    ours.close()
    plain.close()


def test_what_a_client_wrote_to_the_old_catalog_does_not_reach_the_new_one(tmp_path: Path):
    write_round(tmp_path, 1)
    write = f"d = duckdb.connect({str(tmp_path / 'catalog.duckdb')!r}); d.execute('CREATE TABLE mine (a INT)')"
    subprocess.run([sys.executable, "-c", f"import duckdb, os; {write}; os._exit(0)"], check=True)
    assert (tmp_path / "catalog.duckdb.wal").exists()
    write_round(tmp_path, 2)
    with duckdb.connect(str(tmp_path / "catalog.duckdb"), read_only=True) as client:
        assert ("mine",) not in client.execute("SHOW TABLES").fetchall()


def test_two_threads_commit_at_once(tmp_path: Path):
    def work(writer, subset):
        for number in range(5):
            writer.commit(put_round(tmp_path, subset, number))

    with open_for_writing(tmp_path) as writer:
        workers = [threading.Thread(target=work, args=(writer, f"{i:02}-upper")) for i in range(2)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    check_lake(tmp_path)
    assert {key: entry.info for key, entry in load(tmp_path).commits.items()} == {
        "validate/highd/00-upper": {"number": 4},
        "validate/highd/01-upper": {"number": 4},
    }


def test_leftovers_of_others_are_swept_and_hidden_files_of_users_are_not(tmp_path: Path):
    write_round(tmp_path, 1)
    (tmp_path / "reports").mkdir()
    left = [
        tmp_path / f".manifest.json.{'a' * 32}.tmp",
        tmp_path / f".catalog.duckdb.{'b' * 32}.tmp.wal",
        tmp_path / "reports" / f".index.html.{'c' * 32}.tmp",
        tmp_path / ".staging" / "spilled.tmp",
        tmp_path / status_path(77),
        tmp_path / "tensors" / "01-upper" / "orphan" / "x.bin",
    ]
    kept = [tmp_path / ".notes.tmp", tmp_path / ".hidden", tmp_path / "models" / "run" / "weights.bin"]
    for path in (*left, *kept):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
    (tmp_path / "tracks" / "dataset=highd").mkdir(parents=True)
    with open_for_writing(tmp_path):
        pass
    assert [path for path in left if path.exists()] == []
    assert [path for path in kept if not path.exists()] == []
    assert not (tmp_path / "tracks").exists() or not any((tmp_path / "tracks").iterdir())
    check_lake(tmp_path)


def test_a_session_that_raises_keeps_its_commits_and_lets_go_of_the_lock(tmp_path: Path):
    def fail() -> None:
        with open_for_writing(tmp_path) as writer:
            commit_round(writer, 1)
            put_round(tmp_path, "02-upper", 9)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    check_lake(tmp_path)
    assert load(tmp_path).commits.keys() == {KEY, "validate/highd/01-lower"}
    commit_status(tmp_path, None)
    check_files(tmp_path)


def test_files_that_vanished_are_not_committed(tmp_path: Path):
    with open_for_writing(tmp_path) as writer:
        entry = put(tmp_path, KEY, 1, make_status("01-upper", 1), **UPPER)
        (tmp_path / status_path(1)).unlink()
        with pytest.raises(LakeError, match="vanished"):
            writer.commit(entry)
        with pytest.raises(LakeError, match="vanished"):
            writer.commit(Commit("x", "1", {"t": [LakeFile("manifest.json/inside", 1, 1)]}))


def test_a_damaged_file_is_made_again_under_its_name(tmp_path: Path):
    commit_status(tmp_path, 1)
    target = tmp_path / status_path(1)
    whole = target.read_bytes()
    target.write_bytes(whole[:-20])
    with pytest.raises(LakeError, match=r"(?s)subset_status.*tracklake run SOURCE"), connect(tmp_path):
        pass
    with pytest.raises(LakeError, match="subset_status"):
        commit_status(tmp_path, None)  # no catalog can be made of it
    commit_status(tmp_path, 1)
    assert target.read_bytes() == whole
    check_files(tmp_path)
    with connect(tmp_path) as connection:
        assert connection.execute("SELECT backward_vehicles FROM subset_status").fetchall() == [(1,)]


@pytest.mark.parametrize("damage", ["inner/y.bin", "files.json", "x.bin"])
def test_a_folder_that_was_left_half_deleted_is_made_again(tmp_path: Path, damage: str):
    first = put_round(tmp_path, "01-upper", 1)
    (tmp_path / "tensors" / "01-upper" / f"{1:016x}" / damage).unlink()
    assert put_round(tmp_path, "01-upper", 1) == first
    assert is_intact(tmp_path, first.files["tensors"])


def test_a_whole_folder_is_kept_with_what_a_user_laid_into_it_unlisted(tmp_path: Path):
    calls = []
    write_folder(tmp_path, "tensors/a/1", lambda folder: calls.append((folder / "x").write_bytes(b"x")))
    again = write_folder(tmp_path, "tensors/a/1", lambda folder: calls.append((folder / "x").write_bytes(b"x")))
    assert len(calls) == 1
    assert [file.path for file in again] == ["tensors/a/1/files.json", "tensors/a/1/x"]


# ------------------------------------------------------------------------------------------------ the lock


@pytest.mark.parametrize("family", ["alone", "fork", "spawn"])
def test_the_second_writer_is_told_the_first_one_and_gets_the_lock_with_its_death(tmp_path: Path, family: str):
    root = tmp_path / "lake"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(root), family], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    child = int(holder.stdout.readline())
    try:
        began = time.perf_counter()
        with pytest.raises(LakeLockedError, match=rf"process {holder.pid} is writing"), open_for_writing(root):
            pass
        with connect(root) as connection:  # readers do not wait
            assert connection.execute("SELECT count(*) FROM tracks").fetchall() == [(0,)]
        assert time.perf_counter() - began < 2
        holder.kill()
        holder.wait()
        with open_for_writing(root) as writer:
            assert writer.manifest.commits == {}
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
        if child:
            os.kill(child, 9)


def test_one_process_cannot_write_twice_either(tmp_path: Path):
    with (
        open_for_writing(tmp_path),
        pytest.raises(LakeLockedError, match=f"process {os.getpid()}"),
        open_for_writing(tmp_path),
    ):
        pass
    commit_status(tmp_path, 1)


def test_a_forked_child_that_runs_on_does_not_write(tmp_path: Path):
    script = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from tracklake.pipeline.lake import LakeError, open_for_writing\n"
        "with open_for_writing(Path(sys.argv[1])) as writer:\n"
        "    child = os.fork()\n"
        "    if child == 0:\n"
        "        try:\n"
        "            writer.remember_sources({'a': {}})\n"
        "        except LakeError as refused:\n"
        "            print(refused, flush=True)\n"
        "            os._exit(7)\n"
        "    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "holds the lock" in done.stdout
    assert load(tmp_path).sources == {}


# --------------------------------------------------------------------------------------- what is no lake


def test_a_missing_lake_names_the_next_step(tmp_path: Path):
    for root in (tmp_path, tmp_path / "absent", Path(__file__) / "inside"):
        with pytest.raises(LakeMissingError, match=r"tracklake run SOURCE --lake"):
            load(root)
        with pytest.raises(LakeMissingError):
            connect(root)


def test_a_folder_of_other_things_is_refused_and_left_alone(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("x")
    (tmp_path / f".mine.{'a' * 32}.tmp").write_text("x")
    with pytest.raises(LakeError, match=r"thesis\.tex.*no lake"), open_for_writing(tmp_path):
        pass
    assert len(list(tmp_path.iterdir())) == 2


def test_a_file_or_an_impossible_place_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(LakeError, match="is a file"), open_for_writing(tmp_path / "file"):
        pass
    for place in (tmp_path / "file" / "lake", Path("/proc/lake")):
        with pytest.raises(LakeError, match="no lake can be written there"), open_for_writing(place):
            pass


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"{}", b"null", b'{"name": "a web page"}', b"\xff\xfe\x00", b'{"schema_version": VERSION}',
     b'{"schema_version": VERSION, "lake_id": "a", "generation": 1, "sources": {}, "retired": [], "entries": []}',
     b'{"schema_version": VERSION, "lake_id": "a", "generation": 1, "sources": {}, "retired": [{}], "entries": {}}'],
)  # fmt: skip
def test_a_manifest_that_is_none_is_named_and_nothing_is_touched(tmp_path: Path, content: bytes):
    (tmp_path / "manifest.json").write_bytes(content.replace(b"VERSION", b"%d" % SCHEMA_VERSION))
    (tmp_path / ".staging").mkdir()
    for use in (load, connect, lambda root: open_for_writing(root).__enter__()):
        with pytest.raises(LakeError, match=r"manifest\.json: not a manifest of tracklake"):
            use(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".staging", "manifest.json"]


def test_a_manifest_that_is_a_folder_is_named(tmp_path: Path):
    (tmp_path / "manifest.json").mkdir()
    with pytest.raises(LakeError, match=r"manifest\.json: .*A lake.s manifest is a readable file"):
        load(tmp_path)


def test_another_schema_version_asks_for_a_rebuild(tmp_path: Path):
    commit_status(tmp_path, 1)
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "schema_version": 999}))
    for use in (load, connect, lambda root: open_for_writing(root).__enter__()):
        with pytest.raises(LakeVersionError, match=r"version 999.*Rebuild it from the raw files"):
            use(tmp_path)


# ------------------------------------------------------------------------------------------ full disks


@pytest.mark.parametrize("broken", ["fsync", "replace"])
@pytest.mark.parametrize("after", range(0, 28, 6))
def test_a_full_disk_at_any_moment_leaves_the_lake_as_it_was_or_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str, after: int
):
    write_round(tmp_path, 1)
    real, left = getattr(os, broken), [after]

    def fail(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(28, "No space left on device")
        return real(*arguments)

    monkeypatch.setattr(os, broken, fail)
    with suppress(OSError, FileAccessError):
        write_round(tmp_path, 2)
    monkeypatch.undo()
    check_lake(tmp_path)
    assert not list(tmp_path.glob(".*.tmp*"))
    assert not list((tmp_path / ".staging").glob("*.tmp"))
    write_round(tmp_path, 3)
    check_files(tmp_path)
    numbers = pl.concat([scan(tmp_path, load(tmp_path), SUBSET_STATUS).collect()])["backward_vehicles"].to_list()
    assert numbers == [3, 3]
