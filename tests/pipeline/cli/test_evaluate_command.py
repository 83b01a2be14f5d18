"""`tracklake evaluate` as a user sees it: the table it writes, what it shows, and what it calls a misuse."""

import itertools
import json
import math
import re
from io import StringIO
from unittest import mock

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.evidence import _format_difference
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.comparisons import COMPARISON_TABLES, VEHICLE_ERRORS
from tracklake.schemas.evaluations import EVALUATIONS
from tracklake.training.models.motion import ConstantVelocity
from tracklake.training.models.prediction import Prediction

EVIDENCE = COMPARISON_TABLES[1:]


@pytest.fixture
def comparable():
    """Makes the commands take the sample's recordings for recorded and complete ones."""
    with mock.patch("tracklake.pipeline.cli.comparability.explain_gap", return_value=None):
        yield


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("scores")


@pytest.fixture(scope="module")
def said(command, lake, out):
    """The baseline, by name: nothing is written into the lake."""
    files = ("--out", out / "table.parquet", "--vehicle-errors", out / "errors.parquet")
    done = command.here("evaluate", "constant-velocity", "--lake", lake.root, *files, "--json")
    assert done.code == 0, done.err
    return json.loads(done.out), pl.read_parquet(out / "table.parquet")


def test_scores_of_synthetic_data_say_so_and_have_no_published_rows(command, lake, said):
    answer, table = said
    assert answer["synthetic"].startswith("Synthetic data: all")
    assert answer["evaluations"][0]["data_origin"] == "synthetic"
    assert table["origin"].unique().to_list() == ["measured"]
    assert table["data_origin"].unique().to_list() == ["synthetic"]
    out = command.here("evaluate", "constant-velocity", "--lake", lake.root).out
    assert out.startswith("Synthetic data: all")
    assert "note: no published figures beside ngsim (us-101-20050615-093000: it is synthetic" in out
    assert "published [" not in out


def test_lane_centres_are_announced_and_errors_along_the_road_shown(command, lake, tmp_path):
    centred = property(lambda folder: np.ones(len(folder.index["subsets"]), dtype=bool))
    with mock.patch("tracklake.training.data.tensor_folder.TensorFolder.lane_centred", centred):
        models = ("constant-velocity", "ctrv", "--compare", "--gain")
        done = command.here("evaluate", *models, "--lake", lake.root, "--dataset", "ngsim")
    assert done.code == 0, done.err
    said = " ".join(done.out.split())
    assert "difference of longitudinal RMSE, m" in said
    assert "no gain from smoothing" in said
    assert "are lane centres: only errors along the road mean anything" in said
    assert "longitudinal RMSE, m" in said
    assert not any(line.startswith("RMSE, m") for line in done.out.splitlines())
    assert "lateral RMSE" not in said
    with mock.patch("tracklake.training.data.tensor_folder.TensorFolder.lane_centred", centred):
        drawn = command.here("predict", "constant-velocity", "--lake", lake.root, "--out", tmp_path / "a.svg")
        forest = command.here("lane-forest", "--lake", lake.root)
    assert re.search(r"off after 5 s along the road: constant-velocity \d+\.\d\d m\n", drawn.out)
    assert "are lane centres: only errors along the road mean anything" in drawn.out
    assert (forest.code, "are lane centres. Lane changes are labelled and predicted by" in forest.err) == (1, True)


@pytest.mark.usefixtures("comparable")
def test_the_table_holds_measured_rows_and_published_ones_marked_as_such(command, lake, tmp_path):
    out = tmp_path / "table.parquet"
    done = command.here("evaluate", "constant-velocity", "--lake", lake.root, "--out", out, "--json")
    answer, table = json.loads(done.out), pl.read_parquet(out)
    assert answer["rows"] == EVALUATIONS.validate(table, where="here").to_dicts()
    measured, published = (table.filter(origin=origin) for origin in ("measured", "published"))
    assert measured["model"].unique().to_list() == ["constant-velocity"]
    assert set(published["dataset"]) == set(measured["dataset"]) - {"all"}, "of data sets that are evaluated"
    (headline,) = answer["evaluations"]
    of_all = measured.filter(dataset="all", group="all", average="samples")
    assert of_all["seconds"].to_list() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert of_all["rmse_m"].to_list() == [row["rmse_m"] for row in headline["horizons"]]
    assert of_all["n"].to_list() == [row["n"] for row in headline["horizons"]]
    assert of_all["latency_ms"].null_count() == 0


