"""The end of a session: done, or done again; after a death at every step that changes the file system, too."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import duckdb
import pytest
from plain_catalogs import list_live
from small_lake import DEADLY, check_folder, find_files, make_status, put, put_round, write_round

from tracklake.pipeline.lake import Writer, catalog, is_settled, load, open_for_writing
from tracklake.schemas.files import list_unfinished

ANOTHER = {"dataset": "highd", "subset": "02-upper"}


class Died(BaseException):
    """What a process that is dead does not survive."""


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A catalog that DuckDB need not make, and nothing synced: only the order of steps is looked at."""
    monkeypatch.setattr(catalog, "build_catalog", list_live)
    monkeypatch.setattr(os, "fsync", lambda _descriptor: None)


def die_at(step: int, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Let the step-th change of the file system, and all later ones, fail: a dead process cleans nothing up."""
    done = [0]

    def fail_late(real: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **named: object) -> object:
            done[0] += 1
            if done[0] > step:
                raise Died
            return real(*arguments, **named)

        return call

    for name in DEADLY:
        monkeypatch.setattr(os, name, fail_late(getattr(os, name)))
    return done


def commit_upper(writer: Writer, number: int) -> None:
    """Two tables and a folder of one subset: every kind of step, and few of them."""
    writer.commit(put_round(writer.root, "01-upper", number))


def run_first(root: Path) -> None:
    with open_for_writing(root) as writer:
        commit_upper(writer, 1)


def change(root: Path) -> None:
    with open_for_writing(root) as writer:
        commit_upper(writer, 7)


def prune(root: Path) -> None:
    with open_for_writing(root) as writer:
        writer.remove({"validate/highd/01-upper"})


def rebuild(root: Path) -> None:
    with open_for_writing(root, rebuild=True) as writer:
        commit_upper(writer, 4)


def change_nothing(root: Path) -> None:
    with open_for_writing(root):
        pass


def check_settled(root: Path) -> None:
    """What "nothing to do" promises."""
    manifest = load(root)
    assert is_settled(root, manifest)
    assert (root / "catalog.duckdb").read_text().split() == sorted(manifest.live_paths())
    assert find_files(root) == manifest.live_paths() | {item.path for item in manifest.retired}
    assert not (root / ".writer").exists()
    assert not (root / ".staging").exists()
    assert not list_unfinished(root)
    check_folder(root)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("work", [run_first, change, prune, rebuild, change_nothing])
def test_a_death_at_any_step_is_noticed_and_mended(
    tmp_path: Path, work: Callable[[Path], None], request: pytest.FixtureRequest
):
    stride = 1 if request.config.getoption("--thorough") else 3
    before, root = tmp_path / "before", tmp_path / "lake"
    if work is not run_first:
        for number in (2, 3, 4):  # so that there is something to delete, too
            with open_for_writing(before) as writer:
                commit_upper(writer, number)
                if number == 2:
                    writer.commit(put(before, "validate/highd/02", 1, make_status("02-upper", 1), **ANOTHER))
    step, settled = 0, []
    while True:
        shutil.rmtree(root, ignore_errors=True)
        if before.exists():
            shutil.copytree(before, root)
        with pytest.MonkeyPatch.context() as patched:
            done = die_at(step, patched)
            try:
                work(root)
            except Died:
                pass
            else:
                break
        if (root / "manifest.json").exists() and is_settled(root, load(root)):
            check_settled(root)
            settled.append(step)
        change_nothing(root)
        check_settled(root)
        step += stride
    check_settled(root)
    assert step - stride < done[0] <= step
    assert step >= (8 if work is change_nothing else 20)
    assert all(early <= 1 for early in settled), "after the first changes, nothing is settled until the end"


def damage(root: Path) -> Iterator[str]:
    """Every way to spoil a catalog, each in turn."""
    target = root / "catalog.duckdb"
    whole = target.read_bytes()
    target.unlink()
    yield "deleted"
    target.write_bytes(b"")
    yield "empty"
    target.unlink()
    (target / "inner").mkdir(parents=True)
    yield "a folder"
    target.write_bytes(b"garbage" * 1000)
    yield "garbage"
    other = root.parent / "other"
    write_round(other, 2)
    shutil.copy2(other / "catalog.duckdb", target)
    yield "another lake's"
    target.write_bytes(whole[:-1] + b"x")
    yield "flipped"


def test_a_catalog_that_is_spoilt_is_made_again(tmp_path: Path):
    root = tmp_path / "lake"
    write_round(root, 1)
    for state in damage(root):
        assert not is_settled(root, load(root)), state
        change_nothing(root)
        assert is_settled(root, load(root)), state
        assert sorted(path.name for path in root.iterdir() if path.name.startswith((".", "c"))) == [
            ".files",
            ".lock",
            ".session",
            "catalog.duckdb",
        ]
        connection = duckdb.connect()
        connection.execute(f"ATTACH '{root}/catalog.duckdb' AS c (READ_ONLY)")
        connection.execute(f"SET file_search_path = '{root}'")
        assert connection.sql("SELECT sum(backward_vehicles) FROM c.subset_status").fetchall() == [(2,)]
        connection.close()


LEFTOVERS = (
    ".writer",
    "catalog.duckdb.wal",
    ".staging/spilled/x.arrow",
    f".manifest.json.{'a' * 32}.tmp",
    f"reports/.index.html.{'b' * 32}.tmp",
    ".files/tracks/dataset=highd/subset=01-upper/part-1.parquet",
    "tensors/01-upper/1/z.bin",
    "tracks/dataset=highd/subset=01-upper/part-01.parquet",
    "subset_status/mine.csv",
)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("left", LEFTOVERS)
def test_whatever_is_left_lying_is_noticed_and_removed(tmp_path: Path, left: str):
    write_round(tmp_path, 1)
    (tmp_path / left).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / left).write_text("process 1")
    assert not is_settled(tmp_path, load(tmp_path))
    change_nothing(tmp_path)
    check_settled(tmp_path)
    assert not (tmp_path / left).exists()


@pytest.mark.usefixtures("quick")
def test_a_session_that_goes_on_is_not_settled(tmp_path: Path):
    write_round(tmp_path, 1)
    with open_for_writing(tmp_path) as writer:
        assert not is_settled(tmp_path, writer.manifest)
    assert is_settled(tmp_path, load(tmp_path))
