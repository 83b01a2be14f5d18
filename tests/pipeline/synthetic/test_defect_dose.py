"""One defect by dose: the same traffic at every dose, clean at 0, nested, and the dose that was reached."""

import pickle
import re

import numpy as np
import polars as pl
import pytest
from lake_sources import SAMPLE
from raw_texts import read_highd
from simulated import simulate_once
from study.defects import UNSEEN
from test_sample_defects import damage

from tracklake.pipeline.synthetic import DOSED, write_sample
from tracklake.pipeline.synthetic.scenarios import CLEAN, Dose, plan_dose
from tracklake.schemas.errors import UsageError

NAME = "trajectories-us-101-1015.csv"


@pytest.mark.parametrize("name", DOSED)
def test_a_dose_is_the_only_defect_and_a_larger_one_holds_a_smaller_one(name):
    found = {}
    for share in (0.0, 0.05, 0.2):
        _, done = damage(plan_dose(Dose(name, share), 40))
        assert {each.name for each in done.defects} <= {name}
        found[share] = {pickle.dumps(each) for each in done.defects}
        assert len({each.vehicle for each in done.defects}) <= round(share * 40)
    assert not found[0.0]
    assert found[0.05] <= found[0.2]


def test_what_is_planned_is_a_share_of_the_vehicles():
    assert plan_dose(Dose("frame_gap", 0.05), 39).gaps == 2
    assert plan_dose(Dose("frame_gap", 0.0), 39) == CLEAN
    shares = [plan_dose(Dose("backward", count / 58), 58).backward_share for count in range(59)]
    assert [int(share * 58) for share in shares] == list(range(59))
    assert plan_dose(Dose("backward", 0.5), 0).backward_share == 0.5


def write(out, dose, defect="frame_gap"):
    with simulate_once():
        minutes, seed = float(SAMPLE[1]), int(SAMPLE[3])
        return write_sample(out, formats=("ngsim-csv",), minutes=minutes, seed=seed, defect=defect, dose=dose)


def test_samples_differ_by_the_dose_alone_and_say_what_was_reached(tmp_path):
    clean, dosed = write(tmp_path / "clean", 0.0), write(tmp_path / "dosed", 0.2)
    assert write(tmp_path / "other", 0.0, "position_jump").dose == clean.dose == 0
    lines = {name: (tmp_path / name / NAME).read_bytes().splitlines() for name in ("clean", "dosed", "other")}
    assert lines["clean"] == lines["other"]
    truth = pl.read_parquet(tmp_path / "dosed" / "truth.parquet")
    gaps, vehicles = truth.filter(kind="defect"), truth.filter(kind="first_frame").height
    assert set(gaps["name"]) == {"frame_gap"}
    assert len(lines["clean"]) - len(lines["dosed"]) == gaps["entries"].sum() > 0
    reached = truth.filter(kind="dose").row(0, named=True)
    assert (reached["name"], reached["vehicles"]) == ("frame_gap", gaps["vehicle_id"].n_unique())
    assert reached["entries"] == gaps["entries"].sum()
    assert dosed.dose == reached["value"] == pytest.approx(round(0.2 * vehicles) / vehicles)
    rows = pl.read_parquet(tmp_path / "clean" / "truth.parquet").filter(kind="rows", name="malformed")
    assert rows["entries"].sum() == 0
    assert "only frame_gap, of 0.2 of the vehicles" in (tmp_path / "dosed" / "README.md").read_text()


def read_positions(out, **defect):
    """What networks without neighbors learn from: positions by vehicle and frame."""
    with simulate_once():
        made = write_sample(out, formats=("highd",), minutes=float(SAMPLE[1]), seed=int(SAMPLE[3]), **defect)
    found = {}
    for number in ("01", "02", "03"):
        files = [out / f"{number}_{kind}.csv" for kind in ("recordingMeta", "tracksMeta", "tracks")]
        for subset in read_highd(files, number).subsets:
            tracks = subset.tracks.select("vehicle_id", "frame", "x_m", "y_m")
            found[subset.name] = tracks.sort("vehicle_id", "frame")
    return made.dose, found


@pytest.mark.thorough
def test_networks_are_not_given_what_these_defects_change(tmp_path):
    """The study says so of them, and trains on others: a wrong speed turns a vehicle and moves its front."""
    _, clean = read_positions(tmp_path / "clean", defect="frame_gap", dose=0.0)
    same = set()
    for name in DOSED:
        reached, dosed = read_positions(tmp_path / name, defect=name, dose=1.0)
        assert reached > 0.1, name
        if all(dosed[subset].equals(tracks) for subset, tracks in clean.items()):
            same.add(name)
    assert same == set(UNSEEN)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"defect": "frame_gap"}, "belong together"),
        ({"dose": 0.1}, "belong together"),
        ({"defect": "gap", "dose": 0.1}, "got gap"),
        ({"defect": "frame_gap", "dose": 1.5}, "from 0 to 1, got 1.5"),
        ({"defect": "frame_gap", "dose": np.nan}, "got nan"),
        ({"defect": "size_change", "dose": 0.1}, "cannot be recorded in ngsim-csv; choose --format highd"),
        ({"defect": "frame_gap", "dose": 0.1, "formats": ("drives",)}, "add --format highd"),
        ({"defect": "frame_gap", "dose": 0.1, "formats": ("highd", "tgsim")}, "tgsim: generated without defects"),
    ],
)
def test_wrong_doses_are_refused(tmp_path, given, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        write_sample(tmp_path / "out", **{"formats": ("ngsim-csv",)} | given)
    assert not list(tmp_path.iterdir())
