"""What is worked on at once never needs more than there is, and everyone has a turn."""

import gzip
import threading
import time
import zipfile

import pytest
from small_recordings import write_highd

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.ingest.memory_budget import MemoryBudget
from tracklake.pipeline.lake import open_for_writing
from tracklake.pipeline.sources import RawFile
from tracklake.pipeline.sources.csv import hash_raw, measure_unpacked
from tracklake.pipeline.sources.csv.raw_files import GZIP_RATIO


def test_no_more_is_taken_at_once_than_there_is_and_all_have_a_turn():
    budget, guard = MemoryBudget(10), threading.Lock()
    taken, done = [], []
    most = 0

    def work(size):
        nonlocal most
        with budget.reserve(size):
            with guard:
                taken.append(size)
                most = max(most, sum(taken))
            time.sleep(0.002)
            with guard:
                taken.remove(size)
                done.append(size)

    sizes = [3, 7, 5, 5, 10, 1, 9, 2, 6, 4] * 3
    threads = [threading.Thread(target=work, args=(size,)) for size in sizes]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=20)
    assert sorted(done) == sorted(sizes)
    assert 7 <= most <= 10


def test_what_is_larger_than_the_room_is_alone_in_it():
    budget, inside, entered = MemoryBudget(10), threading.Event(), threading.Event()

    def small():
        with budget.reserve(1):
            entered.set()

    with budget.reserve(99):
        inside.set()
        other = threading.Thread(target=small)
        other.start()
        assert not entered.wait(0.05)
    assert entered.wait(5)
    other.join()


def test_an_error_gives_back_what_was_taken():
    budget = MemoryBudget(10)
    with pytest.raises(ValueError, match="broken"), budget.reserve(10):
        raise ValueError("broken")
    with budget.reserve(10):
        pass


def test_a_recording_waits_for_room_of_the_length_of_its_text(tmp_path, monkeypatch):
    text_bytes = sum(path.stat().st_size for path in write_highd(tmp_path / "raw", "01"))
    budget = MemoryBudget(text_bytes + 1)
    monkeypatch.setattr(ingest, "MEMORY_BUDGET", budget)
    with open_for_writing(tmp_path / "lake") as writer:
        (job,) = ingest.plan(discover(tmp_path / "raw", digest=hash_raw), writer.manifest)
        built = []
        builder = threading.Thread(target=lambda: built.append(ingest.build(writer.root, job)))
        with budget.reserve(2):
            builder.start()
            builder.join(timeout=0.5)
            assert builder.is_alive(), "one byte too few"
        builder.join(timeout=60)
    assert [entry.key for entry in built] == ["ingest/highd/01"]


def test_the_length_of_a_packed_files_text(tmp_path):
    text = b"0123456789" * 1_000
    (tmp_path / "a.csv").write_bytes(text)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(text))
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("folder/a.csv", text)
    assert measure_unpacked(RawFile(tmp_path / "a.csv", "00")) == len(text)
    assert measure_unpacked(RawFile(tmp_path / "a.zip", "00", member="folder/a.csv")) == len(text)
    packed = (tmp_path / "a.csv.gz").stat().st_size
    assert measure_unpacked(RawFile(tmp_path / "a.csv.gz", "00")) == GZIP_RATIO * packed, "estimated"
