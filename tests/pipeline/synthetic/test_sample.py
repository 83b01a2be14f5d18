"""A tiny sample from SUMO, checked against its own truth and the raw formats."""

import re
import time
from pathlib import Path

import polars as pl
import pytest
from lake_sources import SAMPLE
from raw_texts import read_highd, read_ngsim
from simulated import count_once, simulate_once

from tracklake.pipeline import synthetic
from tracklake.pipeline.synthetic import ALL_FORMATS, SampleSummary, SumoError, build, write_sample
from tracklake.pipeline.synthetic import sumo as sumo_runs
from tracklake.schemas.errors import UsageError

MINUTES, SEED = (kind(text) for kind, text in zip((float, int), SAMPLE[1::2], strict=True))
"""Length in minutes and seed of the session's sample, with which this one shares its simulations."""


@pytest.fixture(scope="module")
def written(sample, tmp_path_factory) -> tuple[Path, SampleSummary]:
    del sample
    out = tmp_path_factory.mktemp("sample") / "raw"
    with simulate_once():
        return out, write_sample(out, formats=ALL_FORMATS, minutes=MINUTES, seed=SEED)


@pytest.fixture(scope="module")
def truth(written) -> pl.DataFrame:
    return pl.read_parquet(written[0] / "truth.parquet")


def highd_tracks(out, recording):
    """The sound rows of a tracks file: those of 25 numbers, once each."""
    lines = (out / f"{recording}_tracks.csv").read_text().split("\n")
    rows = dict.fromkeys(line for line in lines[1:] if re.fullmatch(r"(-?\d+(\.\d+)?,){24}\d+", line))
    return pl.read_csv("\n".join([lines[0], *rows]).encode(), infer_schema_length=None)


def test_summary_names_every_file(written):
    out, summary = written
    assert sorted(path.name for path in out.iterdir()) == [path.name for path in summary.files]
    # highD, NGSIM in three formats, drives, exiD, inD, rounD, TGSIM, I-24
    assert summary.recordings == 4 + 1 + 2 + 1 + 2 + 2 + 1 + 1 + 3 + 1
    files = [path for path in out.rglob("*") if not path.relative_to(out).parts[0].startswith("drive-")]
    lines = sum(path.read_bytes().count(b"\n") for path in files if path.suffix in (".csv", ".txt"))
    metadata = sum(path.read_bytes().count(b"\n") for path in files if path.name.endswith("Meta.csv"))
    headers = 4 + 1 + 1 + 4 + 3  # the text has none
    lanelets = (out / "exid/maps/lanelets/0_generated/location0.osm").read_text().count("<relation")
    documents = (out / "i24-inception.json").read_bytes().count(b"\n")
    assert summary.rows == lines - metadata - headers + documents + lanelets
    assert not [path for path in out.parent.iterdir() if path != out]


def test_same_seed_same_bytes_whatever_else_is_written(written, tmp_path):
    out, _ = written
    with count_once():
        again = write_sample(tmp_path / "a", formats=("ngsim-csv", "socrata"), minutes=MINUTES, seed=SEED)
    for path in again.files:
        if path.suffix != ".parquet":
            assert path.read_bytes() == (out / path.name).read_bytes()
    with simulate_once():
        twice = write_sample(tmp_path / "b", formats=("socrata", "ngsim-csv"), minutes=MINUTES, seed=SEED)
    assert (tmp_path / "a/truth.parquet").read_bytes() == (tmp_path / "b/truth.parquet").read_bytes()
    other = write_sample(tmp_path / "c", formats=("ngsim-csv",), minutes=MINUTES, seed=SEED + 1)
    assert other.files[1].name == twice.files[1].name
    assert other.files[1].read_bytes() != twice.files[1].read_bytes()


