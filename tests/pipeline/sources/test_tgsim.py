"""TGSIM by hand: both dialects, runs, directions, automated vehicles, lane centrelines, and files that are damaged."""

from dataclasses import replace

import polars as pl
import pytest
from raw_texts import check_accounts, raw_file, write

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.lake import open_for_writing, scan
from tracklake.pipeline.sources import tgsim_files
from tracklake.pipeline.sources.csv import hash_raw
from tracklake.pipeline.sources.source import Part, SourceError
from tracklake.pipeline.sources.tgsim import CONFLICT, DUPLICATE, OFF_GRID, TGSIM
from tracklake.schemas import INGEST_LOG, REJECTS, SUBSETS, TRACKS, VEHICLES

PORTAL = (
    "id,time,xloc_kf,yloc_kf,lane_kf,speed_kf,acceleration_kf,length_smoothed,width_smoothed,type_most_common,acc,"
    "run_index"
)
ORIGINAL = "ID,time,xloc-kf,yloc-kf,lane-kf,speed-kf,acceleration-kf,length-smoothed,width-smoothed,type-most-common"
FILE = "Third_Generation_Simulation_Data__TGSIM__I-294_L1_Trajectories.csv"
CENTRELINES = "I-294-L1-Run_1-geometry-with-ramps.csv"


def drive(vehicle, lane, middle, *, length=4.0, kind="small-vehicle", acc="no", run=1, frames=30):
    """A vehicle that drives to the left with 20 m/s, 3.6576 m further up in each lane; its middle begins at x."""
    return [
        f"{vehicle},{tenth / 10},{middle - 2 * tenth:.3f},{100 - 3.6576 * lane:.4f},{lane},20,0.5,{length},2.1,{kind},"
        f"{acc},{run}"
        for tenth in range(frames)
    ]


ROWS = [
    *drive(1, 1, 500, acc="Yes"),
    *drive(2, 2, 480, length=12.0, kind="large-vehicle"),
    *drive(3, 1, 540, length=5.0),
]


def read(folder, name, header, rows, *beside):
    """{recording: Canonical} and Spilled of one trajectory file and files beside it."""
    file = raw_file(write(folder / name, "\n".join([header, *rows, ""]).encode()), TGSIM)
    spilled = TGSIM.spill(file, folder / "spilled")
    made = {}
    for recording in spilled.recordings:
        rejects = spilled.rejects if len(spilled.recordings) == 1 else None
        parts = [Part(file, pl.scan_ipc(folder / "spilled" / recording / "*.arrow"), rejects)]
        made[recording] = TGSIM.to_canonical([*parts, *(Part(raw_file(each, TGSIM)) for each in beside)], recording)
        for subset in made[recording].subsets:
            TRACKS.validate(subset.tracks, where=subset.name)
            VEHICLES.validate(subset.vehicles, where=subset.name)
            SUBSETS.validate(subset.facts, where=subset.name)
    return made, spilled


def test_golden_numbers_of_the_portals_export(tmp_path):
    made, spilled = read(tmp_path, FILE, PORTAL, [*ROWS, *drive(1, 1, 500, run=2)])
    assert spilled.recordings == {"i-294-l1-run-1": 90, "i-294-l1-run-2": 30}
    (subset,) = made["i-294-l1-run-1"].subsets
    assert subset.name == "i-294-l1-run-1-leftward"
    first = subset.tracks.filter(frame=0).sort("vehicle_id")
    # Fronts are half a length to the left of the middles 500, 480, 540: 498, 474, 537.5, counted from the hindmost.
    assert first["x_m"].to_list() == pytest.approx([39.5, 63.5, 0], abs=2e-3)
    # Lane 1 is the driver's leftmost: its middle is half of 12 ft from the left edge.
    assert first["y_m"].to_list() == pytest.approx([1.829, 5.486, 1.829], abs=2e-3)
    assert first["lane"].to_list() == [1, 2, 1]
    # Vehicle 3 follows vehicle 1, whose rear is 4 m behind its front.
    assert first["leader_id"].to_list() == [None, None, 1]
    assert first["follower_id"].to_list() == [3, None, None]
    assert first["gap_m"].to_list() == [None, None, pytest.approx(35.5, abs=2e-3)]
    moving = subset.tracks.filter(frame=5)
    assert moving["speed_mps"].to_list() == [20, 20, 20]
    assert moving["accel_mps2"].to_list() == [0.5, 0.5, 0.5]
    assert moving["speed_cd_mps"].to_list() == pytest.approx([20, 20, 20], abs=0.02)
    assert subset.vehicles["automated"].to_list() == [True, False, False]
    assert subset.vehicles["class"].to_list() == ["car", "truck", "car"]
    facts = subset.facts.row(0, named=True)
    assert (facts["lanes"], facts["seconds"], facts["site"], facts["origin"]) == (2, 3.0, "i-294-l1", "recorded")
    assert facts["columns_missing"] == ["headway_recorded_m"]
    check_accounts(made["i-294-l1-run-1"], entries_from=[FILE])
    assert made["i-294-l1-run-2"].subsets[0].vehicles["automated"].to_list() == [False]


