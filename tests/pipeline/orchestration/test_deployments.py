"""The flows as deployments: their schedules, parameters and limits, and a scheduled run on a changed folder."""

import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import DeploymentFilter, DeploymentFilterId
from prefect.client.schemas.sorting import FlowRunSort
from prefect.settings import PREFECT_API_URL, temporary_settings
from small_recordings import write_highd

from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings

pytestmark = pytest.mark.usefixtures("prefect_here")


def wait_for(find, process, seconds: float = 90):
    """The first result of a function that is not empty."""
    limit = time.monotonic() + seconds
    while process.poll() is None and time.monotonic() < limit:
        found = find()
        if found:
            return found
        time.sleep(0.3)
    raise AssertionError(process.communicate(timeout=5)[0] if process.poll() is not None else "too slow")


NAMES = ("run", "ingest", "quality")
"""Deployments that `tracklake serve` offers."""


def check_deployments(found, root, watched):
    """Schedules, parameters and limits of the three deployments."""
    scheduled = found["run"]
    assert scheduled.parameters == {"lake": str(root), "source": str(watched)}
    assert [each.schedule.interval.total_seconds() for each in scheduled.schedules] == [2]
    assert {each.global_concurrency_limit.limit for each in found.values()} == {1}
    assert [found[name].schedules for name in ("ingest", "quality")] == [[], []]
    schema = scheduled.parameter_openapi_schema
    assert schema["required"] == ["lake", "source"]
    assert all("description" in each for each in schema["properties"].values())
    described = schema["definitions"]["SettingsChanges"]["properties"]
    assert described.keys() == Settings.model_fields.keys() - {"lake"}
    assert all("description" in each for each in described.values())


def run_next(client, deployment, process) -> tuple[str, str]:
    """What Prefect's scheduler does every minute: have the next run of a schedule done; its name and final state.

    The schedule has one run every two seconds: asked again for the time of a run that has ended, the server makes no
    other.
    """

    def find_runs():
        own = DeploymentFilter(id=DeploymentFilterId(any_=[deployment.id]))
        return client.read_flow_runs(deployment_filter=own, sort=FlowRunSort.EXPECTED_START_TIME_DESC)

    earlier = find_runs()
    after = [each.expected_start_time + timedelta(seconds=1) for each in earlier[:1]]
    start = max([datetime.now(UTC), *after])
    wanted = {"start_time": f"{start:%FT%T.%fZ}", "min_runs": 1, "max_runs": 1}
    client.request("POST", "/deployments/{id}/schedule", path_params={"id": deployment.id}, json=wanted)

    def find_new():
        runs = find_runs()
        return len(runs) > len(earlier) and all(run.state.is_final() for run in runs) and runs

    latest = wait_for(find_new, process)[0]
    assert latest.auto_scheduled
    return latest.name, latest.state.name


@pytest.mark.thorough
def test_a_scheduled_run_on_a_changed_folder(command, tmp_path):
    watched, root = tmp_path / "watched", tmp_path / "lake"
    watched.mkdir()
    (watched / "other.csv").write_text("a,b\n1,2\n")
    served = replace(command, folder=tmp_path)
    process = served.start(
        "serve", "watched", "--lake", "lake", "--interval", "2", PREFECT_RUNNER_POLL_FREQUENCY="1"
    )  # fmt: skip
    try:
        with get_client(sync_client=True) as client:

            def find_deployments():
                own = (each for each in client.read_deployments() if each.parameters.get("lake") == str(root))
                found = {each.name: each for each in own}
                return found if len(found) == len(NAMES) else None

            found = wait_for(find_deployments, process)
            assert sorted(found) == sorted(NAMES)
            check_deployments(found, root, watched)
            assert run_next(client, found["run"], process) == (f"run {watched}", "Failed")
            assert not root.exists()
            write_highd(watched, "04")
            assert run_next(client, found["run"], process) == ("run watched: 04", "CompletedWithRefusals")
            assert [commit.tail for commit in load(root).of_stage("ingest")] == ["highd/04"]
    finally:
        process.kill()
        process.communicate()


def test_serve_says_what_it_misses(command):
    with temporary_settings({PREFECT_API_URL: None}):
        alone = command.here("serve")
    assert (alone.code, "PREFECT_API_URL is not set" in alone.err) == (1, True)
    for wrong, words in [
        (("--cron", "0 3 * * *"), "need SOURCE"),
        (("raw", "--cron", "0 3 * * *", "--interval", "60"), "not both"),
        (("raw", "--cron", "at dawn"), "expected five fields such as '0 3 * * *'; got 'at dawn'"),
        (("raw", "--interval", "0"), "--interval"),
    ]:
        done = command.here("serve", *wrong)
        assert (done.code, words in done.err) == (2, True), done.err
