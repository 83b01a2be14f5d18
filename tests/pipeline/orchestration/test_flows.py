"""What Prefect adds: tasks and ends that are seen; that it caches nothing; and what is tried again."""

import errno
import json
import logging
import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from pathlib import Path
from unittest.mock import Mock

import httpx
import pytest
from plain_flows import replace_prefect
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.client.schemas.sorting import ArtifactSort, FlowRunSort
from prefect.settings import PREFECT_RESULTS_LOCAL_STORAGE_PATH
from small_recordings import KINDS, write_highd

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.lake import LakeLockedError, LakeMissingError, connect, load, open_for_writing
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.manifest import Manifest
from tracklake.pipeline.orchestration import artifacts, flows, run_plan, tasks
from tracklake.pipeline.sources import SourceError

pytestmark = [
    pytest.mark.usefixtures("prefect_here"),
    # Prefect's own, from the server it starts in this process.
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def raw(tmp_path) -> Path:
    """One small recording."""
    write_highd(tmp_path / "raw", "04")
    return tmp_path / "raw"


@pytest.fixture
def calls(monkeypatch) -> Counter:
    """How often each recording was really built."""
    counted: Counter = Counter()
    real = ingest.build

    def counting(root, job, *others):
        counted[job.title] += 1
        return real(root, job, *others)

    monkeypatch.setattr(ingest, "build", counting)
    return counted


def test_a_busy_disk_is_tried_again_and_bad_input_is_not(raw, tmp_path, monkeypatch):
    tries: Counter = Counter()
    real = ingest.build

    def flaky(root, job, *others):
        tries["flaky"] += 1
        if tries["flaky"] == 1:
            raise OSError("the share does not answer")
        return real(root, job, *others)

    monkeypatch.setattr(ingest, "build", flaky)
    result = flows.ingest_files(str(tmp_path / "one"), str(raw))
    assert result["built"] == {"ingest": 1}
    assert tries["flaky"] == 2

    def hopeless(*_job):
        tries["hopeless"] += 1
        raise SourceError("04_tracks.csv, line 7: no good")

    monkeypatch.setattr(ingest, "build", hopeless)
    with pytest.raises(flows.FlowFailedError, match=r"1 refused: 04_tracks\.csv, line 7: no good") as ended:
        flows.ingest_files(str(tmp_path / "two"), str(raw))
    assert ended.value.result.refused == ["04_tracks.csv, line 7: no good"]
    assert ended.value.result.built == {}
    assert tries["hopeless"] == 1


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EFBIG, errno.EMFILE, errno.EROFS])
def test_a_full_disk_is_not_tried_again(raw, tmp_path, monkeypatch, number):
    tries = Mock(side_effect=OSError(number, os.strerror(number)))
    monkeypatch.setattr(ingest, "build", tries)
    with pytest.raises(flows.FlowFailedError, match=os.strerror(number)):
        flows.ingest_files(str(tmp_path / "lake"), str(raw))
    assert tries.call_count == 1


def read_run(root: Path):
    """The latest flow run on a lake, as its server shows it, with its log."""
    with get_client(sync_client=True) as client:
        latest = client.read_flow_runs(sort=FlowRunSort.START_TIME_DESC)  # 200 of them
        return next(run for run in latest if run.parameters.get("lake") == str(root))


@pytest.fixture
def logged(caplog) -> pytest.LogCaptureFixture:
    """What the runs log; the shared tests' server is sent no logs."""
    logger = logging.getLogger("prefect.flow_runs")
    logger.addHandler(caplog.handler)
    yield caplog
    logger.removeHandler(caplog.handler)


def test_refusals_are_a_state_a_log_and_an_artifact(raw, tmp_path, logged):
    (raw / "other.csv").write_text("a,b\n1,2\n")
    root = tmp_path / "lake"
    result = flows.ingest_files(str(root), str(raw))
    assert result["built"] == {"ingest": 1}
    (message,) = result["refused"]
    assert "other.csv" in message
    made = read_run(root)
    assert (made.state.name, made.state.type.value) == ("CompletedWithRefusals", "COMPLETED")
    assert made.state.message == f"1 refused: {message}"
    assert made.name == "ingest raw: 04"
    (artifact,) = artifacts_of(root)["tracklake-messages"]
    assert json.loads(artifact.data) == [{"kind": "refused", "level": "WARNING", "message": message}]
    assert f"refused: {message}" in [record.getMessage() for record in logged.records if record.levelname == "WARNING"]
    # Nothing is to be done, and the refusal is not forgotten; a setting makes it a failure.
    with pytest.raises(flows.FlowFailedError, match="1 refused"):
        flows.ingest_files(str(root), str(raw), settings={"refusals_fail": True})
    again = read_run(root)
    assert (again.state.name, again.name) == ("Failed", "ingest raw: nothing new")
    assert len(artifacts_of(root)["tracklake-messages"]) == 2