def test_portal_export_has_bom_crlf_and_thousands(written):
    data = (written[0] / "us-101-export.csv").read_bytes()
    assert data.startswith(b"\xef\xbb\xbfVehicle_ID,Frame_ID,Total_Frames,")
    assert data.count(b"\r\n") == data.count(b"\n")
    assert data.endswith(b"us-101\r\n")
    assert re.search(rb'"1,0\d\d[".]', data)
    assert b",,,,,,," in data


def test_text_is_aligned_and_has_no_header(written):
    lines = (written[0] / "trajectories-us-101-0930.txt").read_bytes().decode().split("\n")
    assert lines[0].split()[3] == "1118853000042"
    whole = [line for line in lines if len(line.split()) == 18 and "\0" not in line and "fast" not in line]
    assert len({len(line) for line in whole}) == 1
    assert all(int(line.split()[3]) - 100 * int(line.split()[1]) == 1_118_852_999_942 for line in whole)


def find_origins(canonical):
    return {subset.facts["origin"][0] for made in canonical for subset in made.subsets}


@pytest.mark.parametrize("name", ["trajectories-us-101-0930.txt", "trajectories-us-101-1015.csv", "us-101-export.csv"])
def test_a_piece_of_a_generated_ngsim_file_is_recognised_without_its_folder(written, tmp_path, name):
    lines = (written[0] / name).read_bytes().splitlines(keepends=True)
    header = lines[:1] if name.endswith(".csv") else []
    piece = tmp_path / f"mine{Path(name).suffix}"
    piece.write_bytes(b"".join([*header, *lines[40:80]]))
    found, _ = read_ngsim(tmp_path / "spilled", piece)
    assert find_origins(found.values()) == {"synthetic"}


def test_a_generated_ngsim_file_that_another_program_rewrote_is_recognised(written, tmp_path):
    frame = pl.read_csv(written[0] / "trajectories-us-101-1015.csv", ignore_errors=True, truncate_ragged_lines=True)
    kept = frame.drop_nulls().select("Vehicle_ID", "Frame_ID", "Global_Time", "Local_X", "Local_Y", "v_Vel").head(50)
    kept.write_csv(tmp_path / "derived.csv")
    found, _ = read_ngsim(tmp_path / "spilled", tmp_path / "derived.csv")
    assert find_origins(found.values()) == {"synthetic"}


def test_a_generated_highd_recording_is_recognised_without_its_folder(written, tmp_path):
    paths = []
    for kind in ("recordingMeta", "tracksMeta", "tracks"):
        paths.append(tmp_path / f"44_{kind}.csv")
        text = (written[0] / f"04_{kind}.csv").read_text()
        paths[-1].write_text(text.replace("\n4,", "\n44,", 1) if kind == "recordingMeta" else text)
    assert find_origins([read_highd(paths, "44")]) == {"synthetic"}


