"""Formats that are generated without defects: read back, they hold what was simulated."""

import polars as pl
import pytest
from lake_sources import SAMPLE
from levelx_files import read
from raw_texts import check_accounts, raw_file
from simulated import simulate_once

from tracklake.pipeline.sources.i24 import I24
from tracklake.pipeline.sources.source import Part
from tracklake.pipeline.sources.tgsim import TGSIM
from tracklake.pipeline.synthetic import write_sample

FORMATS = ("exid", "ind", "round", "tgsim", "i24")


@pytest.fixture(scope="module")
def written(sample, tmp_path_factory):
    del sample  # whose worker has these simulations, too
    out = tmp_path_factory.mktemp("levelx") / "raw"
    minutes, seed = SAMPLE[1::2]
    with simulate_once():
        write_sample(out, formats=FORMATS, minutes=float(minutes), seed=int(seed))
    return out


@pytest.fixture(scope="module")
def truth(written):
    return pl.read_parquet(written / "truth.parquet")


@pytest.mark.parametrize(
    ("name", "recording", "lanes"), [("exid", "00", 3), ("ind", "07", None), ("round", "12", None)]
)
def test_generated_files_of_levelx_are_recognised_as_such_and_hold_what_was_simulated(
    written, truth, name, recording, lanes
):
    folder = written / name
    paths = [*sorted(folder.glob(f"data/{recording}_*.csv")), *folder.rglob("*.osm")]
    dataset, made = read(paths)
    assert dataset == name
    assert {subset.facts["origin"][0] for subset in made.subsets} == {"synthetic"}
    check_accounts(made, entries_from=[f"{recording}_tracks.csv"])
    simulated = truth.filter(kind="first_frame", dataset=name, recording=recording).sort("vehicle_id")
    vehicles = pl.concat([subset.vehicles for subset in made.subsets]).sort("source_vehicle_id")
    assert vehicles.select("source_vehicle_id", "entries").rows() == simulated.select("vehicle_id", "entries").rows()
    for subset in made.subsets:
        own = simulated.join(subset.vehicles, on="vehicle_id", how="semi")
        # Both count along the road: the one from the window's entrance, the other from the hindmost entry, on an axis
        # that is some hundredths longer or shorter.
        apart = subset.vehicles["start_x_m"] - own["value"]
        assert apart.max() - apart.min() < 0.04 * subset.tracks["x_m"].max() + 0.5
        # Vehicles follow the road, whatever its bends.
        assert subset.tracks["heading_rad"].abs().quantile(0.9) < 0.1
        assert subset.facts["lanes"][0] == lanes
        if lanes is not None:
            assert (subset.tracks["gap_m"] - subset.tracks["headway_recorded_m"]).abs().median() < 0.5


def test_generated_tgsim_files_are_recognised_as_such_and_hold_what_was_simulated(written, truth, tmp_path):
    out = written
    recordings = {}
    for name in ("I395_final.csv", "TGSIM_I-294_L1_Trajectories.csv"):
        file = raw_file(out / name, TGSIM)
        spilled = TGSIM.spill(file, tmp_path / name)
        assert spilled.rejects.is_empty()
        for recording in spilled.recordings:
            parts = [Part(file, pl.scan_ipc(tmp_path / name / recording / "*.arrow"))]
            recordings[recording] = TGSIM.to_canonical(parts, recording)
    assert {made.subsets[0].facts["origin"][0] for made in recordings.values()} == {"synthetic"}
    for (subset,) in (made.subsets for made in recordings.values()):
        simulated = truth.filter(kind="first_frame", subset=subset.name).sort("vehicle_id")
        assert (
            subset.vehicles.select("vehicle_id", "entries").rows() == simulated.select("vehicle_id", "entries").rows()
        )
        # Positions have noise; they count from the hindmost entry, near the window's entrance.
        assert (subset.vehicles["start_x_m"] - simulated["value"]).abs().max() < 2.5
        assert subset.vehicles.filter("automated")["vehicle_id"].to_list() == [
            vehicle for vehicle in simulated["vehicle_id"] if vehicle % 10 == 0
        ]


def test_the_generated_list_of_i24_is_recognised_as_such_and_holds_what_was_simulated(written, truth, tmp_path):
    file = raw_file(written / "i24-inception.json", I24)
    spilled = I24.spill(file, tmp_path)
    assert spilled.rejects.is_empty()
    (recording,) = spilled.recordings
    made = I24.to_canonical(
        [Part(file, pl.scan_ipc(tmp_path / recording / "*.arrow"), totals=spilled.totals)], recording
    )
    assert made.subsets[0].facts["origin"][0] == "synthetic"
    for subset, miles in zip(made.subsets, (59 - 58, 64 - 62), strict=True):
        simulated = truth.filter(kind="first_frame", subset=subset.name).sort("vehicle_id")
        assert subset.vehicles.height == simulated.height
        # Of four trajectories three lie between frames, so that the first position is up to a frame later.
        found = subset.vehicles["start_x_m"] - miles * 1609.344
        assert (found - simulated["value"]).abs().max() < 2
        assert (subset.vehicles["entries"] - simulated["entries"]).unique().sort().to_list() in ([-1, 0], [0])
        assert subset.facts["lanes"][0] == 4


def test_the_same_seed_gives_the_same_bytes(written, tmp_path):
    minutes, seed = SAMPLE[1::2]
    with simulate_once():
        write_sample(tmp_path / "again", formats=("exid",), minutes=float(minutes), seed=int(seed))
    files = [path for path in (tmp_path / "again" / "exid").rglob("*") if path.is_file()]
    assert len(files) == 7
    for path in files:
        assert path.read_bytes() == (written / path.relative_to(tmp_path / "again")).read_bytes()