def test_work_that_broke_off_fails_the_run_and_is_returned_to_the_command(raw, tmp_path, monkeypatch, logged):
    write_highd(raw, "05")
    real = ingest.build

    def break_one(root, job, *others):
        if job.title == "05":
            raise RuntimeError("boom")
        return real(root, job, *others)

    monkeypatch.setattr(ingest, "build", break_one)
    request = run_plan.RunRequest(str(tmp_path / "lake"), ("ingest",), str(raw))
    result = flows.execute(request)
    assert result.built == {"ingest": 1}
    (failure,) = result.failed
    assert "RuntimeError: boom" in failure
    made = read_run(tmp_path / "lake")
    assert (made.state.name, made.name) == ("Failed", "ingest raw: 04, 05")
    assert "boom" in made.state.message
    assert any("failed: 05: " in record.getMessage() for record in logged.records if record.levelname == "ERROR")


def test_a_deployment_on_nothing_usable_fails_and_makes_no_lake(tmp_path):
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SourceError, match=r"other\.csv"):
        flows.run(str(tmp_path / "lake"), str(tmp_path / "raw"))
    assert "other.csv" in read_run(tmp_path / "lake").state.message
    with pytest.raises(LakeMissingError):
        flows.quality(str(tmp_path / "lake"))
    assert read_run(tmp_path / "lake").state.name == "Failed"
    assert not (tmp_path / "lake").exists()


def test_a_run_waits_for_a_lake_that_another_process_writes_to(raw, tmp_path, monkeypatch, logged):
    monkeypatch.setattr(tasks, "LOCK_POLL_S", 0.05)
    root = tmp_path / "lake"
    with ThreadPoolExecutor(max_workers=1) as other:
        with open_for_writing(root):
            with pytest.raises(LakeLockedError, match="is writing to this lake"):
                flows.ingest_files(str(root), str(raw), lock_timeout_s=0.1)
            assert read_run(root).state.name == "Failed"
            assert "This run waits up to 0.1 s for it." in logged.text
            run_here = copy_context().run
            ended = other.submit(run_here, flows.ingest_files, str(root), str(raw), lock_timeout_s=60)
            time.sleep(0.5)
            assert not ended.done()
        assert ended.result()["built"] == {"ingest": 1}


def test_prefect_keeps_no_results_and_the_lake_alone_decides_what_is_done(raw, tmp_path, calls):
    root = tmp_path / "lake"
    assert flows.ingest_files(str(root), str(raw))["built"] == {"ingest": 1}
    finished = load(root)
    assert flows.ingest_files(str(root), str(raw))["built"] == {}
    assert calls == {"04": 1}
    # As if the process had died between the task's end and the commit: the files stay, and are committed.
    written = {path: path.stat().st_mtime_ns for path in root.glob("tracks/**/*.parquet")}
    CommitLog(root).replace(Manifest(lake_id=finished.lake_id))
    assert flows.ingest_files(str(root), str(raw))["built"] == {"ingest": 1}
    assert calls == {"04": 2}
    assert {path: path.stat().st_mtime_ns for path in root.glob("tracks/**/*.parquet")} == written
    again = load(root).commits["ingest/highd/04"]
    assert (again.files, again.fingerprint) == (
        finished.commits["ingest/highd/04"].files,
        finished.commits["ingest/highd/04"].fingerprint,
    )
    # Files that were removed are made again, and a changed file is another content.
    shutil.rmtree(root / ".files" / "tracks")
    assert flows.ingest_files(str(root), str(raw))["built"] == {"ingest": 1}
    with (raw / "04_tracks.csv").open("a") as file:
        file.write("\n")
    assert flows.ingest_files(str(root), str(raw))["built"] == {"ingest": 1}
    assert calls == {"04": 4}
    assert list(Path(PREFECT_RESULTS_LOCAL_STORAGE_PATH.value()).iterdir()) == []


