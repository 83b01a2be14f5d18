"""The study: a tiny one from raw file to page, pooled figures by hand, and the plan."""

import gzip
import json
import re
import shutil
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from study.__main__ import main, run_arms
from study.jobs import SCORES, Job, Lake, Workshop, resolve_settings
from study.page import render_pages
from study.pieces import PIECES
from study.plan import EVAL_BLOCK, Arm, Learner, Source, estimate_pieces, make_quick
from study.results import Results
from study.tables import NOTHING, TABLES, pool_scores, read_table, select_complete
from verdicts import check_verdicts

from tracklake.pipeline.cli.train import _check_name, read_model_settings
from tracklake.training.models import MODELS, find_model
from tracklake.training.onboard.as_published import CONSTANT, DIFFERENCE, OURS, PUBLISHED

DOCS = Path(__file__).parents[1] / "docs"
TEMPLATES = Path(__file__).parents[1] / "benchmarks" / "study"
OTHERS = Source("Three others.", file="others.csv.gz", lane_ft=12.0)
TINY = Arm(
    "tiny",
    Source("Six vehicles.", file="tiny.csv.gz", lane_ft=12.0),
    ("constant-velocity",),
    (
        Learner("lstm", 2, 200, epochs=1),
        Learner(
            "lstm",
            1,
            200,
            epochs=1,
            label="lstm, elsewhere",
            source=Source("Others.", file="others.csv.gz", lane_ft=12.0),
        ),
    ),
    pairs=(("lstm, elsewhere", "lstm"),),
    settings={
        "TRACKLAKE_SPLIT": "time-blocks",
        "TRACKLAKE_SPLITS": '["time-blocks"]',
        "TRACKLAKE_SPLIT_BLOCK_S": "20",
        "TRACKLAKE_RECONSTRUCT": "false",
    },
    folds=(0, 1),
)


