"""`tracklake evaluate` as a user sees it: the table it writes, what it shows, and what it calls a misuse."""

import json
import re

import polars as pl
import pytest

from schemas.columns import LATERAL_MANEUVERS
from schemas.evaluations import EVALUATIONS
from training.models.constant_velocity import ConstantVelocity
from training.prediction import Prediction


@pytest.fixture(scope="module")
def said(command, lake, tmp_path_factory):
    """The baseline, by name: nothing is written into the lake."""
    out = tmp_path_factory.mktemp("scores") / "table.parquet"
    done = command.here("evaluate", "constant-velocity", "--lake", lake.root, "--out", out, "--json")
    assert done.code == 0, done.err
    return json.loads(done.out), pl.read_parquet(out)


def test_the_table_holds_measured_rows_and_published_ones_marked_as_such(said):
    answer, table = said
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
    ):
        rows = measured.filter(pl.col("group").is_in(groups), dataset="all")
        assert rows.group_by("seconds").agg(pl.col("n").sum()).sort("seconds")["n"].equals(everything["n"])
    by_dataset = measured.filter(pl.col("dataset") != "all", group="all")
    assert by_dataset.group_by("seconds").agg(pl.col("n").sum()).sort("seconds")["n"].equals(everything["n"])
    touched = measured.filter(dataset="all", group="findings=touched")["n"].to_list()
    assert min(touched) > 0, "the sample's defects are findings"


def test_what_a_person_reads(command, lake):
    call = ("evaluate", "constant-velocity", "--lake", lake.root)
    done = command.here(*call)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert re.match(r"eval of flow-balanced, protocol csp \(\w{12}\): [\d,]+ samples of [\d,]+ vehicles$", lines[0])
    (heading,) = (line for line in lines if "1 s" in line)
    assert heading.split() == ["1", "s", "2", "s", "3", "s", "4", "s", "5", "s"]
    (counts,) = (line.split() for line in lines if line.startswith("n "))
    assert len(counts) == 6
    published = [line for line in lines if "published [" in line]
    assert any("cs-lstm on highd" in line for line in published)
    assert any(line.startswith("[1] ") for line in lines), "where it was published"
    assert not (lake.root / "evaluations" / "constant-velocity.csv").exists()
    assert "published" not in command.here(*call, "--no-published").out
    more = command.here(*call, "--by", "maneuver", "--by", "findings", "--by", "dataset", "--by", "vehicle").out
    for title in ("lateral=left", "longitudinal=brake", "findings=touched", "highd", "every vehicle counting the same"):
        assert f"RMSE, m, {title}" in more
    assert "severity warning or worse" in more


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
    for misuse in (("--out", tmp_path / "table.txt"), ("--by", "weather"), ("--nearest", "-1")):
        assert command.here("evaluate", *misuse, "--lake", lake.root).code == 2, misuse