def test_i395_has_no_run_moves_down_and_codes_its_types(tmp_path):
    rows = [
        f"{one},{tenth / 10},{60 - 3.6576 * one},{30 + 2 * tenth + 20 * one},{-one},20,,4,2,{one}"
        for one in (1, 2, 3, 4)
        for tenth in range(20)
    ]
    made, _ = read(tmp_path, "I395_final.csv", ORIGINAL, rows)
    (subset,) = made["i-395"].subsets
    assert subset.name == "i-395-downward"
    # Down the image, the driver's right is the image's left; lanes -1 to -4 are counted from the left.
    assert subset.vehicles["start_lane"].to_list() == [1, 2, 3, 4]
    assert "lanes -1, -2, -3, -4 of the file are numbered 1, 2, ... from the left" in made["i-395"].notes[0]
    assert subset.vehicles["automated"].to_list() == [False, False, False, True]
    assert subset.vehicles["class"].to_list() == ["car", "truck", "truck", "car"]
    assert subset.facts["columns_missing"][0].to_list() == ["accel_mps2", "headway_recorded_m"]


def test_vehicles_of_both_directions_are_two_subsets_and_negative_speeds_are_turned(tmp_path):
    back = [f"9,{tenth / 10},{100 + 2 * tenth},120,5,-20,-0.5,4,2,small-vehicle,no,1" for tenth in range(30)]
    made, _ = read(tmp_path, FILE, PORTAL, [*ROWS, *back])
    subsets = {subset.name: subset for subset in made["i-294-l1-run-1"].subsets}
    assert sorted(subsets) == ["i-294-l1-run-1-leftward", "i-294-l1-run-1-rightward"]
    own = subsets["i-294-l1-run-1-rightward"].tracks
    assert own["x_m"].to_list() == pytest.approx([2.0 * tenth for tenth in range(30)], abs=2e-3)
    assert own.select("lane", "speed_mps", "accel_mps2").unique().rows() == [(1, 20.0, 0.5)]
    assert any("the signs of speeds and accelerations are turned" in note for note in made["i-294-l1-run-1"].notes)


def test_a_standing_vehicle_that_drifts_back_stays_in_the_direction_of_its_lane(tmp_path):
    # Its middle drifts from 300 to 302.9 m in 3 s, in lane 1.
    standing = [f"9,{tenth / 10},{300 + tenth / 10},96.3424,1,0,0,4,2,small-vehicle,no,1" for tenth in range(30)]
    made, _ = read(tmp_path, FILE, PORTAL, [*ROWS, *standing])
    (subset,) = made["i-294-l1-run-1"].subsets
    first = subset.tracks.filter(frame=0, vehicle_id=1).row(0, named=True)
    # Its front is at 298 m and its rear at 302 m, 196 m ahead of vehicle 1's front at 498 m.
    assert (first["leader_id"], first["gap_m"]) == (9, pytest.approx(196, abs=2e-3))


