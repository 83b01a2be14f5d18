"""The score of drives: a run apart from the others, collected for the report, redone for other drives only."""

import json

import pytest
from drive_lake import fuse_with, score_drives, write_drive
from stage_runs import find_outstanding

from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import drive_score
from tracklake.pipeline.stages.score import list_finished_runs
from tracklake.schemas.errors import TracklakeError


def test_drives_are_scored_apart_from_tracks(tmp_path):
    write_drive(tmp_path, "one", fused=False)
    (commit,) = score_drives(tmp_path, ["one"])
    written = [file.path for file in commit.files["models"]]
    assert written == ["models/onboard/ctrv/config.json", "models/onboard/ctrv/metrics.json"]
    assert list_finished_runs(tmp_path) == []
    skipped = []
    (score,) = drive_score.collect_drive_scores(tmp_path, load(tmp_path), skipped.append)
    assert (score["model"], score["part"], [row["seconds"] for row in score["rows"]]) == (
        "ctrv",
        "eval",
        [0.5, 1, 1.5, 2],
    )
    assert all(row["n"] == commit.info["samples"] > 0 for row in score["rows"])
    assert score["warnings"]["n"] == commit.info["samples"]
    assert skipped == []
    other = tmp_path / "models" / "onboard" / "stacked-lstm"
    other.mkdir()
    (other / "metrics.json").write_text(json.dumps({"evaluation": {"scores": [], "warnings": {}, "split": "other"}}))
    assert len(drive_score.collect_drive_scores(tmp_path, load(tmp_path), skipped.append)) == 1
    (other / "metrics.json").write_text("{}")
    assert len(drive_score.collect_drive_scores(tmp_path, load(tmp_path), skipped.append)) == 1
    assert "stacked-lstm/metrics.json: expected scores on drives" in skipped[0]


def test_one_vehicle_makes_a_note_and_no_score(tmp_path):
    write_drive(tmp_path, "one", 1, fused=False)
    (commit,) = score_drives(tmp_path, ["one"], 1)
    (note,) = commit.info["notes"]
    assert note.startswith("no score of the drives: expected samples of at least two vehicles")
    assert not commit.all_files
    assert drive_score.collect_drive_scores(tmp_path, load(tmp_path), print) == []


def test_nothing_is_planned_without_drives_and_all_is_again_with_another(tmp_path):
    write_drive(tmp_path, "one", fused=False)
    with pytest.raises(TracklakeError, match="the drives hold no vehicle around the ego"):
        drive_score.read_drives(tmp_path, load(tmp_path))
    stages = (fuse_with({}), drive_score.STAGE)
    score_drives(tmp_path, ["one"])
    assert find_outstanding(tmp_path, "drive_score", Settings(lake=tmp_path), stages) == []
    other = Settings(lake=tmp_path, split_seed=1)
    assert find_outstanding(tmp_path, "drive_score", other, stages) == ["drive_score"]
    write_drive(tmp_path, "two", seed=1, fused=False)
    (commit,) = score_drives(tmp_path, ["one", "two"])
    assert commit.key == "drive_score"