@pytest.fixture
def searches(monkeypatch) -> Iterator[tuple[Mock, Mock]]:
    """Counts how often the source was searched, and compared with the lake; Prefect has no part in that."""
    discover, plan = Mock(wraps=run_plan.discover), Mock(wraps=run_plan.plan_ingest)
    monkeypatch.setattr(run_plan, "discover", discover)
    for user in (run_plan, tasks):
        monkeypatch.setattr(user, "plan_ingest", plan)
    with replace_prefect():
        yield discover, plan


def count_calls(mocks: tuple[Mock, Mock]) -> tuple[int, ...]:
    """The calls since the last count."""
    counts = tuple(mock.call_count for mock in mocks)
    for mock in mocks:
        mock.reset_mock()
    return counts


def ingest_as_a_command(root: Path, source: Path, **settings) -> run_plan.RunResult:
    """What `tracklake ingest` does with a request."""
    request = run_plan.RunRequest(str(root), ("ingest",), str(source), **settings)
    plan = run_plan.plan_run(request, run_plan.survey_source(request))
    return run_plan.conclude_idle(request, plan) if plan.is_idle else flows.execute(request, plan)


def test_a_command_searches_the_source_once_and_compares_it_with_the_lake_once(raw, tmp_path, searches):
    root = tmp_path / "lake"
    cases = [({}, 1), ({}, 0), ({}, 1), ({"rebuild": True}, 2)]
    for number, (flags, expected) in enumerate(cases):  # no lake yet; nothing to do; one more recording; all again
        if number == 2:
            write_highd(raw, "05")
        result = ingest_as_a_command(root, raw, **flags)
        assert (result.built.get("ingest", 0), result.refused, result.failed) == (expected, [], [])
        assert count_calls(searches) == (1, 1), flags
    # A served deployment searches the source by itself, once as well.
    write_highd(raw, "07")
    assert flows.ingest_files(str(root), str(raw))["built"] == {"ingest": 1}
    assert count_calls(searches) == (1, 1)


def test_a_lake_that_changed_since_it_was_planned_is_planned_again(raw, tmp_path, searches):
    request = run_plan.RunRequest(str(tmp_path / "lake"), ("ingest",), str(raw))
    flows.ingest_files(str(tmp_path / "lake"), str(raw))
    write_highd(raw, "05")
    count_calls(searches)
    plan = run_plan.plan_run(request, run_plan.survey_source(request))
    assert [job.key for job in plan.ingest.jobs] == ["ingest/highd/05"]
    with open_for_writing(tmp_path / "lake") as writer:  # another process, between the plan and the run
        writer.remove({"ingest/highd/04"})
    assert flows.execute(request, plan).built == {"ingest": 2}
    assert count_calls(searches) == (1, 2)


def artifacts_of(root: Path) -> dict[str, list]:
    """The artifacts of a lake's runs by key, without the lake's name and id at its end, oldest first."""
    ending = f"-lake-{load(root).lake_id[:8]}"
    with get_client(sync_client=True) as client:
        latest = client.read_artifacts(sort=ArtifactSort.CREATED_DESC)  # 200 of them
        found = sorted(latest, key=lambda artifact: artifact.created)
    made: dict[str, list] = {}
    for artifact in found:
        if artifact.key.endswith(ending):
            made.setdefault(artifact.key.removesuffix(ending), []).append(artifact)
    return made


def wait_for_tasks(root: Path, wanted: set[str]) -> set[str]:
    """The names of the latest run's tasks, which are recorded by events, a little later."""
    limit, seen = time.monotonic() + 20, set()
    own = FlowRunFilter(id=FlowRunFilterId(any_=[read_run(root).id]))
    with get_client(sync_client=True) as client:
        while not wanted <= seen and time.monotonic() < limit:
            seen = {task.name for task in client.read_task_runs(flow_run_filter=own)}
            time.sleep(0.2)
    return seen


