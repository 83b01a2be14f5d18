"""`tracklake lane-forest` as a user sees it: what it stores, what it shows, and what it refuses."""

import json
import re
import shutil
from dataclasses import replace

import pytest

from tracklake.schemas.lane_forest import FEATURE_NAMES, LEFT_OUT, STRATA
from tracklake.schemas.protocols import CSP
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.forest import LaneForest
from tracklake.training.models import MODELS
from tracklake.training.runs.run_folder import describe_run, save_run


@pytest.fixture(scope="module")
def copied(lake, tmp_path_factory):
    """What the command reads of the lake, so that nothing is written into the session's."""
    root = tmp_path_factory.mktemp("forest") / "lake"
    return shutil.copytree(lake.root, root, ignore=shutil.ignore_patterns("models", "reports"))


@pytest.fixture(scope="module")
def done(command, copied):
    finished = command.here("lane-forest", "--lake", copied, "--examples", "300", "--seed", "4")
    assert finished.code == 0, finished.err
    return finished


def test_the_forest_and_its_scores_are_stored(done, copied):
    folder = copied / "models" / "lane-forest"
    assert sorted(file.name for file in folder.iterdir()) == ["forest.skops", "lane_forest.json"]
    forest = LaneForest.load(folder / "forest.skops")
    stored = json.loads((folder / "lane_forest.json").read_text())
    assert stored["forest"] == forest.facts
    assert stored["features"] == list(forest.names)
    assert {row["feature"] for row in stored["forest"]["coefficients"]} == set(FEATURE_NAMES)
    assert (forest.facts["seed"], forest.facts["settings"]["examples"]) == (4, 300)
    keys = {(row["model"], row["column"], row["seconds"], row["stratum"]) for row in stored["cells"]}
    assert keys == {
        (model, column, seconds, stratum)
        for model in ("constant-velocity", "ctrv")
        for column in ("place", "forest")
        for seconds in (1.0, 2.0, 3.0, 4.0, 5.0)
        for stratum in ("all", *STRATA)
    }
    assert stored["left_out"] == sum(stored["left_out_by_reason"].values())
    assert tuple(stored["left_out_by_reason"]) == LEFT_OUT
    assert (stored["learning_curve"], stored["skipped"]) == ([], {})
    assert str(folder / "forest.skops") in done.out


def test_what_a_person_reads(done):
    lines = [line.split() for line in done.out.splitlines()]
    (title,) = (number for number, line in enumerate(lines) if line == ["right", "cell,", "%"])
    assert lines[title + 1] == ["1", "s", "2", "s", "3", "s", "4", "s", "5", "s"]
    names = [" ".join(line[:-5]) for line in lines[title + 2 : title + 9]]
    models = [f"{name}{by}" for name in ("constant-velocity", "ctrv") for by in ("", " + forest")]
    assert names == [*models, "always the commonest cell", "true place outside of the nine", "n"]
    assert "published" not in done.out, "the figures are of another protocol"
    assert re.search(r"[0-9,]+ samples are not scored: .*[0-9,]+ not recorded for 5 s", done.out)


def test_a_forest_is_no_run(done, copied):
    from tracklake.pipeline.stages.score import list_finished_runs

    assert done.code == 0
    assert list_finished_runs(copied) == []


@pytest.fixture
def kept(done, copied):
    """The forest and its scores, put back after a test."""
    assert done.code == 0
    folder = copied / "models" / "lane-forest"
    before = {file: file.read_bytes() for file in folder.iterdir()}
    yield folder
    for file, whole in before.items():
        file.write_bytes(whole)


