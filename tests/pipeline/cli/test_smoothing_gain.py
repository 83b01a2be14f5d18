"""Gain from smoothing: none where histories are equal, the futures' share where they cheat, on the same futures."""

import json
import math
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from tensor_tables import CLOCK, TINY, split_row, write

from tracklake.pipeline.cli.smoothing_gain import (
    GainInputs,
    describe_causality,
    measure_gain,
    open_histories,
    replace_histories,
)
from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.motion import ConstantVelocity
from tracklake.training.runs.forecasters import Forecaster

PAST = [(-4.0, -1.0), (-2.0, -0.5), (0.0, 0.0)]
MODEL = Forecaster("constant-velocity", ConstantVelocity(TINY), "grid")


@pytest.fixture
def folder(tmp_path):
    """Two samples at 2 Hz at (0, 0); constant velocity says (4, 1) after 1 s: one is at (7, 5) then, one is there."""
    tracks = {1: [*PAST, (3.5, 2.5), (7.0, 5.0)], 2: [*PAST, (2.0, 0.5), (4.0, 1.0)]}
    rows = [(v, t, 1 + 5 * t, x, y, 1, 0.0, v) for v, points in tracks.items() for t, (x, y) in enumerate(points)]
    samples = [("tiny", "highd", "b", vehicle, 2, 11, 1, "keep", "normal", None) for vehicle in tracks]
    clock, chosen = (
        pl.DataFrame(rows, schema=CLOCK, orient="row"),
        pl.DataFrame(samples, schema=SAMPLES.dtypes, orient="row"),
    )
    empty = ("a", pl.DataFrame(schema=CLOCK), SAMPLES.empty(), NEIGHBORS.empty())
    splits = pl.concat([split_row("a", "train"), split_row("b", "eval")])
    return TensorFolder.open(write(tmp_path / "tensors", [empty, ("b", clock, chosen, NEIGHBORS.empty())], splits))


def move(folder, change):
    """The folder with other positions: `change` alters an array (10, 2), five rows of each vehicle."""
    positions = folder.position_m.copy()
    change(positions)
    return replace(folder, arrays={**folder.arrays, "position_m": positions})


def after_one_second(folder, **histories):
    found = measure_gain([MODEL], GainInputs(folder, {"filtered": folder, **histories}, "eval", 10))
    return {row["histories"]: row for row in found.filter(seconds=1.0).rows(named=True)}


def test_equal_histories_gain_nothing(folder):
    found = after_one_second(folder, recorded=folder, reconstructed=replace(folder))
    for kind, row in found.items():
        assert (row["n"], row["rmse_m"]) == (2, pytest.approx(math.sqrt((3**2 + 4**2) / 2)))
        gain = None if kind == "filtered" else 0.0
        assert [row[name] for name in ("gain_m", "gain_low_m", "gain_high_m")] == [gain] * 3


def test_a_history_that_knows_the_future_gains(folder):
    """Vehicle 1's position before the last one is where its true next step would have come from: no error is left."""

    def cheat(positions):
        positions[1] = (-3.5, -2.5)

    row = after_one_second(folder, reconstructed=move(folder, cheat))["reconstructed"]
    assert row["rmse_m"] == pytest.approx(0.0, abs=1e-6)
    assert row["gain_m"] == pytest.approx(math.sqrt(25 / 2))
    assert 0.0 <= row["gain_low_m"] <= row["gain_m"] <= row["gain_high_m"] == pytest.approx(5.0)


def test_errors_of_the_last_position_count_and_futures_stay(folder):
    """All positions 1 m ahead: predictions are at (5, 1) on the road, the futures at (7, 5) and (4, 1) as before."""

    def ahead(positions):
        positions[:, 0] += 1.0

    row = after_one_second(folder, recorded=move(folder, ahead))["recorded"]
    assert row["rmse_m"] == pytest.approx(math.sqrt((2**2 + 4**2 + 1) / 2))


def test_positions_of_other_tracks_stand_at_their_vehicles_and_ticks(lake):
    """Filtered positions of the sample's lake against a loop over rows; recorded ones are the tensors' own."""
    settings = Settings(lake=lake.root)
    manifest = load(lake.root)
    reader = LakeReader(lake.root, manifest)
    folder = TensorFolder.open(tensor_folder(lake.root, manifest, settings))
    same, lacking = replace_histories(reader, folder, "recorded", "eval")
    assert lacking == 0
    assert np.array_equal(same.position_m, folder.position_m)
    filtered, _ = replace_histories(reader, folder, "filtered", "eval")
    names = [f"{own['dataset']}/{own['subset']}" for own in folder.index["subsets"]]
    number = names.index(min(folder.subsets_of("eval")))
    subset = reader.open_subset(*names[number].split("/"))
    tracks = subset.read_tracks_from("filtered", "vehicle_id", "frame", "x_m", "y_m")
    at = {(vehicle, frame): (x, y) for vehicle, frame, x, y in tracks.iter_rows()}
    ratio = subset.facts["frame_rate_hz"] / folder.protocol.rate_hz
    for run in np.flatnonzero(folder.run_subset == number):
        for row in range(folder.run_first_row[run], folder.run_first_row[run + 1], 5):
            tick = int(folder.run_first_tick[run]) + row - int(folder.run_first_row[run])
            expected = at[int(folder.run_vehicle_id[run]), subset.facts["first_frame"] + round(tick * ratio)]
            assert filtered.position_m[row] == pytest.approx(expected, abs=1e-3)
    other = np.isin(folder.run_subset, [names.index(own) for own in {*names} - folder.subsets_of("eval")])
    kept = np.repeat(other, np.diff(folder.run_first_row))
    assert np.array_equal(filtered.position_m[kept], folder.position_m[kept])
    assert (filtered.position_m != folder.position_m).any()


def test_evaluate_shows_the_same_models_with_all_histories(command, lake, tmp_path):
    arguments = ("evaluate", "constant-velocity", "--lake", lake.root, "--out", tmp_path / "scores.csv")
    plain = command.here(*arguments)
    assert describe_causality("recorded") in plain.out
    assert "gain from smoothing" not in plain.out
    shown = command.here(*arguments, "--gain")
    assert shown.code == 0, shown.err
    assert "RMSE, m, by the tracks of the histories; futures: recorded tracks" in shown.out
    assert "gain from smoothing: RMSE with filtered histories" in shown.out
    answer = json.loads(command.here(*arguments, "--gain", "--json").out)
    by_kind = {}
    for row in answer["smoothing_gain"]:
        by_kind.setdefault(row["histories"], []).append(row)
    assert list(by_kind) == ["recorded", "filtered", "reconstructed"]
    horizons = answer["evaluations"][0]["horizons"]
    for kind, rows in by_kind.items():
        assert [(row["seconds"], row["n"]) for row in rows] == [(own["seconds"], own["n"]) for own in horizons]
        if kind == "recorded":
            assert [row["rmse_m"] for row in rows] == pytest.approx([own["rmse_m"] for own in horizons], rel=1e-6)
    assert "not causal" in describe_causality("reconstructed")


def test_without_reconstructed_tracks_a_note_says_so(lake):
    """A setting of the reconstruction that the lake was not made with counts as none."""
    settings = Settings(lake=lake.root, reconstruct_noise_m=0.123)
    folder = TensorFolder.open(tensor_folder(lake.root, load(lake.root), settings))
    inputs = open_histories(settings, LakeReader(lake.root, load(lake.root)), folder, "eval", 10)
    assert list(inputs.histories) == ["recorded", "filtered"]
    assert "no reconstructed histories: reconstruct" in inputs.notes[-1]