def write_traffic(file, speed_up_ft=3):
    """Write vehicles that speed up and slow down, three for 20 s and three 8 s later, in the excerpt's columns."""
    vehicle = np.repeat(np.arange(6), 200)
    frame = np.tile(np.arange(200), 6) + 280 * (vehicle // 3)
    y_ft = 60 * (vehicle % 3) + 4 * (frame % 280) - 2 * speed_up_ft * np.cos(frame / 20 + vehicle)
    columns = {"Vehicle_ID": 1 + vehicle, "Frame_ID": 100 + frame, "Total_Frames": np.full(1200, 200)}
    columns |= {"Global_Time": 1118846980200 + 100 * (100 + frame), "Local_X": 6.0 + 12 * (vehicle % 3)}
    columns |= {"Local_Y": y_ft.round(3), "v_Vel": (40 + speed_up_ft * np.sin(frame / 20 + vehicle)).round(2)}
    columns |= dict.fromkeys(("v_Acc", "Space_Headway", "Time_Headway"), np.zeros(1200))
    file.write_bytes(gzip.compress(pl.DataFrame(columns).write_csv().encode()))


@pytest.fixture(scope="module")
def tiny(command, tmp_path_factory, plain_flows):  # noqa: ARG001  (a fixture cannot use another by a mark)
    """A tiny study: its workshop, and the folder of its tables."""
    data, work, docs = (tmp_path_factory.mktemp(name) for name in ("data", "work", "docs"))
    write_traffic(data / TINY.source.file)
    write_traffic(data / TINY.learners[1].source.file, speed_up_ft=2)

    def call(words, environment):
        done = command.here(*words, **environment)
        assert done.code in (0, 3), done.err + done.out
        calls.append(words[0])
        return done.code

    calls = []
    workshop = Workshop(work, data, at_once=1, call=call)
    run_arms([TINY], workshop, docs, only_gather=False)
    assert not workshop.failed
    return workshop, docs, calls


@pytest.mark.thorough
def test_a_tiny_study_has_every_seed_and_the_digests_of_its_tensors(tiny):
    workshop, docs, _ = tiny
    seeds = read_table(docs, "seeds").filter(group="all", dataset="all")
    assert seeds.group_by("model").agg(pl.col("seed").n_unique()).sort("model").rows() == [
        ("constant-velocity", 1),
        ("lstm", 2),
        ("lstm, elsewhere", 1),
    ]
    lakes = workshop.find_lakes(TINY)
    stated = [row for row in read_table(docs, "lakes").to_dicts() if "elsewhere" not in row["lake"]]
    for lake, row in zip(lakes, stated, strict=True):
        (file,) = lake.root.glob("tensors/*/*/index.json")
        index = json.loads(file.read_text())
        assert row["protocol_digest"] == index["protocol"]["digest"]
        assert row["split_digest"] == index["split_recipe"]["digest"]
        assert [block["part"] for block in index["blocks"]][lake.fold] == "eval"
        assert row["eval"] == index["samples_by_part"]["eval"] > 0
    assert stated[0]["split_digest"] != stated[1]["split_digest"]
    # Of all folds, and as the commands' own tables have it: 1 s ahead, by the slow way.
    jobs = [job for job in workshop.list_jobs(TINY) if job.model == "lstm" and job.seed == 1]
    rows = [pl.read_csv(job.scores / SCORES).row(0, named=True) for job in jobs]
    rmse = (sum(row["n"] * row["rmse_m"] ** 2 for row in rows) / sum(row["n"] for row in rows)) ** 0.5
    assert {row["seconds"] for row in rows} == {1.0}
    assert seeds.filter(model="lstm", seed=1, seconds=1.0)["rmse_m"].to_list() == pytest.approx([rmse], abs=1e-5)
    compared = read_table(docs, "comparisons").filter(figure="rmse_m", seconds=1.0, dataset="all")
    found = {(row["model"], row["against"]): row for row in compared.to_dicts()}
    alone = {model: row["difference"] for (model, against), row in found.items() if against == NOTHING}
    assert alone == {model: row["a_value"] for (model, against), row in found.items() if against == NOTHING}
    assert set(alone) == {"constant-velocity", "lstm", "lstm, elsewhere"}
    assert found["lstm, elsewhere", "lstm"]["difference"] == pytest.approx(
        alone["lstm, elsewhere"] - alone["lstm"], abs=2e-5
    )
    found = found["lstm", "constant-velocity"]
    assert found["difference"] == pytest.approx(alone["lstm"] - alone["constant-velocity"], abs=2e-5)
    assert found["a_value"] == pytest.approx(seeds.filter(model="lstm", seconds=1.0)["rmse_m"].mean(), abs=1e-4)
    assert found["low"] <= found["difference"] <= found["high"]


@pytest.mark.thorough
def test_a_finished_study_trains_nothing_again_and_a_new_seed_alone_is_added(tiny):
    workshop, docs, calls = tiny
    calls.clear()
    run_arms([TINY], workshop, docs, only_gather=False)
    assert calls == ["run"] * 4
    more = replace(TINY, learners=(replace(TINY.learners[0], seeds=3),))
    jobs = list(workshop.list_jobs(more))
    assert [(job.model, job.seed, job.lake.fold) for job in jobs if not job.scores.exists()] == [
        ("lstm", 2, 0),
        ("lstm", 2, 1),
    ]
    assert len(select_complete(jobs, 2)) == 6  # a seed that lacks a fold is left out


@pytest.mark.thorough
def test_a_run_with_other_defaults_than_now_is_made_again(tiny, tmp_path, monkeypatch):
    workshop, _, _ = tiny
    said = []
    work = shutil.copytree(workshop.work, tmp_path / "work")
    other = Workshop(work, workshop.data, at_once=1, call=lambda words, _: said.append(words) or 0)
    assert all(job.is_done for job in other.list_jobs(TINY))
    lstm = MODELS["lstm"]
    for changed in ({"parameters": {**lstm.parameters, "hidden": 24}}, {"recipe": replace(lstm.recipe, batch_size=64)}):
        monkeypatch.setitem(MODELS, "lstm", replace(lstm, **changed))
        jobs = list(other.list_jobs(TINY))
        assert {job.model for job in jobs if not job.is_done} == {"lstm", "lstm, elsewhere"}
        assert {job.model for job in select_complete(jobs, 2)} == {"constant-velocity"}
    other.work_on(jobs)
    trained = [words for words in said if words[0] == "train"]
    assert len(trained) == 6
    assert all("--anew" in words for words in trained)
    assert sum(words[0] == "evaluate" for words in said) == 6
    assert sum("--evidence" in words for words in said) == 4  # of the first seed alone


@pytest.mark.thorough
def test_forests_are_scored_once_and_their_page_marks_what_differs(tiny, tmp_path, monkeypatch):
    workshop, _, _ = tiny
    arm = replace(TINY, name="woods", plain=(), learners=(), folds=(0,), forest=("--as-published",), pairs=())
    row = {"figure": "cell", "model": "ctrv", "grid": "around the place now", "seconds": 2.0, "n": 50, "vehicles": 7}
    shares = [
        row | {"forest": forest, "value": value, "low": value - 0.1, "high": value + 0.1}
        for forest, value in ((OURS, 0.5), (PUBLISHED, 0.7), (DIFFERENCE, 0.2), (CONSTANT, 0.4))
    ]
    points = [
        {"drawn": drawn, "train_accuracy": train, "train_n": drawn, "eval_accuracy": scored, "eval_n": 50}
        for drawn, train, scored in ((100, 1.0, 0.5), (2000, 0.9, 0.8))
    ]
    decoder = {"best": 1, "converged": False, "losses": [2.0, 1.0], "validation_losses": [3.0, 2.5]}
    record = {"shares": shares, "learning_curve": points, "decoder": decoder}
    said = []

    def call(words, _):
        said.append(words)
        if words[0] == "lane-forest":
            out = Path(words[words.index("--lake") + 1]) / "models" / "lane-forest"
            out.mkdir()
            (out / "lane_forest.json").write_text(json.dumps({"as_published": record}))
        return 0

    other = Workshop(shutil.copytree(workshop.work, tmp_path / "work"), workshop.data, at_once=1, call=call)
    for module in ("study.page", "study.results"):
        monkeypatch.setattr(f"{module}.PIECES", (replace(PIECES[0], name="woods", arms=(arm,)),))
    docs = tmp_path / "docs"
    docs.mkdir()
    for _ in range(2):
        run_arms([arm], other, docs, only_gather=False)
    assert [words[0] for words in said] == ["run", "lane-forest", "run"]
    assert "--as-published" in said[1]
    table = read_table(docs, "forests")
    assert (table.height, table["arm"].unique().to_list()) == (8, ["woods"])
    page = render_pages(Results.read(docs))["results.md"]
    assert "| 40.0 (30.0 to 50.0) | 50.0 (40.0 to 60.0) | 70.0 (60.0 to 80.0) | **+20.00 (+10.00 to +30.00)** |" in page
    assert "| cell | 2 s, ctrv, around the place now | 50 | 7 |" in page
    assert "not run with all seeds" not in page
    assert "| 100 | 100.0 | 50.0 |\n| 2,000 | 90.0 | 80.0 |" in page
    assert "| 0 | 2.000 | 3.000 |\n| 1 | 1.000 | 2.500 |" in page
    assert not (docs / "results-curves.svg").exists()  # of networks alone
    assert read_table(docs, "lakes")["arm"].to_list() == ["woods"]


@pytest.mark.thorough
def test_pages_of_a_study_print_its_digests_and_call_nothing_better_without_an_interval(tiny, monkeypatch):
    _, docs, _ = tiny
    piece = replace(PIECES[0], name="tiny", arms=(TINY,))
    for module in ("study.page", "study.results"):
        monkeypatch.setattr(f"{module}.PIECES", (piece,))
    page = render_pages(Results.read(docs))["results.md"]
    for digest in read_table(docs, "lakes")["tensors"]:
        assert f"| {digest} |" in page
    assert "### tiny" in page
    # Half of six vehicles give the radius: too few of any density but the sum of all.
    assert re.search(r"\| `lstm` \| all \| [\d,]+ \| \d+\.\d\d \| - \| \d+\.\d\d \|", page)
    check_verdicts(page)


def test_the_identity_of_a_run_is_its_settings_and_its_tensors():
    lake = Lake(TINY, 0, Path("lakes/a"), "digest", {})
    job = Job(lake, "lstm", TINY.learners[0], 0)
    others = [
        replace(job, seed=1),
        replace(job, learner=replace(TINY.learners[0], epochs=2)),
        replace(job, learner=replace(TINY.learners[0], options=("--set", "hidden=24"))),
        replace(job, lake=replace(lake, digest="other")),
        replace(job, lake=replace(lake, root=Path("lakes/b"))),
    ]
    assert len({own.identity for own in (job, *others)}) == 6
    assert replace(job, learner=replace(TINY.learners[0], seeds=8)).identity == job.identity


def test_a_model_without_the_setting_of_folds_is_trained_once_for_all_of_them():
    settings = {"TRACKLAKE_SPLIT": "time-blocks", "TRACKLAKE_SPLIT_BLOCK_S": "50"}
    taken = {"TRACKLAKE_SPLIT": "csp-2018", "TRACKLAKE_SPLIT_BLOCK_S": "", EVAL_BLOCK: ""}
    arm = replace(TINY, settings=settings)
    own = replace(TINY.learners[0], source=OTHERS, settings=taken)
    home = arm.find_home(own)
    assert (home.source, home.settings, home.folds) == (OTHERS, {"TRACKLAKE_SPLIT": "csp-2018"}, ())
    home = arm.find_home(TINY.learners[0])
    assert (home.source, home.settings, home.folds) == (TINY.source, settings, TINY.folds)


def test_jobs_that_share_a_run_train_it_once(tmp_path):
    own = Learner("lstm", 1, 200, epochs=1)
    home = Lake(TINY, None, tmp_path / "lakes" / "home", "digest", {"blocks": [], "protocol": {}})
    lakes = [Lake(TINY, fold, tmp_path / "lakes" / f"{fold}", "digest", home.index) for fold in (0, 1)]
    calls = []

    def call(words, environment):  # noqa: ARG001  (as `call_command`)
        calls.append(words[0])
        if words[0] == "train":
            time.sleep(0.2)  # the other job asks meanwhile
            folder = home.root / "models" / words[words.index("--name") + 1]
            folder.mkdir(parents=True)
            (folder / "config.json").write_text(json.dumps(resolve_settings(own)))
        return 0

    workshop = Workshop(tmp_path, tmp_path, at_once=2, call=call)
    workshop.work_on([Job(lake, "lstm", own, 0, home) for lake in lakes])
    assert sorted(calls) == ["evaluate", "evaluate", "train"]
    assert not workshop.failed


def test_errors_of_folds_are_pooled_by_their_samples(tmp_path):
    """3 samples with 2 m and 1 sample with 4 m: the root of (3 * 4 + 16) / 4; means by samples, too."""
    jobs = [Job(Lake(TINY, fold, tmp_path / "lakes" / str(fold), str(fold)), "lstm") for fold in (0, 1)]
    for job, (n, rmse) in zip(jobs, ((3, 2.0), (1, 4.0)), strict=True):
        job.scores.mkdir(parents=True)
        row = {"average": "samples", "dataset": "all", "group": "all", "seconds": 1.0, "n": n}
        figures = dict.fromkeys(name for name in TABLES["seeds"] if name.endswith(("_m", "_nats", "_accuracy")))
        figures |= {"rmse_m": rmse, "mae_m": rmse, "nll_nats": None}
        pl.DataFrame([row | figures, row | figures | {"group": "findings=error"}]).write_csv(job.scores / SCORES)
    (pooled,) = pool_scores(jobs).to_dicts()
    assert pooled["rmse_m"] == pytest.approx((28 / 4) ** 0.5)
    assert pooled["mae_m"] == pytest.approx(10 / 4)
    assert (pooled["n"], pooled["nll_nats"], pooled["seed"]) == (4, None, None)


def test_the_plan_stays_within_four_hours_and_names_every_arm_once():
    names = [arm.name for piece in PIECES for arm in piece.arms]
    assert len(set(names)) == len(names)
    assert sum(minutes for _, minutes in estimate_pieces(PIECES).values()) < 240
    assert sum(minutes for _, minutes in estimate_pieces(map(make_quick, PIECES)).values()) < 10


def test_models_are_compared_with_those_that_are_scored_in_the_same_arm():
    for arm in (arm for piece in PIECES for arm in piece.arms):
        scored = {*arm.plain, *(own.name for own in arm.learners)}
        assert {name for pair in arm.pairs for name in pair} <= scored, arm.name


def test_every_setting_of_the_plan_is_one_of_its_model_and_every_name_that_of_a_run():
    learners = {own.name: own for piece in PIECES for arm in piece.arms for own in arm.learners}
    for own in learners.values():
        settings = [word for option, word in pairwise(own.options) if option == "--set"]
        assert read_model_settings(find_model(own.model), settings) or not settings, own.name
        run = Job(Lake(TINY, 0, Path("lakes/a"), "digest", {}), own.name, own, 0).run
        assert _check_name(run, own.model) == run


def test_the_plan_is_printed_and_an_unknown_piece_refused(capsys, tmp_path):
    assert main(["--plan"]) == 0
    said = capsys.readouterr().out
    assert all(piece.name in said for piece in PIECES)
    with pytest.raises(SystemExit):
        main(["--only", "nothing"])
    # Without recordings and lakes there is nothing to say, and no page claims otherwise.
    assert main(["--gather", "--work", str(tmp_path), "--docs", str(tmp_path / "docs"), "--data", str(tmp_path)]) == 0
    assert "Not run yet" in (tmp_path / "docs" / "results.md").read_text()
