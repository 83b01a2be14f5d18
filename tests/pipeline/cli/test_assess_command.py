"""`tracklake repair --assess`, and what the windows are worth on the generated sample, whose truth is known."""

import json
from contextlib import nullcontext

import polars as pl
import pytest
from small_recordings import VEHICLES, write_highd
from stage_runs import find_outstanding, run_stage
from typer.testing import CliRunner

from tracklake.pipeline.cli import app as cli
from tracklake.pipeline.cli import repair as repair_command
from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.lake import connect, open_for_writing
from tracklake.pipeline.orchestration.run_plan import ALL_STEPS, RunRequest, RunResult
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources.csv import hash_raw
from tracklake.pipeline.stages.planner import Planner
from tracklake.pipeline.stages.stage import StageError
from tracklake.pipeline.transforms.starts.assessment import POSITIONS_M
from tracklake.schemas.start_assessments import ESTIMATORS

WANTED_COVERAGE = 0.95


def test_the_windows_cover_what_the_samples_late_tracks_truly_lack(sample, lake):
    """The truth has the frames of each late track that were never written; windows of the lake are held against them.

    The first few of them lie before the cut-off, where nothing need be covered: the demand is a little harder.
    """
    truth = pl.read_parquet(sample / "truth.parquet").filter(
        (pl.col("kind") == "defect") & (pl.col("name") == "late_start")
    )
    with connect(lake.root) as connection:
        windows = connection.sql("SELECT dataset, subset, vehicle_id, first_missing_frame FROM missing_starts").pl()
    late = truth.join(windows, on=["dataset", "subset", "vehicle_id"], how="left")
    missing = covered = 0
    for first, last, begin in late.select("first_frame", "last_frame", "first_missing_frame").rows():
        for frame in range(first, last + 1):
            missing += 1
            covered += begin is not None and frame >= begin
    assert late.height > 20
    assert missing > 1000
    assert covered >= WANTED_COVERAGE * missing


def test_the_windows_cover_what_is_cut_off_the_samples_whole_tracks(lake):
    with connect(lake.root) as connection:
        table = connection.sql("SELECT * FROM start_assessments").pl()
        known = connection.sql("SELECT subset FROM start_cutoffs WHERE fully_tracked > 1 ORDER BY subset").pl()
    sums = table.group_by("estimator").agg(pl.col("starts", "frames_missing", "frames_covered", "frames_excess").sum())
    rows = {row["estimator"]: row for row in sums.to_dicts()}
    assert set(rows) == set(ESTIMATORS)
    assert rows["regression"]["starts"] > 300
    assert rows["regression"]["frames_covered"] >= WANTED_COVERAGE * rows["regression"]["frames_missing"]
    per_subset = (
        table.filter(pl.col("estimator") == "regression")
        .group_by("subset")
        .agg(share=pl.col("frames_covered").sum() / pl.col("frames_missing").sum())
        .sort("subset")
    )
    assert per_subset["subset"].to_list() == known["subset"].to_list()
    assert (per_subset["share"] >= WANTED_COVERAGE).all()
    assert rows["no_margin"]["frames_covered"] < rows["regression"]["frames_covered"]
    assert rows["local_regression"]["frames_covered"] >= WANTED_COVERAGE * rows["local_regression"]["frames_missing"]
    assert rows["local_regression"]["frames_excess"] < rows["regression"]["frames_excess"]


def test_repair_assess_says_what_the_lake_and_the_report_hold(command, lake):
    """The whole run assessed already, so that there is nothing to do but to say it."""
    with connect(lake.root) as connection:
        starts, covered, excess = connection.sql(
            """
            SELECT sum(starts)::BIGINT, sum(frames_covered / frame_rate_hz) / sum(frames_missing / frame_rate_hz),
                   sum(frames_excess / frame_rate_hz) / sum(frames_missing / frame_rate_hz)
            FROM start_assessments JOIN subsets USING (dataset, subset) WHERE estimator = 'regression'
            """
        ).fetchone()
    done = command.here("repair", "--assess", "--lake", lake.root)
    assert done.code == 0, done.err
    up_to_date, ours, others = done.out.splitlines()
    assert up_to_date == "nothing to do: the lake is up to date"
    assert f"cover {covered:.2%} of the time truly missing, and exclude another {excess:.2%} without need" in ours
    assert f"({starts:,} cut tracks" in ours
    named = [part.strip(" 0123456789.%/") for part in others.removeprefix("other estimators: ").split(",")]
    assert named == [name.replace("_", " ") for name in ESTIMATORS[1:]]
    quality = json.loads((lake.root / "reports" / "quality.json").read_text())
    overall = [row for row in quality["starts"]["assessed"]["subsets"] if row["dataset"] is None]
    assert [row["estimator"] for row in overall] == list(ESTIMATORS)
    assert overall[0]["coverage"] == pytest.approx(covered)


@pytest.mark.parametrize(
    ("flags", "steps"), [([], ("repair",)), (["--assess"], ("repair", "assess", "report"))], ids=["plain", "assess"]
)
def test_repair_assesses_where_asked(monkeypatch, flags, steps):
    asked = []

    def run_steps(_terminal, _settings, given):
        asked.append(given)
        return RunResult()

    monkeypatch.setattr(repair_command, "run_steps", run_steps)
    monkeypatch.setattr(repair_command, "report_result", lambda *_, headline, assess: asked.append((headline, assess)))
    assert CliRunner().invoke(cli.app, ["repair", *flags]).exit_code == 0
    assert asked == [steps, (False, bool(flags))]
    assert ALL_STEPS.index("assess") == ALL_STEPS.index("repair") + 1


def test_the_stage_works_on_what_repair_made(tmp_path):
    """Seven of the eight vehicles of each carriageway come after the first second; all are seen for 180 m."""
    root, settings = tmp_path / "lake", Settings()
    discovery = discover(write_highd(tmp_path / "raw", "01")[0].parent, digest=hash_raw)
    with open_for_writing(root) as writer:
        (job,) = ingest.plan(discovery, writer.manifest)
        writer.commit(ingest.build(root, job))
        with pytest.raises(StageError, match="repair of 01 has not been made"):
            Planner(root, writer.manifest, settings).plan("assess")
    for name in ("repair", "assess"):
        assert [commit.key for commit in run_stage(root, name, settings)] == [f"{name}/highd/01"]
    assert find_outstanding(root, "assess", settings) == []
    with connect(root) as connection:
        table = connection.sql("SELECT subset, estimator, beyond_m, starts, coverage FROM start_assessments").pl()
    reached = [position for position in POSITIONS_M if position < 150 * 30 / 25]
    assert table.height == 2 * len(ESTIMATORS) * len(reached)
    assert set(table["starts"]) == {VEHICLES - 1}
    assert set(table["beyond_m"]) == set(reached)
    assert set(table["coverage"]) == {1.0}, "everybody drives at the same speed"


def test_several_stages_are_one_flow(monkeypatch):
    """What `execute` hands to the flow is what the flow works on."""
    from tracklake.pipeline.orchestration import flows

    class Flow:
        def with_options(self, **_options):
            return self

        def __call__(self, **parameters):
            return run_stage(**parameters)

    orders = []
    run_stage = flows.run_stage.fn
    monkeypatch.setattr(flows, "run_stage", Flow())
    monkeypatch.setattr(flows, "use_server", lambda: nullcontext([]))
    monkeypatch.setattr(flows, "_run_request", lambda order: orders.append(order) or {})
    for steps in (("repair",), ("repair", "assess", "report")):
        flows.execute(RunRequest("somewhere", steps))
        assert orders.pop() == RunRequest("somewhere", steps, settings={})