def test_a_stored_forest_is_scored_again_beside_new_runs(command, copied, kept):
    """A run of constant velocity is scored as constant velocity itself; what cannot be opened is skipped."""
    scored, forest = json.loads((kept / "lane_forest.json").read_text()), (kept / "forest.skops").read_bytes()
    [index] = (copied / "tensors").glob("*/*/index.json")
    folder = TensorFolder.open(index.parent)
    config, models = describe_run("constant-velocity", {}, {}, folder), copied / "models"
    for name, changes in {
        "of-another-protocol": {"protocol": config["protocol"] | {"digest": "another"}},
        "good": {},
        "of-an-unknown-model": {"model": "crystal-ball"},
    }.items():
        save_run(models / name, config | changes, {}, None)
    learned = describe_run("lstm", {}, {}, folder) | {"blocks": [], "train_subsets": sorted(folder.subsets_of("eval"))}
    save_run(models / "on-these-recordings", learned, {}, MODELS["lstm"].build(folder.protocol))
    (models / "damaged").mkdir()
    (models / "damaged" / "metrics.json").write_text("{}")
    finished = command.here("lane-forest", "--lake", copied, "--use", "--json")
    written = json.loads((kept / "lane_forest.json").read_text())
    alone = command.here("lane-forest", "good", "--lake", copied, "--use", "--json")
    refused = command.here("lane-forest", "good", "on-these-recordings", "--lake", copied, "--use")
    for run in models.iterdir():
        if run != kept:
            shutil.rmtree(run)
    assert finished.code == 0, finished.err
    reported = json.loads(finished.out)
    assert reported["forest"] == scored["forest"]
    assert (kept / "forest.skops").read_bytes() == forest
    straight = [own for own in scored["cells"] if own["model"] == "constant-velocity"]
    assert [own for own in reported["cells"] if own["model"] == "good"] == [own | {"model": "good"} for own in straight]
    assert [own for own in reported["cells"] if own["model"] != "good"] == scored["cells"]
    assert json.loads(alone.out)["cells"] == reported["cells"]
    assert json.loads(alone.out)["skipped"] == {}, "it was not asked for"
    assert refused.code == 1
    assert "were in its training part" in refused.err
    reasons = {
        "damaged": "config.json",
        "of-another-protocol": "trained for the protocol csp",
        "of-an-unknown-model": "unknown model `crystal-ball`",
        "on-these-recordings": "were in its training part",
    }
    assert reported["skipped"].keys() == reasons.keys()
    for name, reason in reasons.items():
        assert reason in reported["skipped"][name]
        assert f"skipped: {name}: " in finished.err
    assert written["skipped"] == reported["skipped"]


def test_settings_are_the_forests(command, copied, kept):
    given = ("start_s=2", "trees=3", "leaf=9", "shift_m=1.5")
    finished = command.here(
        "lane-forest", "--lake", copied, "--examples", "200", *(part for own in given for part in ("--set", own))
    )
    assert finished.code == 0, finished.err
    forest = LaneForest.load(kept / "forest.skops")
    known = forest.facts["settings"]
    assert [known[name] for name in ("start_s", "trees", "leaf", "shift_m", "examples")] == [2.0, 3, 9, 1.5, 200]
    assert len(forest.classifier.estimators_) == 3


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (["--set", "depth=3"], "the forest has start_s, measured_start, tolerance_m, shift_m, trees, leaf,"),
        (["--set", "examples=3"], "got 'examples=3'"),
        (["--set", "trees=many"], "--set trees=many: expected int like 100"),
        (["--set", "trees=0"], "`trees`: expected more than 0, got 0"),
        (["--use", "--seed", "0"], "--use scores a forest as it is"),
        (["--use", "--set", "trees=3"], "--use scores a forest as it is"),
    ],
)
def test_what_cannot_be_set_is_told(command, copied, arguments, reported):
    finished = command.here("lane-forest", "--lake", copied, *arguments)
    assert finished.code == 2
    assert reported in " ".join(finished.err.replace("│", " ").split())


def test_a_forest_of_another_protocol_or_none_is_not_used(command, copied, kept):
    file = kept / "forest.skops"
    forest = LaneForest.load(file)
    replace(forest, facts=forest.facts | {"protocol": {"name": CSP.name, "digest": "another"}}).save(file)
    finished = command.here("lane-forest", "--lake", copied, "--use")
    assert finished.code == 1
    assert f"forest.skops: fitted for another protocol than csp ({CSP.digest})" in finished.err
    file.unlink()
    finished = command.here("lane-forest", "--lake", copied, "--use")
    assert finished.code == 1
    assert "forest.skops: no such file; run `tracklake lane-forest` again" in finished.err


def test_other_tensors_are_refused(command, copied):
    finished = command.here("lane-forest", "--lake", copied, "--protocol", "grid-2021", "--json")
    assert finished.code == 1
    assert "the tensors were made by another protocol than grid-2021" in json.loads(finished.out)["error"]
