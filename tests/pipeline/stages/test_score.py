"""What the report takes from the lake's runs: those that fit the live tensors; damaged ones are skipped and named."""

import json
from types import SimpleNamespace

import pytest
from tiny_network import write_tiny

from tracklake.pipeline.lake.files import MODELS, TENSORS
from tracklake.pipeline.stages.score import collect_scores
from tracklake.schemas.run_config import RUN_VERSION

ROW = {"seconds": 1.0, "rmse_m": 2.5, "rmse_longitudinal_m": 2.4, "n": 7}
MANIFEST = SimpleNamespace(commits={TENSORS: SimpleNamespace(info={"path": "tensors"}, all_files=[])})


def write_run(root, name, **config):
    folder = root / MODELS / name
    folder.mkdir(parents=True)
    index = json.loads((root / "tensors" / "index.json").read_text())
    made_of = {name: index[name] for name in ("protocol", "blocks")}
    whole = {"version": RUN_VERSION, "model": "lstm", "parameters": {}, "train_subsets": [], **made_of, **config}
    (folder / "config.json").write_text(json.dumps(whole))
    metrics = {"evaluation": {"part": "eval", "horizons": [{**ROW, "mae_m": 2.0}]}}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


@pytest.fixture
def root(tmp_path):
    write_tiny(tmp_path / "tensors")
    write_run(tmp_path, "whole")
    return tmp_path


def test_runs_of_other_tensors_are_none(root):
    write_run(root, "other", protocol={"name": "other", "digest": "1"})
    skipped = []
    assert collect_scores(root, MANIFEST, skipped.append) == [{"model": "whole", "part": "eval", "rows": [ROW]}]
    assert skipped == []


def test_a_run_that_was_scored_on_one_recording_says_so(root):
    write_run(root, "lstm", training={"dataset": "highd", "recording": None})
    assert [own["model"] for own in collect_scores(root, MANIFEST, print)] == ["lstm (highd alone)", "whole"]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("config.json", "{", "config.json: not readable as JSON"),
        ("config.json", '{"version": 1}', f"config.json: expected version {RUN_VERSION}, got 1; train it again"),
        ("config.json", None, "config.json"),
        ("metrics.json", "", "metrics.json: expected what a training scored, got JSONDecodeError"),
        ("metrics.json", "[]", "metrics.json: expected what a training scored, got TypeError"),
        ("metrics.json", '{"evaluation": {"part": "eval"}}', "got KeyError('horizons'); train it again"),
    ],
)
def test_a_damaged_run_is_skipped_and_named(root, file, content, message):
    damaged = write_run(root, "damaged") / file
    damaged.unlink() if content is None else damaged.write_text(content)
    skipped = []
    scores = collect_scores(root, MANIFEST, skipped.append)
    assert [own["model"] for own in scores] == ["whole"]
    (note,) = skipped
    assert note.startswith("skipped a run: ")
    assert str(damaged) in note
    assert message in note