def test_groups_and_data_sets_add_up(said):
    measured = said[1].filter(origin="measured", average="samples")
    everything = measured.filter(dataset="all", group="all").sort("seconds")
    for groups in (
        [f"lateral={name}" for name in LATERAL_MANEUVERS],
        ["longitudinal=normal", "longitudinal=brake"],
        ["findings=touched", "findings=untouched"],
        ["findings=error", "findings=no error"],
    ):
        rows = measured.filter(pl.col("group").is_in(groups), dataset="all")
        assert rows.group_by("seconds").agg(pl.col("n").sum()).sort("seconds")["n"].equals(everything["n"])
    by_dataset = measured.filter(pl.col("dataset") != "all", group="all")
    assert by_dataset.group_by("seconds").agg(pl.col("n").sum()).sort("seconds")["n"].equals(everything["n"])
    touched, in_error = (
        measured.filter(dataset="all", group=f"findings={which}")["n"].to_list() for which in ("touched", "error")
    )
    assert min(touched) > 0, "the sample's defects are findings"
    assert all(of_both <= own for own, of_both in zip(touched, in_error, strict=True))


def test_errors_of_vehicles_add_up_to_the_scores(said, out):
    errors = VEHICLE_ERRORS.validate(pl.read_parquet(out / "errors.parquet"), where="here")
    squared = pl.col("squared_longitudinal_m2", "squared_lateral_m2")
    sums = errors.group_by("seconds").agg(pl.col("n").sum(), pl.len(), pl.sum_horizontal(squared.sum()).alias("sum"))
    scores = said[1].filter(dataset="all", group="all", average="samples").sort("seconds")
    sums = sums.sort("seconds").with_columns(rmse_m=(pl.col("sum") / pl.col("n")).sqrt())
    assert sums["n"].equals(scores["n"])
    assert sums["len"].to_list() == scores["vehicles"].to_list()
    assert sums["rmse_m"].to_list() == pytest.approx(scores["rmse_m"].to_list())


def test_calibration_and_feasibility_are_shown_and_written(command, lake, tmp_path):
    call = ("evaluate", "kalman-cv", "constant-velocity", "--lake", lake.root, "--calibration", "--feasibility")
    done = command.here(*call, "--compare", "--evidence", tmp_path / "evidence")
    assert done.code == 0, done.err
    assert "true positions in predicted regions\n" in done.out
    assert "kalman-cv, 90% region" in done.out
    assert "constant-velocity: no density is predicted" in done.out
    assert "at 5 s, by vehicles per km of lane\n" in done.out
    assert "scenes with a prediction that breaks a rule\n" in done.out
    files = {path.name: path for path in (tmp_path / "evidence").iterdir()}
    assert sorted(files) == sorted([*(f"{own.name}.csv" for own in EVIDENCE), "reliability.svg"])
    assert "kalman-cv, 5 s" in files["reliability.svg"].read_text()
    for own in EVIDENCE:
        table = pl.read_csv(files[f"{own.name}.csv"], schema_overrides=own.dtypes)
        assert own.validate(table, where="here").height > 0
    radii = pl.read_csv(files["conformal_radii.csv"]).filter(density="all", level=0.9)
    assert radii["run"].unique().sort().to_list() == ["constant-velocity", "kalman-cv"]
    judged = pl.read_csv(files["feasibility.csv"]).filter(run="constant-velocity", rule="any", seconds=5.0)
    errors = pl.read_csv(files["density_errors.csv"]).filter(run="constant-velocity", density="all", seconds=5.0)
    rmse = math.hypot(errors["rmse_longitudinal_m"][0], errors["rmse_lateral_m"][0])
    assert judged["rmse_m"][0] == pytest.approx(rmse, rel=1e-4)


