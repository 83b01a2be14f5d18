"""`tracklake train` as a user calls it: what it takes, how it is interrupted, and how one goes on."""

import json
import shutil
from contextlib import contextmanager

import pytest


@pytest.fixture
def models(lake):
    """The lake's folder of runs, as it was, afterwards."""
    folder = lake.root / "models"
    before = set(folder.iterdir())
    yield folder
    for run in set(folder.iterdir()) - before:
        shutil.rmtree(run)


def test_options_come_to_the_training(command, lake, models):
    options = ("--epochs", "1", "--samples-per-epoch", "70", "--seed", "3", "--name", "small", "--threads", "1")
    of_model = ("--set", "hidden=8", "--set", "batch_size=32", "--set", "learning_rate=1", "--set", "optimizer=adam")
    done = command.here("train", "lstm", "--lake", lake.root, *options, *of_model, "--json")
    assert done.code == 0, done.err
    metrics = json.loads(done.out)
    assert (metrics["steps"], metrics["samples_seen"]) == (3, 70)
    assert 0 < metrics["data_share"] < 1
    config = json.loads((models / "small" / "config.json").read_text())
    assert config["parameters"] == {"hidden": 8, "anchoring": "both"}
    assert config["training"]["seed"] == 3
    recipe = config["recipe"]
    assert (recipe["batch_size"], recipe["learning_rate"], recipe["optimizer"]) == (32, 1.0, "adam")
    said = command.here("train", "lstm", "--lake", lake.root, "--steps", "2", "--name", "small", "--anew")
    assert "2 steps in" in said.out
    assert "samples/s" in said.out
    assert "reading them took" in said.out


def test_a_run_is_not_replaced_by_another_unless_that_is_said(command, lake, models):
    small = ("--lake", lake.root, "--name", "taken")
    first = ("train", "lstm", *small, "--steps", "2", "--set", "hidden=8")
    assert command.here(*first).code == 0
    written = (models / "taken" / "weights.pt").read_bytes()
    refused = {
        ("lstm", "--steps", "3", "--set", "hidden=8"): "steps 2 there, 3 asked for. Give the new",
        ("lstm", "--steps", "2"): "hidden 8 there, 48 asked for. Give the new",
        ("lstm", "--steps", "2", "--set", "hidden=8", "--seed", "1"): "seed 0 there, 1 asked for. Give the new",
        (
            "lstm",
            "--epochs",
            "1",
            "--set",
            "hidden=8",
        ): "epochs not set there, 1 asked for; steps 2 there, not set asked",
        ("v-lstm", "--steps", "2"): "model lstm there, v-lstm asked for. Give the new",
        ("damped-velocity",): "model lstm there, damped-velocity asked for. Give the new",
    }
    for words, reported in refused.items():
        done = command.here("train", *words, *small)
        assert done.code == 2, words
        assert reported in done.err
        assert "another name (`--name`), or replace the old one (`--anew`)" in done.err
    assert (models / "taken" / "weights.pt").read_bytes() == written
    assert not [path.name for path in models.iterdir() if path.name.startswith(".taken")]
    again = command.here(*first, "--threads", "2", "--set", "learning_rate=0.004")
    assert again.code == 0, "the same settings, whether said or by default, train it again"
    assert command.here("train", "damped-velocity", *small, "--anew").code == 0
    assert json.loads((models / "taken" / "config.json").read_text())["model"] == "damped-velocity"
    assert command.here("train", "damped-velocity", *small).code == 0
    other = command.here("train", "damped-velocity", *small, "--set", "decay_s=2")
    assert (other.code, "--set nothing there, decay_s=2.0 asked for" in other.err) == (2, True)


def test_one_data_set_is_trained_and_scored_alone(command, lake, models):
    options = ("--lake", lake.root, "--steps", "2", "--set", "hidden=8", "--name", "highd-alone", "--dataset", "highd")
    done = command.here("train", "lstm", *options, "--json")
    assert done.code == 0, done.err
    scored = json.loads(done.out)["evaluation"]
    config = json.loads((models / "highd-alone" / "config.json").read_text())
    assert {name.partition("/")[0] for name in config["train_subsets"]} == {"highd"}
    of_all, of_highd = (
        json.loads(command.here("evaluate", "highd-alone", "--lake", lake.root, *more, "--json").out)
        for more in ((), ("--dataset", "highd"))
    )
    assert {own["dataset"] for own in of_highd["rows"]} == {"all", "highd"}
    assert of_highd["evaluations"][0]["horizons"] == scored["horizons"]
    counted = {own["n"] for own in of_all["rows"] if own["dataset"] == "highd" and own["group"] == "all"}
    assert counted == {own["n"] for own in scored["horizons"]}
    wrong = command.here("evaluate", "constant-velocity", "--lake", lake.root, "--dataset", "pneuma")
    assert (wrong.code, "expected a dataset (highd, ngsim), got `pneuma`" in wrong.err) == (2, True)


