"""`tracklake lane-forest` as a user sees it: what it stores, what it shows, and what it refuses."""

import json
import shutil

import pytest

from training.lane_changes import LaneForest
from training.lane_changes.examples import STRATA
from training.lane_changes.features import NAMES


@pytest.fixture(scope="module")
def copied(lake, tmp_path_factory):
    """What the command reads of the lake, so that nothing is written into the session's."""
    root = tmp_path_factory.mktemp("forest") / "lake"
    root.mkdir()
    shutil.copy(lake.root / "manifest.json", root)
    shutil.copytree(lake.root / "tensors", root / "tensors")
    return root


@pytest.fixture(scope="module")
def done(command, copied):
    finished = command.here("lane-forest", "--lake", copied, "--examples", "300", "--seed", "4")
    assert finished.code == 0, finished.err
    return finished


def test_the_forest_and_its_scores_are_stored(done, copied):
    folder = copied / "models" / "lane-forest"
    assert sorted(file.name for file in folder.iterdir()) == ["forest.npz", "lane_forest.json"]
    forest = LaneForest.load(folder / "forest.npz")
    stored = json.loads((folder / "lane_forest.json").read_text())
    assert stored["forest"] == forest.facts
    assert stored["features"] == list(forest.names)
    assert {row["feature"] for row in stored["forest"]["coefficients"]} == set(NAMES)
    assert (forest.facts["seed"], forest.facts["settings"]["examples"]) == (4, 300)
    keys = {(row["model"], row["column"], row["seconds"], row["stratum"]) for row in stored["cells"]}
    assert keys == {
        (model, column, seconds, stratum)
        for model in ("constant-velocity", "ctrv")
        for column in ("place", "forest")
        for seconds in (1.0, 2.0, 3.0, 4.0, 5.0)
        for stratum in ("all", *STRATA)
    }
    assert str(folder / "forest.npz") in done.out


def test_what_a_person_reads(done):
    lines = [line.split() for line in done.out.splitlines()]
    (title,) = (number for number, line in enumerate(lines) if line == ["right", "cell,", "%"])
    assert lines[title + 1] == ["1", "s", "2", "s", "3", "s", "4", "s", "5", "s"]
    names = [" ".join(line[:-5]) for line in lines[title + 2 : title + 9]]
    models = [f"{name}{by}" for name in ("constant-velocity", "ctrv") for by in ("", " + forest")]
    assert names == [*models, "always the commonest cell", "true place outside of the nine", "n"]
    assert "published" not in done.out, "the figures are of another protocol"
    assert "samples are not scored: what they do is not recorded to the end" in done.out


def test_evaluate_and_report_take_no_notice_of_it(done, copied):
    from pipeline.stages.score import finished_runs

    assert done.code == 0
    assert finished_runs(copied) == []


def test_other_tensors_are_refused(command, copied):
    finished = command.here("lane-forest", "--lake", copied, "--protocol", "grid-2021", "--json")
    assert finished.code == 1
    assert "the tensors were made by another protocol than grid-2021" in json.loads(finished.out)["error"]