def test_rules_find_exactly_the_injected_defects(truth):
    """SUMO brakes, accelerates and queues as vehicles can, so that these rules count nothing but what was injected."""
    found = {
        (subset, name): entries
        for subset, name, entries in truth.filter(kind="rule").select("subset", "name", "entries").iter_rows()
    }
    assert len(found) == (8 + 4) * 24
    injected = truth.filter((pl.col("kind") == "defect") & pl.col("line").is_null())
    counts = {
        (subset, name): entries
        for subset, name, entries in injected.group_by("subset", "name").agg(pl.col("entries").sum()).iter_rows()
    }
    names = {
        # The second track of a vehicle follows the first, with a gap of less than nothing.
        "negative_headway": ("overlap", "second_track"),
        "high_acceleration": ("acceleration_spike",),
        "hard_deceleration": ("hard_braking",),
        "low_constant_speed": ("frozen_slow_speed",),
        "backward": ("backward",),
        "heading_motion_mismatch": ("sideways_speed",),
        "duplicate_track": ("second_track", "second_track"),
    }
    for (subset, rule), entries in found.items():
        expected = sum(counts.get((subset, name), 0) for name in names.get(rule, ()))
        assert rule not in names or entries == expected, (subset, rule)
    ends = injected.filter(pl.col("name").is_in(["late_start", "early_end", "second_track"])).group_by("subset").len()
    fragments = truth.filter(
        (pl.col("kind") == "rule") & (pl.col("name") == "track_fragment") & (pl.col("entries") > 0)
    )
    assert dict(fragments.select("subset", "entries").iter_rows()) == dict(ends.iter_rows())
    changed = injected.filter(name="size_change").join(
        truth.filter(kind="rule", name="size_change"), on="subset", suffix="_found"
    )
    assert (changed["vehicles_found"] == 1).all(), "every entry of a vehicle whose size changes is found"
    misread = {"wrong_leader", "wrong_headway", "lane_flicker", "position_jump", "size_change", "early_end"}
    defects = {*misread, *sum(names.values(), ()), "late_start", "frame_gap", "overlap_unseen"}
    assert {name for _, name in counts} == defects
    # The leader of a vehicle that is recorded in another lane has, by the files, lost its follower; a headway is
    # also wrong where somebody has jumped. Nothing less than what was injected is found.
    rules = {"wrong_headway": "headway_mismatch", "lane_flicker": "lane_flicker"}
    for (subset, name), entries in counts.items():
        assert name not in rules or found[subset, rules[name]] >= entries, (subset, name)


def test_one_subset_drives_backwards_and_no_other_does_so_beyond_one_percent(truth):
    vehicles = truth.filter(kind="first_frame").group_by("subset").agg(pl.len().alias("all"))
    backward = truth.filter(kind="rule", name="backward").join(vehicles, on="subset")
    share = dict(backward.select("subset", pl.col("vehicles") / pl.col("all")).iter_rows())
    assert share.pop("03-upper") > 0.01
    assert all(each <= 0.01 for each in share.values())


def test_lines_add_up_and_damaged_lines_stand_where_declared(written, truth):
    out, _ = written
    rows = truth.filter(kind="rows").pivot(on="name", index="file", values="entries")
    assert (rows["read"] == rows["kept"] + rows["malformed"] + rows["duplicate"]).all()
    declared = truth.filter((pl.col("kind") == "defect") & pl.col("line").is_not_null())
    for file, count in declared.group_by("file"):
        data = (out / str(file[0])).read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
        lines = data.split("\n")
        for number, name in count.select("line", "name").iter_rows():
            line = lines[number - 1]
            looks = {
                "duplicate_row": lines.count(line) > 1,
                "truncated_line": line != "",
                "word_in_number": "fast" in line,
                "wrong_field_count": line.endswith("0"),
                "empty_line": line == "",
                "nul_byte": "\0" in line,
                "repeated_header": line == lines[0],
                "open_quote": line.count('"') % 2 == 1,
            }
            assert looks[name], (file, number, name)
        tally = rows.filter(pl.col("file") == file[0]).row(0, named=True)
        assert tally["duplicate"] == count.filter(name="duplicate_row").height
        assert tally["malformed"] == count.height - tally["duplicate"]
    assert rows.filter(pl.col("file").str.ends_with("Meta.csv"))["malformed"].sum() == 0


def test_first_frames_agree_with_the_file_but_for_late_starts(written, truth):
    out, _ = written
    firsts = truth.filter(kind="first_frame", recording="02")
    late = truth.filter(kind="defect", recording="02", name="late_start")
    copied = truth.filter(kind="defect", recording="02", name="second_track")["vehicle_id"].implode()
    rows = highd_tracks(out, "02").filter(~pl.col("id").is_in(copied))
    in_file = rows.group_by("id").agg(pl.col("frame").min().alias("seen"))
    joined = firsts.join(in_file, left_on="vehicle_id", right_on="id", validate="1:1")
    assert joined.height == firsts.height == in_file.height
    differ = joined.filter(pl.col("seen") != pl.col("first_frame"))
    assert sorted(differ["vehicle_id"]) == sorted(late["vehicle_id"])
    starts = joined.join(late.select("vehicle_id", gone="last_frame"), on="vehicle_id")
    assert (starts["seen"] == starts["gone"] + 1).all()
    # Everybody not on the road at frame 1 crosses the window's entrance at no more than one frame's way.
    entering = firsts.filter(pl.col("first_frame") > 1)
    assert entering["value"].max() < 50 / 25
    assert firsts["value"].min() >= 0