def test_lane_centrelines_tell_the_axis_and_the_ramps_of_their_run(tmp_path):
    header = "x1,y1,ramp1,x2,y2,ramp2"
    lines = [f"{600 - 20 * step},{100 - 3.6576:.4f},0,{600 - 20 * step},{100 - 7.3152:.4f},1" for step in range(20)]
    beside = write(tmp_path / CENTRELINES, "\n".join([header, *lines, "1,2", ""]).encode())
    other = write(tmp_path / CENTRELINES.replace("Run_1", "Run_2"), "\n".join([header, *lines, ""]).encode())
    made, _ = read(tmp_path, FILE, PORTAL, ROWS, beside, other)
    canonical = made["i-294-l1-run-1"]
    facts = canonical.subsets[0].facts.row(0, named=True)
    assert (facts["lanes"], facts["on_ramp_lanes"]) == (1, [2])
    assert f"the road's axis follows the lane centrelines of {CENTRELINES}" in canonical.notes[0]
    # Its lines are accounted for, too: 20 points of each lane, and one that is cut short.
    assert canonical.log.filter(file=CENTRELINES).select("rows_read", "rows_kept", "rows_dropped").row(0) == (21, 20, 1)
    check_accounts(canonical, entries_from=[FILE])
    assert canonical.log["file"].to_list() == [CENTRELINES, FILE]


def test_other_lanes_left_of_the_main_ones_do_not_shift_their_numbers(tmp_path):
    rows = [*drive(1, 1, 500, frames=120), *drive(2, 2, 480, frames=120), *drive(3, 1, 540, frames=120)]
    # 3 of 360 rows are labelled lane 9, 20 m to the left: less than 1 %.
    rows[50:53] = [row.replace(",96.3424,1,", ",116.3424,9,") for row in rows[50:53]]
    made, _ = read(tmp_path / "rare", FILE, PORTAL, rows)
    (subset,) = made["i-294-l1-run-1"].subsets
    tracks = subset.tracks.filter(vehicle_id=1).sort("frame")
    assert subset.facts.select("lanes", "on_ramp_lanes").row(0) == (2, [])
    assert subset.vehicles["start_lane"].to_list() == [1, 2, 1]
    assert tracks["lane"][49:54].to_list() == [1, None, None, None, 1]
    # Half of 12 ft from the left edge, and 20 m to the left of that.
    assert tracks["y_m"][49:51].to_list() == pytest.approx([1.829, -18.171], abs=2e-3)
    assert "lane 9 of the file, left of a main lane" in made["i-294-l1-run-1"].notes[0]


def test_an_on_ramp_on_the_left_does_not_shift_the_numbers_of_main_lanes(tmp_path):
    ramp = [row.replace(",0,20,", ",5,20,") for row in drive(4, 0, 500)]
    lines = [f"{600 - 20 * step},96.3424,0,{600 - 20 * step},92.6848,0,{600 - 20 * step},100,1" for step in range(20)]
    beside = write(tmp_path / CENTRELINES, "\n".join(["x1,y1,ramp1,x2,y2,ramp2,x5,y5,ramp5", *lines, ""]).encode())
    made, _ = read(tmp_path, FILE, PORTAL, [*ROWS, *ramp], beside)
    (subset,) = made["i-294-l1-run-1"].subsets
    assert subset.facts.select("lanes", "on_ramp_lanes").row(0) == (2, [])
    assert subset.vehicles["start_lane"].to_list() == [1, 2, 1, None]
    # The ramp's middle is half of 12 ft left of the main lanes' left edge.
    assert subset.tracks.filter(frame=0)["y_m"].to_list() == pytest.approx([1.829, 5.486, 1.829, -1.829], abs=2e-3)


def test_two_files_of_one_run_share_its_lane_centrelines(tmp_path):
    raw, lake = tmp_path / "raw", tmp_path / "lake"
    for part, rows in ((1, ROWS[:60]), (2, ROWS[59:])):
        write(raw / f"TGSIM_I-294_L1_part{part}.csv", "\n".join([PORTAL, *rows, ""]).encode())
    lines = [f"{600 - 20 * step},96.3424,0,{600 - 20 * step},92.6848,0" for step in range(20)]
    write(raw / CENTRELINES, "\n".join(["x1,y1,ramp1,x2,y2,ramp2", *lines, ""]).encode())
    with open_for_writing(lake) as writer:
        found = discover(raw, digest=hash_raw)
        for dataset, file in ingest.find_unread_files(found, writer.manifest):
            writer.remember_sources({file.sha256: ingest.read_file(lake, dataset.name, file)})
        (job,) = ingest.plan(found, writer.manifest)
        writer.commit(ingest.build(lake, job))
        log = scan(lake, writer.manifest, INGEST_LOG).collect().sort("file")
        rejects = scan(lake, writer.manifest, REJECTS).collect()
    assert log.select("file", "rows_read", "rows_kept").rows() == [
        (CENTRELINES, 20, 20), ("TGSIM_I-294_L1_part1.csv", 60, 60), ("TGSIM_I-294_L1_part2.csv", 31, 30)]  # fmt: skip
    # The last row of part 1 is the first of part 2, too.
    assert rejects.select("file", "line", "text").rows() == [("TGSIM_I-294_L1_part2.csv", 2, ROWS[59])]


