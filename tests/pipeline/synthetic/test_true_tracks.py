"""True tracks of the sample: by hand, and against what ingestion reads from files without noise."""

from pathlib import Path
from unittest import mock

import numpy as np
import polars as pl
import pytest
from lake_sources import SAMPLE
from raw_texts import read_highd, read_ngsim
from simulated import simulate_once

from tracklake.pipeline.synthetic import build, write_sample
from tracklake.pipeline.synthetic.true_tracks import TRUE_TRACKS_SCHEMA, build_true_tracks

PLACE = ["dataset", "recording", "subset"]


def drive(speeds, lateral=0.0, vehicle=1, length=4.0):
    """A vehicle as SUMO moves it at 10 Hz: each step with the speed reached at its end."""
    speeds = np.array(speeds, float)
    rows = len(speeds)
    return pl.DataFrame(
        {
            "vehicle": pl.Series([vehicle] * rows, dtype=pl.Int32),
            "frame": pl.Series(range(1, rows + 1), dtype=pl.Int32),
            "x": 10 + np.cumsum(speeds) / 10,
            "y": 5 + np.arange(rows) * lateral / 10,
            "speed": speeds,
            "accel": np.diff(speeds, prepend=speeds[0]) * 10,
            "lateral_speed": np.full(rows, lateral),
            "lane": pl.Series([2] * rows, dtype=pl.Int16),
            "length": np.full(rows, length),
        }
    )


def test_speeds_and_accelerations_are_rates_of_change_of_the_positions():
    true = build_true_tracks(drive([20, 20.1, 20.3, 20.6]), 10.0, start_m=2.0, pointed=False)
    assert true["x_m"].to_list() == pytest.approx([10, 12.01, 14.04, 16.1])
    # (12.01 - 10) / 0.1 before and (14.04 - 12.01) / 0.1 after, and so on; at the end that of the last step.
    assert true["speed_mps"].to_list() == pytest.approx([20.05, 20.2, 20.45, 20.6])
    assert true["accel_mps2"].to_list() == pytest.approx([1, 2, 3, 3])
    assert true["lateral_speed_mps"].to_list() == [0] * 4


def test_the_front_lies_where_the_vehicle_points():
    moving, turned = drive([4.0] * 3, lateral=3.0), drive([1.0] * 3, lateral=0.75, vehicle=2)
    both = build_true_tracks(pl.concat([moving, turned]), 10.0, pointed=True)
    first = both.row(0, named=True)
    # 3 : 4 : 5, half a length of 2 m: 0.4 m are lost along the road, 1.2 m won to the right.
    assert (first["x_m"], first["y_m"]) == pytest.approx((10.4 - 0.4, 5 + 1.2))
    assert first["lateral_speed_mps"] == pytest.approx(3.0)
    slow = both.filter(vehicle_id=2)
    assert slow["y_m"].to_list() == pytest.approx([5, 5.075, 5.15]), "below 2 m/s it points as before: straight"


@pytest.mark.parametrize("rows", [1, 2])
def test_shortest_tracks(rows):
    true = build_true_tracks(drive([3.0] * rows), 10.0, pointed=True)
    assert true.height == rows
    assert true.null_count().sum_horizontal().item() == 0


@pytest.fixture(scope="module")
def exact(sample, tmp_path_factory) -> Path:
    """The session's sample without noise; its defects remain. What rules find is not counted."""
    del sample
    out = tmp_path_factory.mktemp("exact") / "raw"
    minutes, seed = float(SAMPLE[1]), int(SAMPLE[3])
    with simulate_once(), mock.patch("tracklake.pipeline.synthetic.truth.count_rules", return_value={}):
        write_sample(out, formats=("highd", "ngsim-text"), minutes=minutes, seed=seed, noise=())
    return out


def test_ingested_tracks_equal_the_truth_within_the_files_rounding(exact, tmp_path):
    true, truth = (pl.read_parquet(exact / name) for name in (build.TRUE_TRACKS_FILE, build.TRUTH_FILE))
    assert true.schema == pl.Schema(TRUE_TRACKS_SCHEMA)
    assert true.equals(true.sort("dataset", "subset", "vehicle_id", "frame"))
    suffixes = ("recordingMeta", "tracksMeta", "tracks")
    found = [read_highd([exact / f"{name}_{suffix}.csv" for suffix in suffixes], name) for name in ("01", "02", "03")]
    ngsim, _ = read_ngsim(tmp_path, exact / "trajectories-us-101-0930.txt")
    damaged = truth.filter(pl.col("vehicle_id").is_not_null(), kind="defect").select("subset", "vehicle_id", "name")
    for subset in [each for made in (*found, *ngsim.values()) for each in made.subsets]:
        own = true.filter(subset=subset.name)
        sound = subset.tracks.filter(
            ~pl.col("vehicle_id").is_in(damaged.filter(subset=subset.name)["vehicle_id"].implode())
        )
        both = sound.join(own, on=["vehicle_id", "frame"], suffix="_true", how="left")
        # Millimetres are 0.01 m in highD's files, 0.001 ft in NGSIM's; a rounded heading turns a lorry's front aside.
        fine = subset.name.startswith("us-101")
        for name, within in (("x_m", 3e-4 if fine else 0.006), ("y_m", 3e-4 if fine else 0.03)):
            assert (both[name] - both[f"{name}_true"]).abs().max() < within, (subset.name, name)
        assert (both["lane"] == both["lane_true"]).all()
        unknown = damaged.filter(~pl.col("vehicle_id").is_in(own["vehicle_id"].implode()), subset=subset.name)
        assert set(unknown["name"]) <= {"second_track"}, "a second id is no vehicle"
        # Recorded entries, lost ones and those before a late start: the true track has no hole.
        assert own.select((pl.col("frame").diff().over("vehicle_id") != 1).sum()).item() == 0


def test_noise_changes_files_but_no_truth(exact, tmp_path):
    minutes, seed = float(SAMPLE[1]), int(SAMPLE[3])
    with simulate_once():
        noise = ("quantised", "autocorrelated", "handover")
        made = write_sample(tmp_path / "raw", formats=("ngsim-text",), minutes=minutes, seed=seed, noise=noise)
    name = "trajectories-us-101-0930.txt"
    assert (tmp_path / "raw" / name).read_bytes() != (exact / name).read_bytes()
    true = [
        pl.read_parquet(folder / build.TRUE_TRACKS_FILE).filter(dataset="ngsim")
        for folder in (exact, made.files[0].parent)
    ]
    assert true[0].equals(true[1])
    assert "autocorrelated and handover and quantised noise" in (tmp_path / "raw" / build.README_FILE).read_text()
