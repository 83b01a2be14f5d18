"""Batches: how many there are, what they are called, and what is committed with them."""

import logging
from itertools import pairwise

import pytest
from plain_flows import replace_prefect
from small_recordings import write_highd

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import Commit, LakeError, LakeFile, load, open_for_writing
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.orchestration import batches, flows, run_plan
from tracklake.pipeline.orchestration.batches import Call, Threads, divide_calls, name_batch
from tracklake.pipeline.orchestration.tasks import BatchFailedError, do_batch
from tracklake.pipeline.sources import SourceError


def make_calls(number: int) -> list[Call]:
    return [Call(int, (), (f"{n:03}",)) for n in range(number)]


@pytest.mark.parametrize(("calls", "expected"), [(0, []), (1, [1]), (100, [1] * 100), (101, [2] * 50 + [1])])
def test_a_stage_has_at_most_a_hundred_batches(calls, expected):
    divided = divide_calls(Threads(4), make_calls(calls))
    assert [len(batch) for batch in divided] == expected
    assert [call.titles[0] for batch in divided for call in batch] == [f"{n:03}" for n in range(calls)]


def test_a_batch_is_named_after_its_recordings():
    assert name_batch(make_calls(1)) == "000"
    assert name_batch([Call(int, (), ("01", "02"))]) == "01, 02"
    assert name_batch(make_calls(3)) == "000 to 002 (3)"


def test_the_recordings_of_a_batch_are_one_commit(tmp_path, monkeypatch):
    """Five recordings in batches of two are three commits; the one that is refused keeps none from being made."""
    for number in range(1, 6):
        write_highd(tmp_path / "raw", f"{number:02}")
    build, replace, stored = ingest.build, CommitLog.replace, []

    def refuse_one(root, job, *others):
        if job.title == "02":
            raise SourceError("02_tracks.csv, line 7: no good")
        return build(root, job, *others)

    def count(log, manifest):
        stored.append(len(manifest.commits))
        return replace(log, manifest)

    monkeypatch.setattr(batches, "MOST_BATCHES", 3)
    monkeypatch.setattr(ingest, "build", refuse_one)
    monkeypatch.setattr(CommitLog, "replace", count)
    root = tmp_path / "lake"
    with replace_prefect():
        result = flows.execute(run_plan.RunRequest(str(root), ("ingest",), str(tmp_path / "raw")))
    assert result.built == {"ingest": 4}
    assert result.refused == ["02_tracks.csv, line 7: no good"]
    sizes = [after - before for before, after in pairwise(stored) if after > before]
    assert sorted(sizes) == [1, 1, 2]  # 01 alone, 03 and 04, 05; batches end in any order
    assert load(root).generation == 1


def test_what_a_batch_has_done_is_handed_on_where_its_workers_break_off():
    (first, _) = calls = make_calls(2)

    def break_off():
        yield first, 0
        raise RuntimeError("the loop is closed")

    with pytest.raises(BatchFailedError, match="the loop is closed") as failed:
        do_batch.fn("toy", name_batch(calls), break_off)
    assert failed.value.outcomes == [(first, 0)]
    assert isinstance(failed.value.broken, RuntimeError)


def test_workers_of_a_served_flow_get_the_whole_path_of_a_lake(tmp_path, monkeypatch):
    """Their working folders are others."""
    asked = []

    def refuse(request, *_others):
        asked.append(request.lake)
        raise SourceError("stop")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(flows, "_plan_here", lambda _request: run_plan.RunPlan())
    monkeypatch.setattr(flows, "do_work", refuse)
    monkeypatch.setattr(flows, "get_run_logger", logging.getLogger)
    flows._run_request(run_plan.RunRequest("lake", ("ingest",), "raw"))
    assert asked == [str(tmp_path / "lake")]


def test_nothing_of_a_batch_is_committed_where_a_file_has_vanished(tmp_path):
    there, gone = (Commit(f"ingest/highd/{name}", "f", {"tracks": [LakeFile(name, 0, 0)]}) for name in ("a", "gone"))
    with open_for_writing(tmp_path) as writer:
        (tmp_path / "a").touch()
        with pytest.raises(LakeError, match="ingest/highd/gone vanished"):
            writer.commit(there, gone)
    assert load(tmp_path).commits == {}


def test_calls_that_have_not_begun_when_threads_stop_are_left_out():
    threads = Threads(1)
    outcomes = []
    for call, made in threads.run_calls("toy", make_calls(3)):
        outcomes.append((call.titles, made))
        threads.stop()
    assert outcomes == [(("000",), 0)]