def test_every_line_is_kept_or_told_with_its_reason(tmp_path):
    again, contradicting = ROWS[3], ROWS[4].replace(",20,", ",21,")
    between = ROWS[5].replace(",0.5,", ",0.55,", 1)
    rows = [*ROWS, again, contradicting, between, "7,0.1,nan,2,1,20,0,4,2,small-vehicle,no,1", "8,0.1,400.1,9"]
    made, spilled = read(tmp_path, FILE, PORTAL, rows)
    canonical = made["i-294-l1-run-1"]
    check_accounts(canonical, entries_from=[FILE])
    reasons = dict(canonical.rejects.select("reason", "line").rows())
    assert [reasons[reason] for reason in (DUPLICATE, CONFLICT, OFF_GRID)] == [
        95,
        96,
        97,
    ] or spilled.rejects.height == 2
    assert canonical.rejects.height == 5
    assert canonical.subsets[0].tracks.height == len(ROWS)


def test_files_that_cannot_be_used_are_refused_with_what_to_do(tmp_path):
    write(tmp_path / "empty.csv", b"")
    write(tmp_path / "foggy.csv", b"id,time,xloc_kf,yloc_kf,lane_kf,speed_kf_x,speed_kf_y\n1,0,1,1,1,1,1\n")
    write(tmp_path / CENTRELINES, b"x1,y1,ramp1\n1,2,0\n")
    found = discover(tmp_path, digest=lambda file: file.name)
    empty, urban, lines = found.refusals
    assert "empty.csv: empty file" in empty
    assert "foggy.csv: trajectories of TGSIM's urban site" in urban
    assert f"{CENTRELINES}: lane centrelines without the trajectories of their site" in lines
    bare = raw_file(write(tmp_path / FILE, f"{PORTAL}\n".encode()), TGSIM)
    assert TGSIM.spill(bare, tmp_path / "bare").recordings == {}
    nothing = raw_file(write(tmp_path / "I-294-L1-lines.csv", b"x1,y1\n,\n"), TGSIM)
    with pytest.raises(SourceError, match=r"no points of lane centrelines.*leave it out"):
        tgsim_files.read_centrelines(nothing)


def test_the_runs_are_named_by_the_user_the_site_or_the_file(tmp_path):
    file = raw_file(write(tmp_path / "mine.csv", "\n".join([PORTAL, *ROWS]).encode()), TGSIM)
    assert [*TGSIM.spill(file, tmp_path / "one").recordings] == ["mine-run-1"]
    assert [*TGSIM.spill(replace(file, recording="other"), tmp_path / "two").recordings] == ["other-run-1"]
    sites = {
        tgsim_files.find_site(replace(file, path=tmp_path / name))
        for name in ("I90_94_moving_final.csv", "I-90-moving-Run_1-geometry-with-ramps.csv")
    }
    assert sites == {"i-90-94-moving"}
    assert tgsim_files.find_site(replace(file, path=tmp_path / "I-90-I-94 Stationary.csv")) == "i-90-94-stationary"


@pytest.mark.parametrize(
    ("name", "site"),
    [
        (FILE, "i-294-l1"),
        (CENTRELINES, "i-294-l1"),
        ("TGSIM_I-294_L1_Trajectories.csv", "i-294-l1"),
        ("I-294_L2_final_1.csv", "i-294-l2"),
        ("I294L2_Run_1.csv", "i-294-l2"),
        ("I-294_L12.csv", None),
        ("I-90_I-94_Moving_Trajectories.csv", "i-90-94-moving"),
        ("I395_final.csv", "i-395"),
    ],
)
def test_names_tell_their_site(tmp_path, name, site):
    file = raw_file(write(tmp_path / name, f"{PORTAL}\n".encode()), TGSIM)
    assert tgsim_files.find_site(file) == site
