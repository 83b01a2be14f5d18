"""`tracklake export csp` from raw text to what the project's own Dataset class reads."""

import json

import numpy as np
import polars as pl
import pytest
from csp_script import PARTS, ScriptDataset, run_script
from export_lakes import KEYS, ingest, run_stages
from scipy.io import loadmat

from tracklake.pipeline.export.csp import export as csp
from tracklake.pipeline.export.csp.card import CARD
from tracklake.pipeline.export.csp.export import FILES, export_csp
from tracklake.pipeline.export.csp.result import CspOptions
from tracklake.pipeline.export.folder import ExportError
from tracklake.pipeline.lake import LakeError, LakeMissingError, load, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import StageError
from tracklake.schemas import SAMPLES, VEHICLES
from tracklake.schemas.errors import FileAccessError

NEEDED_BY_CLEAN = ("validate", "repair", "samples", "split")


def make_rows(seed, vehicles=14):
    """Vehicles one after the other on lanes 4 to 8 or 1 to 5, at places with three decimals, each seen for 20 to 90."""
    random = np.random.default_rng(seed)
    rows = []
    for place in range(vehicles):
        lanes, length = random.integers(1, 9, 2), int(random.choice([20, 31, 34, 60, 90]))
        y, first = random.uniform(0, 120), int(random.integers(1, 30))
        steps = random.choice([0.0, 2.5, 5.0]) + random.normal(0, 0.4, length)
        for row in range(length):
            y += steps[row]
            lane = int(lanes[0] if row < length // 2 else lanes[1])
            rows.append(
                (3 * place + 1, first + row, f"{5 * place + random.uniform(0, 0.5):.3f}", f"{max(y, 0):.3f}", lane)
            )
    return rows


RAW = {name: make_rows(seed) for seed, name in enumerate(KEYS)}


@pytest.fixture(scope="module")
def ngsim(tmp_path_factory):
    """A lake of the six recordings."""
    return ingest(tmp_path_factory.mktemp("lakes") / "ngsim", tmp_path_factory.mktemp("raw"), RAW)


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A lake with NGSIM and two highD recordings, all stages run."""
    lake = ingest(tmp_path_factory.mktemp("lakes") / "both", tmp_path_factory.mktemp("raw"), RAW, highd=("01", "02"))
    run_stages(Settings(lake=lake), *NEEDED_BY_CLEAN)
    return lake


def read(out):
    return {part: loadmat(out / name) for part, name in zip(PARTS, FILES, strict=True)}


def test_the_files_are_those_of_the_script_on_the_raw_text(ngsim, tmp_path):
    export = export_csp(Settings(lake=ngsim), tmp_path / "out", CspOptions())
    as_read = {
        number: sorted((v, f, float(x), float(y), lane) for v, f, x, y, lane in RAW[name])
        for number, name in enumerate(KEYS, start=1)
    }
    expected, stopped_on = run_script(as_read, folded=(1, 2, 3))
    assert stopped_on > 0
    for file, (part, contents) in zip(export.files, read(tmp_path / "out").items(), strict=True):
        samples, tracks = expected[part]
        assert len(samples) > 100
        assert contents["traj"].dtype == np.float32
        np.testing.assert_array_equal(contents["traj"], np.array(samples))
        assert contents["tracks"].shape == tuple(map(max, zip(*tracks, strict=True)))
        for place in np.ndindex(contents["tracks"].shape):
            track = tracks.get((place[0] + 1, place[1] + 1))
            if track is None:
                assert contents["tracks"][place].size == 0
            else:
                np.testing.assert_array_equal(contents["tracks"][place], track)
        assert (file.samples, file.tracks) == (len(samples), len(tracks))
        assert file.samples + sum(file.dropped.values()) == file.entries == sum(t.shape[1] for t in tracks.values())
    assert export.overwritten > 0
    assert [facts["subset"] for facts in export.datasets] == list(KEYS)


def sort_rows(rows, order):
    if order == "frame":
        return sorted(rows, key=lambda row: (row[1], row[0]))
    return rows[::-1] if order == "other" else rows


@pytest.mark.parametrize("order", ["vehicle", "frame", "other"])
def test_samples_keep_the_order_of_the_files_rows(tmp_path, order):
    """The second of two data sets has no vehicle in validation, so `tracks` of ValSet has one row."""
    rows = sort_rows(make_rows(0), order)
    alone = [(1, frame, "20.000", f"{5 * frame:.3f}", 2) for frame in range(1, 61)]
    lake = ingest(tmp_path / "lake", tmp_path / "raw", {"us-101-0750": rows, "us-101-0805": alone})
    export = export_csp(Settings(lake=lake), tmp_path / "out", CspOptions())
    as_read = {
        1: [(v, f, float(x), float(y), lane) for v, f, x, y, lane in (sorted(rows) if order == "other" else rows)]
    }
    as_read[2] = [(v, f, float(x), float(y), lane) for v, f, x, y, lane in alone]
    expected, _ = run_script(as_read, folded=(1, 2, 3))
    contents = read(tmp_path / "out")
    for part, (samples, tracks) in expected.items():
        np.testing.assert_array_equal(contents[part]["traj"], np.array(samples).reshape(-1, 47))
        assert contents[part]["tracks"].shape == tuple(map(max, zip(*tracks, strict=True)))
    assert [len(contents[part]["tracks"]) for part in PARTS] == [2, 1, 1]
    assert [note for note in export.notes if "neither" in note] == [
        "us-101-0750: its files are sorted neither by vehicle nor by frame; samples are sorted by vehicle"
    ] * (order == "other")


@pytest.mark.parametrize("clean", [False, True])
def test_the_projects_own_dataset_class_reads_every_sample(both, tmp_path, clean):
    export_csp(Settings(lake=both), tmp_path / "out", CspOptions(clean=clean))
    seen, neighbors, subsets = 0, 0, set()
    for contents in read(tmp_path / "out").values():
        dataset = ScriptDataset(contents)
        for index in range(len(dataset)):
            own, future, around, lateral, longitudinal = dataset[index]
            assert own.shape == (16, 2)
            assert own[-1].tolist() == [0, 0]
            assert 1 <= len(future) <= 25
            assert {len(neighbor) for neighbor in around} <= {0, 16}
            assert lateral.sum() == longitudinal.sum() == 1
            neighbors += sum(len(neighbor) > 0 for neighbor in around)
            seen += 1
            subsets.add(int(contents["traj"][index, 0]))
    assert (seen > 500, neighbors > 50) == (True, True)
    assert {7, 8} <= subsets, "highD's carriageways have rows of their own behind NGSIM's six"


def test_a_full_future_fills_every_horizon(ngsim, tmp_path):
    export = export_csp(Settings(lake=ngsim), tmp_path / "out", CspOptions(full_future=True))
    for contents in read(tmp_path / "out").values():
        dataset = ScriptDataset(contents)
        assert [dataset[index][1].shape for index in range(len(dataset))] == [(25, 2)] * len(dataset)
    assert export.count_drops()["no_full_future"] > 100


def test_highd_in_feet_at_10_hz(both, tmp_path):
    """Vehicle 9, of the lower carriageway, drives 3 m a tick from 4 m (its length) on, for 60 ticks, in lane 2."""
    export = export_csp(Settings(lake=both), tmp_path / "out", CspOptions(dataset="highd"))
    assert [facts["subset"] for facts in export.datasets] == [
        f"{number}-{direction}" for number in ("01", "02") for direction in ("lower", "upper")
    ]
    train = read(tmp_path / "out")["train"]
    assert train["tracks"].shape == (4, 11)  # the lower carriageways' ids are 9 to 16: 0.7 * 16 = 11.2
    frames, lateral_ft, along_ft = train["tracks"][0, 8]
    assert frames.tolist() == list(range(1, 61))
    np.testing.assert_allclose(along_ft, (4 + 3 * np.arange(60)) / 0.3048, rtol=1e-6)
    assert len(set(lateral_ft.tolist())) == 1
    # Of the upper one vehicles 1 to 6 (of 8), each 16 ticks later than the one before.
    assert [track[0, 0] if track.size else None for track in train["tracks"][1]] == [1, 17, 33, 49, 65, 81, *[None] * 5]
    samples = train["traj"][train["traj"][:, 0] == 2]
    assert samples[:28, 1:3].tolist() == [[1, frame] for frame in range(31, 59)]
    assert sum(file.tracks for file in export.files) == 4 * 8


def test_clean_parts_share_no_subset(both, tmp_path):
    settings = Settings(lake=both)
    export = export_csp(settings, tmp_path / "out", CspOptions(clean=True))
    contents = read(tmp_path / "out")
    places = []
    for part in contents.values():
        held = {row + 1 for row in range(part["tracks"].shape[0]) if any(cell.size for cell in part["tracks"][row])}
        assert {int(row) for row in part["traj"][:, 0]} <= held
        places.append(held)
    assert sum(map(len, places)) == len(set.union(*places))
    assert set.union(*places) == set(range(1, 11))
    assert any("validation_part = true" in note for note in export.notes)
    assert sum(file.samples for file in export.files) + sum(export.count_drops().values()) == sum(
        file.entries for file in export.files
    )


def test_clean_samples_are_the_lakes_at_its_own_rate(both, tmp_path):
    """The lake's samples, every other tick, are among them, with its labels where no window is cut short.

    US-101's ramps are merged here and not there; who stood still so far brakes nowhere there.
    """
    export = export_csp(Settings(lake=both), tmp_path / "out", CspOptions(clean=True))
    ids = {facts["subset"]: facts["id"] for facts in export.datasets if facts["dataset"] == "ngsim"}
    found = {tuple(row[:3]): row for part in read(tmp_path / "out").values() for row in part["traj"]}
    manifest = load(both)
    seen = scan(both, manifest, VEHICLES).select("subset", "vehicle_id", "first_frame", "last_frame").collect()
    seen = {(subset, vehicle): frames for subset, vehicle, *frames in seen.iter_rows()}
    lateral, longitudinal = {"keep": 1, "left": 2, "right": 3}, {"normal": 1, "brake": 2}
    counts = {"sample": 0, "lateral": 0, "longitudinal": 0}
    for row in scan(both, manifest, SAMPLES).filter(dataset="ngsim").collect().iter_rows(named=True):
        mine = found[ids[row["subset"]], row["vehicle_id"], row["frame"]]
        first, last = seen[row["subset"], row["vehicle_id"]]
        counts["sample"] += 1
        if row["subset"].startswith("i-80") and first + 40 <= row["frame"] <= last - 40:
            assert mine[6] == lateral[row["lateral_maneuver"]]
            counts["lateral"] += 1
        if first + 30 <= row["frame"] <= last - 50 and row["longitudinal_maneuver"] == "brake":
            assert mine[7] == longitudinal["brake"]
            counts["longitudinal"] += 1
    assert min(counts.values()) > 5, counts


def test_clean_uses_the_lakes_split_where_it_has_three_parts(tmp_path_factory):
    lake = ingest(tmp_path_factory.mktemp("lakes") / "lake", tmp_path_factory.mktemp("raw"), dict([*RAW.items()][:3]))
    settings = Settings(lake=lake, validation_part=True)
    run_stages(settings, *NEEDED_BY_CLEAN)
    export = export_csp(settings, lake.parent / "out", CspOptions(clean=True))
    assert not any("validation_part" in note for note in export.notes)


def test_clean_says_what_has_to_run_first(ngsim, tmp_path):
    with pytest.raises(StageError, match="tracklake validate` first, or `tracklake run`"):
        export_csp(Settings(lake=ngsim), tmp_path / "out", CspOptions(clean=True))
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_exported_is_named(ngsim, tmp_path):
    with pytest.raises(LakeMissingError, match="no lake here"):
        export_csp(Settings(lake=tmp_path / "nowhere"), tmp_path / "out", CspOptions())
    with pytest.raises(ExportError, match=r"no freeway recordings of highd; it has recordings of ngsim"):
        export_csp(Settings(lake=ngsim), tmp_path / "out", CspOptions(dataset="highd"))
    with pytest.raises(LakeError, match="lies in the lake"):
        export_csp(Settings(lake=ngsim), ngsim / "out", CspOptions())


def test_clean_with_parts_that_share_vehicles_is_refused(ngsim, tmp_path):
    settings = Settings(lake=ngsim, split="csp-2018")
    with pytest.raises(ExportError, match="parts share nothing, and the setting `split` is 'csp-2018'"):
        export_csp(settings, tmp_path / "out", CspOptions(clean=True))


def test_a_subset_without_lanes_is_left_out_and_counted(ngsim, tmp_path, monkeypatch):
    whole = csp.put_on_csp_clock

    def without_lanes(tracks, recorded):
        clock = whole(tracks, recorded)
        return clock.with_columns(lane=pl.lit(None, pl.Int16)) if recorded.dataset_id == 5 else clock

    monkeypatch.setattr(csp, "put_on_csp_clock", without_lanes)
    export = export_csp(Settings(lake=ngsim), tmp_path / "out", CspOptions())
    assert export.left_out == {"no_lane": len(RAW["i-80-1700"])}
    assert [note for note in export.notes if "i-80-1700" in note]
    assert {int(row[0]) for row in read(tmp_path / "out")["train"]["traj"]} == {1, 2, 3, 4, 6}


def test_tracks_too_short_for_any_sample_are_an_error(tmp_path):
    lake = ingest(tmp_path / "lake", tmp_path / "raw", {"us-101-0805": [(4, 9, 1, 2, 3)]})
    with pytest.raises(ExportError, match=r"no entry can be a sample \(short_track 1\)"):
        export_csp(Settings(lake=lake), tmp_path / "out", CspOptions())
    assert not (tmp_path / "out").exists()


def test_a_recording_keeps_its_number_and_parts_may_be_empty(tmp_path):
    rows = [(v, f, 1, 5 * f, 2) for v in (1, 2) for f in range(40)]
    lake = ingest(tmp_path / "lake", tmp_path / "raw", {"us-101-0805": rows})
    export = export_csp(Settings(lake=lake), tmp_path / "out", CspOptions())
    contents = read(tmp_path / "out")
    # 0.7 * 2 = 1.4 and 0.8 * 2 = 1.6: vehicle 1 trains, 2 is in validation.
    assert [len(part["traj"]) for part in contents.values()] == [8, 8, 0]
    assert set(contents["train"]["traj"][:, 0]) == {2.0}
    assert contents["eval"]["traj"].shape == (0, 47)
    assert [part["tracks"].shape for part in contents.values()] == [(2, 1), (2, 2), (0, 0)]
    assert export.notes == ["TestSet.mat: no samples"]


def test_a_failure_leaves_nothing(ngsim, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(csp, "write_card", fail)
    with pytest.raises(FileAccessError, match="No space left"):
        export_csp(Settings(lake=ngsim), tmp_path / "out", CspOptions())
    assert list(tmp_path.iterdir()) == []


def test_files_that_stand_there_are_replaced_on_request_only(ngsim, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "ValSet.mat").write_text("old")
    with pytest.raises(ExportError, match=r"holds ValSet\.mat.*--force"):
        export_csp(Settings(lake=ngsim), tmp_path, CspOptions())
    assert (tmp_path / "ValSet.mat").read_text() == "old"
    export_csp(Settings(lake=ngsim), tmp_path, CspOptions(), force=True)
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", CARD, *FILES}
    assert loadmat(tmp_path / "ValSet.mat")["traj"].shape[1] == 47


def test_a_file_beyond_the_formats_size_is_refused_with_advice(ngsim, tmp_path, monkeypatch):
    monkeypatch.setattr("tracklake.pipeline.export.csp.export.LARGEST_BYTES", 100_000)
    with pytest.raises(ExportError, match=r"`traj` of .*Nothing was written.*--dataset"):
        export_csp(Settings(lake=ngsim), tmp_path / "out", CspOptions())
    assert list(tmp_path.iterdir()) == []


def test_the_same_lake_gives_the_same_bytes_and_a_card_with_the_counts(ngsim, tmp_path):
    first, again = (export_csp(Settings(lake=ngsim), tmp_path / name, CspOptions()) for name in ("a", "b"))
    assert again.files == first.files
    for name in FILES:  # the header of 128 bytes says when it was written
        assert (tmp_path / "a" / name).read_bytes()[128:] == (tmp_path / "b" / name).read_bytes()[128:]
    assert (tmp_path / "a" / CARD).read_bytes() == (tmp_path / "b" / CARD).read_bytes()
    card = (tmp_path / "a" / CARD).read_text()
    for file in first.files:
        assert f"| {file.name} | {file.samples:,} | {file.sampled_tracks:,} | {file.tracks:,} |" in card
    assert "| 4 | ngsim | i-80-1600 | i-80-1600 |" in card


def test_the_command(command, lake, tmp_path):
    done = command.here("export", "csp", "--lake", lake.root, "--out", tmp_path / "out", "--json")
    assert done.code == 0, done.err
    reported = json.loads(done.out)
    assert [file["name"] for file in reported["files"]] == list(FILES)
    for file in reported["files"]:
        assert loadmat(tmp_path / "out" / file["name"])["traj"].shape == (file["samples"], 47)
    again = command.here("export", "csp", "--lake", lake.root, "--out", tmp_path / "out")
    assert (again.code, again.out) == (1, "")
    assert "--force" in again.err
    clean = command.here("export", "csp", "--lake", lake.root, "--out", tmp_path / "clean", "--clean", "--full-future")
    assert clean.code == 0, clean.err
    assert "TrainSet.mat" in clean.out
    assert "would_be_neighbor" in clean.out
    assert command.here("export", "csp", "--out", tmp_path / "x", "--dataset", "kitti").code == 2