def test_highd_metadata_describe_the_file(written):
    out, _ = written
    for recording in ("01", "02", "03", "04"):
        rows = highd_tracks(out, recording)
        meta = pl.read_csv(out / f"{recording}_tracksMeta.csv")
        found = rows.group_by("id").agg(
            first=pl.col("frame").min(), last=pl.col("frame").max(), count=pl.len(),
            fastest=pl.col("xVelocity").abs().max(), left=(pl.col("xVelocity") < 0).mean() > 0.5,
        )  # fmt: skip
        both = meta.join(found, on="id", validate="1:1")
        assert both.height == meta.height == found.height
        assert (both["initialFrame"] == both["first"]).all()
        assert (both["finalFrame"] == both["last"]).all()
        assert (both["numFrames"] == both["count"]).all()
        assert (both["maxXVelocity"] - both["fastest"]).abs().max() < 0.001
        if recording != "03":
            assert ((both["drivingDirection"] == 1) == both["left"]).all()
        summary = pl.read_csv(out / f"{recording}_recordingMeta.csv").row(0, named=True)
        assert summary["numVehicles"] == meta.height
        assert summary["numVehicles"] == summary["numCars"] + summary["numTrucks"]
        assert rows["frame"].max() <= round(summary["duration"] * 25)


def test_highd_neighbors_are_those_a_slow_search_finds(written, truth):
    """Every tenth frame of a file, vehicle by vehicle. Lost entries are seen by the others, so such frames are left."""
    out, _ = written
    rows = highd_tracks(out, "02").filter(pl.col("frame") % 10 == 0)
    gaps = truth.filter(kind="defect", recording="02", name="frame_gap")
    for first, last in gaps.select("first_frame", "last_frame").iter_rows():
        rows = rows.filter(~pl.col("frame").is_between(first, last))
    compared = 0
    for _, frame in rows.group_by("frame"):
        entries = frame.to_dicts()
        for own in entries:
            upper = own["laneId"] < 6
            lane_step = 1 if upper else -1  # towards the driver's left, which is the median's side

            def span(entry, upper=upper):
                rear, front = entry["x"], round(entry["x"] + entry["width"], 2)
                return (-front, -rear) if upper else (rear, front)

            rear, front = span(own)
            ahead = [e for e in entries if e["laneId"] == own["laneId"] and span(e)[1] > front]
            nearest = min(ahead, key=lambda e: span(e)[1])["id"] if ahead else 0
            assert own["precedingId"] == nearest
            for side, step in (("left", lane_step), ("right", -lane_step)):
                beside = [e for e in entries if e["laneId"] == own["laneId"] + step]
                preceding = [e for e in beside if span(e)[0] > front]
                following = [e for e in beside if span(e)[1] < rear]
                alongside = {e["id"] for e in beside if span(e)[0] <= front and span(e)[1] >= rear}
                assert own[f"{side}PrecedingId"] == min(((span(e)[0], e["id"]) for e in preceding), default=(0, 0))[1]
                assert own[f"{side}FollowingId"] == max(((span(e)[1], e["id"]) for e in following), default=(0, 0))[1]
                assert own[f"{side}AlongsideId"] in (alongside or {0})
                compared += 1
    assert compared > 1000