def test_an_interrupted_training_is_gone_on_with(command, lake, models, monkeypatch):
    steps = ("train", "lstm", "--lake", lake.root, "--name", "half", "--steps", "6", "--set", "hidden=8")

    @contextmanager
    def interrupting(_terminal, _title):
        reported = []

        def tell(_share, _loss):
            reported.append(1)
            if len(reported) == 2:
                raise KeyboardInterrupt

        yield tell

    with monkeypatch.context() as patch:
        patch.setattr("tracklake.pipeline.cli.console.Terminal.show_training", interrupting)
        stopped = command.here(*steps)
    assert stopped.code == 130
    assert "interrupted; the checkpoint is" in stopped.err
    assert f"To go on: tracklake train lstm --resume --name half --lake {lake.root}" in stopped.err
    assert [path.name for path in models.iterdir() if "half" in path.name] == [".half.unfinished"]
    judged = command.here("evaluate", "half", "--lake", lake.root)
    assert judged.code == 1
    assert "was interrupted; finish it first" in judged.err
    unasked = command.here(*steps)
    assert unasked.code == 1
    assert "resume it (`--resume`), or start over with `--anew`" in unasked.err
    other = command.here(*steps, "--resume", "--seed", "9")
    assert other.code == 1
    assert "training.seed 0 then, 9 now" in other.err
    done = command.here("train", "lstm", "--resume", "--name", "half", "--lake", lake.root, "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["steps"] == 6
    assert command.here(*steps, "--resume").code == 1, "it is done"
    assert command.here("evaluate", "half", "--lake", lake.root).code == 0


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("foo",), "unknown model `foo`: expected one of constant-velocity"),
        (("lstn",), "unknown model `lstn`: did you mean lstm?"),
        (("constant-velocity",), "constant-velocity does not learn"),
        (("lstm", "--name", "kalman-cv"), "kalman-cv does not learn"),
        (("damped-velocity", "--epochs", "3"), "is fitted in one pass over `train`, without --epochs; it takes --set"),
        (("kalman-cv", "--set", "batch_size=3"), "kalman-cv has measurement_longitudinal_m,"),
        (("lstm", "--seconds", "1", "--epochs", "2"), "one of seconds, steps, epochs"),
        (("lstm", "--set", "heads=2"), "lstm has batch_size, learning_rate,"),
        (("lstm", "--set", "hidden"), "lstm has batch_size"),
        (("lstm", "--set", "hidden=wide"), "hidden=wide: expected int like 48"),
        (("lstm", "--set", "hidden=true"), "hidden=true: expected int like 48"),
        (("lstm", "--set", "batch_size=0"), "`batch_size`: expected more than 0"),
    ],
)
def test_words_that_mean_nothing_here_are_usage_errors(arguments, reported, command, lake):
    done = command.here("train", *arguments, "--lake", lake.root)
    assert done.code == 2
    assert reported in " ".join(done.err.replace("│", " ").split())


def test_a_fitted_model_is_trained_and_evaluated_with_what_was_fitted(command, lake, models):
    done = command.here("train", "damped-velocity", "--lake", lake.root)
    assert done.code == 0, done.err
    fitted = json.loads((models / "damped-velocity" / "config.json").read_text())["parameters"]
    assert f"damped-velocity: decay_s = {fitted['decay_s']:g}, fitted on " in done.out
    chosen = command.here("train", "damped-velocity", "--set", "decay_s=2", "--name", "two", "--lake", lake.root)
    assert chosen.code == 0, chosen.err
    assert json.loads((models / "two" / "config.json").read_text())["parameters"] == {"decay_s": 2.0}
    assert "damped-velocity: decay_s = 2, set, not fitted\n" in chosen.out
    shown = command.here("evaluate", "two", "damped-velocity", "kalman-cv", "--lake", lake.root)
    assert "kalman-cv: measurement_longitudinal_m = " in shown.out
    assert "damped-velocity: " not in shown.out, "it has a run"


def test_patience_asks_for_a_validation_part(command, lake):
    done = command.here("train", "lstm", "--patience", "2", "--lake", lake.root)
    assert done.code == 1
    assert "patience 2 needs samples in `val`" in done.err


def test_runs_of_several_seeds_are_compared_with_a_model(command, lake, models):
    for seed in ("0", "1"):
        options = ("--steps", "2", "--set", "hidden=8", "--seed", seed, "--name", f"small-{seed}")
        assert command.here("train", "lstm", "--lake", lake.root, *options).code == 0
    call = ("evaluate", "small-0", "constant-velocity", "small-1", "--compare", "--lake", lake.root)
    answer = json.loads(command.here(*call, "--json").out)
    rows = [row for row in answer["comparisons"] if row["figure"] == "rmse_m"]
    assert [row["seconds"] for row in rows] == [1.0, 2.0, 3.0, 4.0, 5.0]
    of = {own["model"]: [row["rmse_m"] for row in own["horizons"]] for own in answer["evaluations"]}
    for at, row in enumerate(rows):
        assert (row["a"], row["b"], row["a_seeds"], row["b_seeds"]) == ("small-0 (2 seeds)", "constant-velocity", 2, 1)
        assert row["a_value"] == pytest.approx((of["small-0"][at] + of["small-1"][at]) / 2)
        assert row["difference"] == pytest.approx(row["a_value"] - of["constant-velocity"][at])
        assert row["low"] < row["difference"] < row["high"]
    out = command.here(*call[:3], "--compare", "--lake", lake.root).out
    assert "difference of RMSE, m\n" in out
    assert "small-0 - constant-velocity" in out
    assert "note: small-0: one seed; another one may change the difference" in out
    alone = command.here("evaluate", "small-0", "small-1", "--compare", "--lake", lake.root)
    assert (alone.code, "small-0, small-1 differ in their seed alone" in alone.err) == (2, True)
    single = command.here("evaluate", "small-0", "small-0", "--compare", "--lake", lake.root)
    assert (single.code, single.out) == (2, ""), "refused before the scoring"
    shutil.copytree(models / "small-0", models / "twice")
    twice = command.here("evaluate", "constant-velocity", "small-0", "twice", "--compare", "--lake", lake.root)
    assert "small-0 (2 seeds): two of the runs small-0, twice have the same seed" in twice.err