def list_files(lake):
    """What stands in the lake's folder of evaluations, and when it was written."""
    return {path: path.stat().st_mtime_ns for path in (lake.root / "evaluations").glob("*")}


@pytest.mark.usefixtures("comparable")
def test_what_a_person_reads(command, lake):
    before = list_files(lake)
    call = ("evaluate", "constant-velocity", "--lake", lake.root)
    done = command.here(*call)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert re.match(r"eval of flow-balanced, protocol csp \(\w{12}\): [\d,]+ samples of [\d,]+ vehicles$", lines[1])
    headings = [line.split() for line in lines if "1 s" in line]
    assert headings == [["1", "s", "2", "s", "3", "s", "4", "s", "5", "s"]] * 3, "of all, and of each data set"
    counts = [line.split() for line in lines if line.startswith("n ")]
    assert [len(own) for own in counts] == [6] * 3
    titles = [lines.index(f"RMSE, m{of}") for of in ("", ", highd", ", ngsim")]
    assert titles == sorted(titles)
    pooled, highd, ngsim = (lines[begin:end] for begin, end in itertools.pairwise([*titles, lines.index("at 5 s")]))
    assert not any("published" in line for line in pooled), "nothing was published of both together"
    for name, own, other in (("highd", highd, "ngsim"), ("ngsim", ngsim, "highd")):
        assert any(line.startswith(f"cs-lstm on {name}, published [") for line in own)
        assert not any(f"on {other}, published" in line for line in own)
        assert any(line.startswith("[1] ") for line in own), "where it was published"
    assert list_files(lake) == before, "models that are named are not written into the lake"
    assert "published" not in command.here(*call, "--no-published").out
    more = command.here(*call, "--by", "maneuver", "--by", "findings", "--by", "dataset", "--by", "vehicle").out
    for title in ("lateral=left", "longitudinal=brake", "findings=touched", "highd", "every vehicle counting the same"):
        assert more.count(f"RMSE, m, {title}\n") == 1
    assert "findings=error: the vehicle's own findings of severity error or worse" in more


def test_every_tick_is_in_the_table_and_the_scored_seconds_on_the_terminal(command, lake, tmp_path):
    out = tmp_path / "made" / "on the way" / "ticks.csv"
    call = ("evaluate", "constant-velocity", "constant-velocity", "--lake", lake.root, "--out", out, "--every-tick")
    done = command.here(*call, "--no-published", COLUMNS="80")
    assert done.code == 0, done.err
    of_all = pl.read_csv(out).filter(dataset="all", group="all", average="samples")
    assert of_all["seconds"].to_list() == [tick / 5 for tick in range(1, 26)], "once, though it was named twice"
    assert of_all["n"].is_sorted(descending=True)
    headings = [line.split() for line in done.out.splitlines() if "1 s" in line]
    assert headings == [["1", "s", "2", "s", "3", "s", "4", "s", "5", "s"]] * 3
    assert "…" not in done.out


@pytest.mark.parametrize("width", [80, 200])
def test_names_and_figures_are_never_cut_off(width):
    terminal = Terminal()
    terminal.out = out = Console(width=width, file=StringIO(), soft_wrap=True)
    figures = [f"{number}.25" for number in range(10, 18)]
    names = ["cs-lstm-of-the-first-try", "cs-lstm-of-the-second-try"]
    headings = ["longitudinal RMSE, m", "lateral RMSE, m", *["ADE, m"] * 4, "lateral %", "ms a moment"]
    print_table(terminal, ["", *headings], [[name, *figures] for name in names], title="at 5 s", fold=True)
    printed = out.file.getvalue()
    assert max(map(len, printed.splitlines())) <= width
    first = printed[printed.index("cs-lstm") :].splitlines()
    figures_at = [number for number, line in enumerate(first) if "10.25" in line]
    assert [first[number].split()[-8:] for number in figures_at] == [figures] * 2
    column = first[0].index("10.25")
    shown = "".join(line[:column].strip() for line in first)
    assert shown == "".join(names)