def test_traffic_is_lively(written):
    lanes = highd_tracks(written[0], "01").sort("id", "frame")
    step = lanes.select(
        pl.col("y").diff().abs().over("id").max(),
        speeds=pl.col("xVelocity").abs().std(),
        slow=pl.col("width").n_unique(),
    ).row(0)
    assert step[0] < 0.2  # no lateral jumps
    assert step[1] > 1
    assert step[2] >= 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"formats": ("highD",)},
            "formats: expected some of highd, ngsim-text, ngsim-csv, socrata, drives, exid, ind, round, tgsim, i24",
        ),
        ({"formats": ()}, "got none"),
        ({"minutes": 0.0}, "minutes: expected 0.1 to 15, got 0.0"),
        ({"minutes": float("nan")}, "minutes: expected"),
        ({"seed": -1}, "seed: expected a whole number from 0, got -1"),
    ],
)
def test_bad_arguments(tmp_path, arguments, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        write_sample(tmp_path / "out", **arguments)
    assert not list(tmp_path.iterdir())


def test_a_folder_of_something_else_is_left_alone(tmp_path, written):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UsageError, match=r"is not empty and holds no sample \(truth.parquet is missing\)"):
        write_sample(tmp_path)
    (tmp_path / "truth.parquet").write_bytes((written[0] / "truth.parquet").read_bytes())
    with pytest.raises(UsageError, match=r"but also thesis\.txt, which would be lost"):
        write_sample(tmp_path)
    (tmp_path / "truth.parquet").write_text("no parquet")
    with pytest.raises(UsageError, match="cannot be read"):
        write_sample(tmp_path)
    pl.DataFrame({"a": [1]}).write_parquet(tmp_path / "truth.parquet")
    with pytest.raises(UsageError, match="not that of a sample"):
        write_sample(tmp_path)
    with pytest.raises(UsageError, match="is a file"):
        write_sample(tmp_path / "thesis.txt")
    assert (tmp_path / "thesis.txt").read_text() == "mine"


def test_an_earlier_sample_is_replaced_whole(tmp_path):
    out = tmp_path / "raw"
    out.mkdir()
    reported = []
    with simulate_once():
        write_sample(out, formats=("ngsim-csv",), minutes=MINUTES, seed=SEED)
        write_sample(out, formats=("ngsim-text",), minutes=MINUTES, seed=SEED, progress=reported.append)
    files = ["README.md", "trajectories-us-101-0930.txt", "true_tracks.parquet", "truth.parquet"]
    assert sorted(path.name for path in out.iterdir()) == files
    assert [path.name for path in tmp_path.iterdir()] == ["raw"]
    assert reported[0] == "simulating 1 carriageways"


def test_without_sumo_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(sumo_runs, "find_spec", lambda _: None)
    with pytest.raises(SumoError, match=re.escape('pip install "tracklake[sample]"')):
        write_sample(tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_failed_run_says_what_sumo_said(tmp_path):
    with pytest.raises(SumoError, match=r"sumo ended with exit code 1;(.|\n)*nowhere.xml"):
        sumo_runs._call(sumo_runs.find_sumo(), "sumo", ["-n", str(tmp_path / "nowhere.xml")])


def test_the_package_exports_what_it_promises():
    assert set(synthetic.__all__) >= {"ALL_FORMATS", "SampleSummary", "write_sample"}


def test_simulations_end_at_once_where_one_fails(tmp_path, monkeypatch):
    """The same happens at Ctrl-C; the others would go on for half a minute."""
    sumo, waits = tmp_path / "sumo", tmp_path / "waits"
    (sumo / "bin").mkdir(parents=True)
    program = sumo / "bin" / "netconvert"
    program.write_text(f"#!/bin/sh\nif mkdir '{waits}'; then exec sleep 60; fi\necho broken >&2\nexit 1\n")
    program.chmod(0o755)
    monkeypatch.setattr(build, "find_sumo", lambda: sumo)
    began = time.monotonic()
    with pytest.raises(SumoError, match="netconvert"):
        write_sample(tmp_path / "out")
    assert time.monotonic() - began < 30
    assert waits.exists()
    assert not sumo_runs._RUNNING
    assert not (tmp_path / "out").exists()
