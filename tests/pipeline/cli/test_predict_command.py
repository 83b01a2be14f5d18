"""`tracklake predict` in this process, on tensors of a moment that is known by hand."""

import json
import os

import pytest
from drawn_moment import FAR, OWN, make_moment
from typer.testing import CliRunner

from tracklake.pipeline.cli import app as cli
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.runs.run_folder import describe_run, save_run


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return make_moment(tmp_path_factory.mktemp("moment"))


@pytest.fixture
def predict(tensors, tmp_path, monkeypatch):
    """The command on a lake that is nothing but these tensors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tracklake.pipeline.cli.predict.load", lambda root: root)
    monkeypatch.setattr("tracklake.pipeline.cli.predict.tensor_folder", lambda *_: tensors)
    (tmp_path / "lake" / "models").mkdir(parents=True)

    def run(*arguments):
        done = CliRunner().invoke(cli.app, ["predict", *map(str, arguments)], catch_exceptions=False)
        return done.exit_code, done.stdout, " ".join(done.stderr.replace("│", " ").split())

    return run


def test_a_sample_is_drawn_into_the_lake(predict, tmp_path):
    code, out, err = predict("--sample", 0)
    file = tmp_path / "lake" / "predictions" / "b_1_1.0s_constant-velocity.svg"
    assert (code, err) == (0, "")
    assert "vehicle 1 of b at 1.0 s (eval)" in out
    # Constant velocity says (60, 6) after 2 s; the vehicle was at (60, 2).
    assert "off after 2 s: constant-velocity 4.00 m" in out
    assert str(file.relative_to(tmp_path)) in out
    assert "vehicle 1 at 1.0 s" in file.read_text()
    assert [path.name for path in file.parent.iterdir()] == [file.name]


def test_the_numbers_drawn_are_given_as_json(predict, tmp_path):
    code, out, _ = predict("constant-velocity", "--vehicle", "b:1", "--time", 1, "--json", "--out", "own.png")
    assert code == 0
    output = json.loads(out)
    assert output["attention"] == []
    [picture] = output["pictures"]
    assert (picture["file"], picture["sample"], picture["lateral"]) == ("own.png", 0, "left")
    own = picture["vehicles"][0]
    assert own["truth_m"] == [[30, 5.5], [40, 4.5], [53, 3], [60, 2]]
    assert own["predictions"][0]["position_m"] == [[30, 6], [40, 6], [50, 6], [60, 6]]
    assert (tmp_path / "own.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


def test_all_samples_of_the_moment_and_a_folder(predict, tmp_path):
    code, out, _ = predict("--all-vehicles", "--pick", "worst", "--out", "drawn", "--json")
    assert code == 0
    [picture] = json.loads(out)["pictures"]
    assert [(one["vehicle_id"], len(one["predictions"])) for one in picture["vehicles"]] == [(OWN, 1), (2, 0), (FAR, 1)]
    assert [path.name for path in (tmp_path / "drawn").iterdir()] == ["b_1-and-all_1.0s_constant-velocity.svg"]


def test_fewer_than_requested_is_reported(predict):
    code, out, _ = predict("--pick", "brake", "--count", 3, "--out", "drawn")
    assert code == 0
    assert "there are only 1 such samples" in out


def test_without_names_the_newest_runs_that_fit_are_drawn(predict, tensors, tmp_path):
    """One of four is of other tensors. With all vehicles, only the newest is drawn."""
    folder = TensorFolder.open(tensors)
    config = describe_run("constant-velocity", {}, {}, folder)
    for age, name in enumerate(("stale", "new", "middle", "old")):
        protocol = {**config["protocol"], "digest": "another"} if name == "stale" else config["protocol"]
        save_run(tmp_path / "lake" / "models" / name, {**config, "protocol": protocol}, {}, None)
        os.utime(tmp_path / "lake" / "models" / name / "metrics.json", (9_000 - age, 9_000 - age))
    code, out, err = predict("--sample", 0, "--json")
    assert code == 0
    [picture] = json.loads(out)["pictures"]
    models = [one["model"] for one in picture["vehicles"][0]["predictions"]]
    assert models == ["constant-velocity", "new", "middle", "old"]
    assert "skipped:" in err
    assert "trained for the protocol tiny (another)" in err
    code, out, _ = predict("--sample", 0, "--all-vehicles")
    assert "off after 2 s: new 4.00 m" in out
    assert "note: 4 runs in the lake, of which the newest are drawn; name others" in out
    assert predict("--sample", 0, "stale")[0] == 1


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--sample", 2], 2, "--sample is a number from 0 to 1; got 2"),
        (["--sample", -1], 2, "--sample is a number from 0 to 1; got -1"),
        (["--sample", 0, "--pick", "brake"], 2, "give one; got --sample and --pick"),
        (["--vehicle", "b:1"], 2, "--vehicle SUBSET:ID and --time S go together"),
        (["--time", 1], 2, "--vehicle SUBSET:ID and --time S go together"),
        (["--vehicle", "b:1", "--time", 9], 1, "no sample of vehicle 1 in b at 9 s: it has 1 from 1 to 1 s"),
        (["--vehicle", "b:3", "--time", 1], 1, "no sample of vehicle 3 in b; the nearest ids with any: 1, 5"),
        (["--pick", "lane-keep"], 1, "no sample to pick by `lane-keep`"),
        (["--part", "train"], 1, "no sample to pick by `random` among the 0 of part `train`"),
        (["--part", "test"], 2, "--part is one of train, val, eval; got 'test'"),
        (["--sample", 0, "--count", 2], 2, "--count goes with --pick"),
        (["--count", 2, "--out", "one.png"], 2, "--out is a folder where --count is more than 1"),
        (["--out", "one.pdf"], 2, "--out ends in .svg or .png, or is a folder; got one.pdf"),
        (["unknown"], 2, "no run or model `unknown`: expected one of the runs (none yet)"),
        (["lstm"], 2, "no trained run; run `tracklake train lstm` first"),
        (["a", "b", "c", "d", "e"], 2, "a drawing holds 4 models at most"),
        (["--sample", 0, "--attention"], 2, "--attention needs a run of a model with attention"),
    ],
)
def test_what_cannot_be_drawn_is_refused(predict, tmp_path, arguments, code, message):
    found, out, err = predict(*arguments)
    assert (found, out) == (code, "")
    assert message in err
    assert not (tmp_path / "lake" / "predictions").exists()


def test_without_a_lake_there_is_nothing_to_draw(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(cli.app, ["predict"], catch_exceptions=False)
    assert done.exit_code == 1
    assert "tracklake run" in done.stderr or "tracklake ingest" in done.stderr


def test_limits_of_the_options_are_those_of_drawings():
    from tracklake.pipeline.cli.predict import MOST_MODELS, SUFFIXES
    from tracklake.schemas import drawings
    from tracklake.training.plots import picture_drawing

    assert (MOST_MODELS, SUFFIXES) == (picture_drawing.MOST_MODELS, drawings.SUFFIXES)