@pytest.mark.thorough
def test_tasks_and_the_report_are_seen_by_the_server_that_prefect_api_url_names(command, sample, tmp_path):
    raw = tmp_path / "raw"
    raw.mkdir()
    for kind in KINDS:
        shutil.copy(sample / f"04_{kind}.csv", raw)
    root = tmp_path / "odd [x](y) \u00e9" / "Lake"
    # In a process of its own: the one of the tests has sent events to other servers, and Prefect keeps that connection.
    done = command("run", raw, "--lake", root, "--json")
    assert done.code == 0, done.err
    assert read_run(root).state.name == "Completed"
    lakes_own = ("split split", "tensors tensors", "report report")
    stages = ("ingest", "validate", "repair", "assess", "samples", "pages")
    wanted = {*lakes_own, *(f"{stage} 04" for stage in stages)}
    assert wanted <= wait_for_tasks(root, wanted)
    result = json.loads(done.out)
    assert not any("artifacts" in note for note in result["notes"])
    found = artifacts_of(root)
    (messages,) = found.pop("tracklake-messages")
    assert [row["message"] for row in json.loads(messages.data)] == list(dict.fromkeys(result["notes"]))
    assert {key: len(made) for key, made in found.items()} == dict.fromkeys(
        [f"tracklake-{what}" for what in ("findings", "subsets", "ingestion", "completeness", "report")], 1
    )
    quality = json.loads((root / "reports" / "quality.json").read_text())
    tables = {key: json.loads(made[0].data) for key, made in found.items() if made[0].type == "table"}
    rules = {row["rule"]: row for row in tables["tracklake-findings"]}
    assert list(rules) == [rule["name"] for rule in quality["rules"]]
    with connect(root) as lake:
        in_lake = lake.sql("SELECT rule, count(*), sum(entries) FROM findings GROUP BY rule").fetchall()
        subsets = lake.sql("SELECT subset, vehicles, entries FROM subsets ORDER BY subset").fetchall()
        files = lake.sql("SELECT file, rows_read, rows_dropped FROM ingest_log ORDER BY file").fetchall()
        announced = lake.sql("SELECT measure, expected, found FROM completeness ORDER BY authority, measure").fetchall()
    assert len(in_lake) > 3
    assert {name: (row["findings"], row["entries"]) for name, row in rules.items() if row["findings"]} == {
        rule: (runs, entries) for rule, runs, entries in in_lake
    }
    shown = tables["tracklake-subsets"]
    assert [(row["subset"], row["vehicles"], row["entries"]) for row in shown] == subsets
    per_rule = {rule: sum(row[rule] or 0 for row in shown) for rule in rules}
    assert {rule: entries for rule, entries in per_rule.items() if entries} == {r: n for r, _, n in in_lake}
    assert [(row["file"], row["rows_read"], row["rows_dropped"]) for row in tables["tracklake-ingestion"]] == files
    assert [(row["measure"], row["expected"], row["found"]) for row in tables["tracklake-completeness"]] == announced
    (link,) = found["tracklake-report"]
    assert link.data == f"[quality report of Lake]({(root / 'reports' / 'index.html').as_uri()})"
    assert link.data.count("(") == 1, "what a path's brackets would end is the link"
    with get_client(sync_client=True) as client:
        assert client.read_flow_run(link.flow_run_id).state.is_completed()
    # A run that finds the report up to date shows it again, as that run's; one of another stage does not.
    flows.quality(str(root))
    flows.run_stage("validate", str(root))
    assert {len(made) for key, made in artifacts_of(root).items() if key in found} == {2}


@pytest.mark.parametrize(
    ("failure", "is_ours"),
    [
        (httpx.ConnectError("no server there"), False),
        (httpx.ReadTimeout(""), False),
        (503, False),
        (403, False),
        (422, True),
        (TypeError("table is no list"), True),
    ],
)
def test_a_run_does_not_fail_with_prefects_api_and_does_with_a_fault_of_ours(monkeypatch, failure, is_ours):
    def refuse(**_table):
        if isinstance(failure, int):
            request = httpx.Request("POST", "http://prefect/api/artifacts/")
            raise httpx.HTTPStatusError(f"answered {failure}", request=request, response=httpx.Response(failure))
        raise failure

    monkeypatch.setattr(artifacts, "create_table_artifact", refuse)
    table = artifacts.FigureTable("tracklake-some", "Some.", [{"a": 1}])
    if is_ours:
        with pytest.raises((httpx.HTTPStatusError, TypeError)):
            artifacts.publish([table])
    else:
        (note,) = artifacts.publish([table])
        says = {503: "answered 503", 403: "answered 403"}.get(failure, str(failure) or "ReadTimeout")
        assert note.startswith(f"Prefect did not take all that describes this run ({says}); the lake")