def test_labels_of_traffic_densities_are_not_broken_and_bounds_keep_their_signs(command, lake, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    out = command.here("evaluate", "constant-velocity", "--calibration", "--lake", lake.root).out
    table = out[out.index("by vehicles per km of lane") :].splitlines()
    assert any(re.search(r"\b\d+ to \d+\b", line) for line in table)
    assert not any(re.search(r"\bto$|^\d+$", line.strip()) for line in table)
    shown = [_format_difference(value) for value in (-0.0004, -0.000012, 0.0, -0.0, 0.0005, 1.23456, -1e-9)]
    assert shown == ["-0.0004", "-0.00001", "0.000", "0.000", "0.001", "1.235", "0.000"]
    assert format_number(-0.001) == "0.00"


@pytest.mark.parametrize("option", ["--nearest=2", "--no-published", "--every-tick", "--part=train"])
def test_what_the_options_change_is_not_written_into_the_lake(command, lake, option):
    before = list_files(lake)
    done = command.here("evaluate", option, "--lake", lake.root)
    assert done.code == 0, done.err
    assert "note: the lake keeps the table of the options' defaults; --out writes this one" in done.out
    assert list_files(lake) == before


def test_what_is_not_there_is_named_with_what_is(command, lake):
    unknown = command.here("evaluate", "unknown", "--lake", lake.root)
    assert unknown.code == 2
    assert "no run or model `unknown`: expected one of the runs constant-velocity" in unknown.err
    misspelt = command.here("evaluate", "Kalman_cv", "--lake", lake.root)
    assert (misspelt.code, "no run or model `Kalman_cv` (did you mean kalman-cv?)" in misspelt.err) == (2, True)
    other = command.here("evaluate", "constant-velocity", "--lake", lake.root, "--protocol", "grid-2021")
    assert other.code == 1
    reported = r"another protocol than grid-2021 \(\w{12}\) as it is set now: by csp \(\w{12}\)\. Run `tracklake run`"
    assert re.search(reported, other.err)


def test_a_model_that_asks_for_the_future_is_not_scored(command, lake, monkeypatch):
    monkeypatch.setattr(ConstantVelocity, "predict", lambda _, observed: Prediction(observed.future))
    done = command.here("evaluate", "constant-velocity", "--lake", lake.root)
    assert done.code == 1
    assert "`future` is not known when a model predicts" in done.err
    assert done.out == ""


def test_a_part_without_samples_and_misuses(command, lake, tmp_path):
    empty = command.here("evaluate", "constant-velocity", "--part", "val", "--lake", lake.root)
    assert empty.code == 1
    assert "has no samples in `val`" in empty.err
    for misuse in (
        ("--out", tmp_path / "table.txt"),
        ("--vehicle-errors", "errors.csv"),
        ("--by", "weather"),
        ("--nearest", "-1"),
    ):
        assert command.here("evaluate", *misuse, "--lake", lake.root).code == 2, misuse
    (tmp_path / "file").touch()
    (tmp_path / "folder.csv").mkdir()
    calibration = ("--calibration", "--evidence", tmp_path / "file")
    for misuse, code, reported in (
        (calibration, 2, f"--evidence names a folder, and {tmp_path / 'file'} is a file; name another place"),
        (("--out", tmp_path / "folder.csv"), 2, f"--out names a file, and {tmp_path / 'folder.csv'} is a folder"),
        ((*calibration[:-1], tmp_path / "file" / "in"), 1, "Not a directory. Name another place"),
    ):
        done = command.here("evaluate", "constant-velocity", *misuse, "--lake", lake.root)
        assert (done.code, reported in " ".join(done.err.replace("│", " ").split())) == (code, True), done.err
