"""exiD by hand: carriageways, lanes, sizes, lists, maps, and what cannot be used."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from levelx_files import drive, meta_row, read, recognise, track_row, vehicle_row, write_recording, write_urban
from polars.testing import assert_frame_equal
from raw_texts import check_accounts, write

from tracklake.pipeline.sources.exid import EXID
from tracklake.pipeline.sources.lanelet_map import read_lanelet_map
from tracklake.pipeline.sources.levelx_recognition import group
from tracklake.pipeline.sources.source import SourceError
from tracklake.pipeline.transforms.tracks.utm import project_utm
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES

VEHICLES_ROWS = [
    vehicle_row(0, 800, width=2.15),
    vehicle_row(1, 800, "van"),
    vehicle_row(2, 800, "truck", length=12.0, width=2.5),
]
VEHICLES_ROWS += [vehicle_row(3, 50, "motorcycle")]
NORTH = [
    # To the north at 20 m/s: 0 in the left lane (x = 0), 1 in the right one (x = 3.5), 30 m ahead, 0.5 m left of its
    # middle; 2 is the leader of 1.
    *drive(
        0, (0.0, -20.0), (0, 20), 90.0, frames=800, laneletId="11;99", latLaneCenterOffset="0;3.5", laneWidth="3.5;3.5"
    ),
    *drive(1, (3.0, 10.0), (0, 20), 90.0, frames=800, laneletId=12, latLaneCenterOffset=0.5, leadId=2, leadDHW=22.0),
    *drive(2, (3.5, 40.0), (0, 20), 90.0, frames=800, laneletId=12, rearId=1, length=12.0, width=2.5),
]
SOUTH = drive(3, (-8.0, 60.0), (0, -30), 270.0, laneletId=21)


def by_name(canonical):
    for subset in canonical.subsets:
        TRACKS.validate(subset.tracks, where=subset.name)
        VEHICLES.validate(subset.vehicles, where=subset.name)
        SUBSETS.validate(subset.facts, where=subset.name)
    return {subset.name: subset for subset in canonical.subsets}


def test_golden_numbers_of_two_carriageways(tmp_path):
    dataset, canonical = read(write_recording(tmp_path, VEHICLES_ROWS, NORTH + SOUTH))
    assert dataset == "exid"
    subsets = by_name(canonical)
    assert list(subsets) == ["00-north", "00-south"]
    north = subsets["00-north"]
    tracks = north.tracks.filter(frame=0)
    # Fronts: 2 m ahead of the middles at -20 and 10, 6 m ahead of that of the truck at 40; counted from the hindmost.
    assert tracks["x_m"].to_list() == [0, 30, 64]
    # Lanes are 3.5 m wide, their middles at x = 0 and 3.5: the left edge is at -1.75.
    assert tracks["y_m"].to_list() == [1.75, 4.75, 5.25]
    assert tracks["lane"].to_list() == [1, 2, 2]
    assert tracks["heading_rad"].to_list() == [0, 0, 0]
    assert tracks["speed_mps"].to_list() == [20, 20, 20]
    assert tracks["leader_id"].to_list() == [None, 2, None]
    assert tracks["follower_id"].to_list() == [None, None, 1]
    assert tracks["gap_m"].to_list() == [None, 64 - 12 - 30, None]
    assert tracks["headway_recorded_m"].to_list() == [None, 22, None]
    assert tracks["time_s"].to_list() == [0, 0, 0]
    facts = north.facts.row(0, named=True)
    assert (facts["lanes"], facts["direction"], facts["site"], facts["freeway"], facts["seconds"]) == (
        2, "north", "location-3", True, 900.5)  # fmt: skip
    assert facts["lane_markings_m"] == [0, 3.5, 7]
    # tracksMeta has a width of 2.15 m for vehicle 0; that in tracks, 2 m, counts.
    assert north.vehicles["width_m"].to_list() == [2, 2, 2.5]
    assert north.vehicles["length_m"].to_list() == [4, 4, 12]
    assert north.vehicles["class"].to_list() == ["car", "car", "truck"]
    south = subsets["00-south"].tracks
    assert south["speed_mps"].unique().to_list() == [30]
    assert south["x_m"].to_list() == pytest.approx(np.arange(50) * 1.2, abs=1e-3)
    assert subsets["00-south"].vehicles["class"].to_list() == ["motorcycle"]
    assert any("1 of 4 vehicles have another size" in note for note in canonical.notes)
    assert any("fitted to the tracks" in note for note in canonical.notes)
    check_accounts(canonical, entries_from=["00_tracks.csv"])


def test_a_body_that_points_aside_has_its_front_aside(tmp_path):
    tracks = [*NORTH, *drive(3, (0.0, 100.0), (1, 20), 80.0, frames=40, laneletId=11)]
    tracks = by_name(read(write_recording(tmp_path, VEHICLES_ROWS, tracks))[1])["00-north"].tracks
    first = tracks.filter(vehicle_id=3, frame=0).row(0, named=True)
    # 10 degrees to the right of north; the front is 2 m from the middle at x = 0.
    assert first["heading_rad"] == pytest.approx(np.radians(10), abs=2e-3)
    assert first["y_m"] - 1.75 == pytest.approx(2 * np.sin(np.radians(10)), abs=0.05)
    assert first["lateral_speed_mps"] == pytest.approx(1, abs=0.05)


def test_on_a_bend_positions_speeds_and_headings_are_those_along_the_axis(tmp_path):
    radius, rows, vehicles = 200.0, [], []
    for track, (right, speed) in enumerate(((0.0, 20.0), (3.5, 20.0), (7.0, 23.0))):
        for frame in range(150):
            angle = speed * frame / 25 / (radius + right)
            place = (radius + right) * np.sin(angle), radius - (radius + right) * np.cos(angle)
            velocity = speed * np.cos(angle), speed * np.sin(angle)
            rows.append(track_row(track, frame, place, velocity, np.degrees(angle), laneletId=track + 1))
        vehicles.append(vehicle_row(track, 150))
    subset = by_name(read(write_recording(tmp_path, vehicles, rows))[1])["00-east"]
    tracks = subset.tracks.with_columns(spread=(pl.col("y_m") - pl.col("y_m").first()).abs().over("vehicle_id"))
    assert tracks["spread"].max() < 0.06
    assert tracks["heading_rad"].abs().max() < 0.01
    assert tracks.group_by("vehicle_id").agg(pl.col("lane").unique()).sort("vehicle_id")["lane"].to_list() == [
        [1], [2], [3]]  # fmt: skip
    # Recorded and recomputed speeds agree, though outer lanes are longer than the axis.
    apart = (tracks["speed_mps"] - tracks["speed_cd_mps"]).abs().drop_nulls()
    assert apart.max() < 0.15
    ahead = tracks.group_by("vehicle_id").agg(pl.col("speed_mps").median()).sort("vehicle_id")["speed_mps"]
    assert ahead[0] / ahead[1] == pytest.approx(203.5 / 200, rel=2e-3)
    assert subset.facts["lane_markings_m"].to_list() == [pytest.approx([0, 3.5, 7, 10.5], abs=0.05)]


def test_road_users_without_motor_and_impossible_rows_are_dropped_with_reasons(tmp_path):
    walker = drive(4, (10.0, 0.0), (0, 1), 90.0, width=0, length=0)
    vehicles = [*VEHICLES_ROWS, vehicle_row(4, 50, "pedestrian", width=0, length=0)]
    across = track_row(0, 800, (0, 300), (0, 20), 200.0)
    canonical = read(write_recording(tmp_path, vehicles, [*NORTH, *SOUTH, *walker, across]))[1]
    reasons = dict(canonical.rejects.group_by("reason").len().iter_rows())
    assert reasons == {"no motor vehicle: pedestrian": 50, "heading is more than 90 degrees off the road's axis": 1}
    check_accounts(canonical, entries_from=["00_tracks.csv"])


def test_a_header_in_another_order_with_unknown_columns_is_read(tmp_path):
    paths = write_recording(tmp_path, VEHICLES_ROWS, NORTH + SOUTH)
    frame = pl.read_csv(paths[2], infer_schema=False)
    frame.select(pl.lit("1").alias("extra"), *reversed(frame.columns)).write_csv(paths[2])
    meta = pl.read_csv(paths[0], infer_schema=False).rename({"weekday": "weekDay"}).drop("speedLimit", "lonLocation")
    meta.write_csv(paths[0])
    assert list(by_name(read(paths)[1])) == ["00-north", "00-south"]


@settings(max_examples=5)
@given(seed=st.integers(0, 1000), skipped=st.integers(1, 300))
def test_neither_the_order_of_rows_nor_gaps_nor_tracks_of_one_row_matter(tmp_path_factory, seed, skipped):
    folder = tmp_path_factory.mktemp("rows")
    lone = track_row(2_147_483_646, 5, (0.0, 60.0), (0, 20), 90.0, laneletId="11;12")
    rows = [*NORTH[: 800 - skipped], *NORTH[800:], *SOUTH, lone]
    del rows[100:110]  # a gap of vehicle 0
    vehicles = [*VEHICLES_ROWS, vehicle_row(2_147_483_646, 1)]
    shuffled = [rows[i] for i in np.random.default_rng(seed).permutation(len(rows))]
    one, other = (
        by_name(read(write_recording(folder / name, vehicles, each))[1])
        for name, each in (("sorted", rows), ("shuffled", shuffled))
    )
    assert list(one) == list(other) == ["00-north", "00-south"]
    for name in one:
        assert_frame_equal(one[name].tracks, other[name].tracks)
    tracks = one["00-north"].tracks
    assert tracks.height == 2_400 - skipped - 10 + 1
    assert tracks.filter(vehicle_id=2_147_483_646).select("lane", "speed_mps", "speed_cd_mps").rows() == [(1, 20, None)]


def test_without_lanelets_there_are_no_lanes(tmp_path):
    rows = drive(0, (0.0, -20.0), (0, 20), 90.0, laneletId="", latLaneCenterOffset="", laneWidth="")
    subset = by_name(read(write_recording(tmp_path, [vehicle_row(0, 50)], rows))[1])["00-north"]
    assert subset.tracks["lane"].null_count() == 50
    assert subset.facts.select("lanes", "columns_missing").row(0) == (None, ["lane"])


def test_a_recording_in_which_nothing_drives_has_no_subset(tmp_path):
    rows = drive(0, (0.0, 0.0), (0, 0), 90.0)
    canonical = read(write_recording(tmp_path, [vehicle_row(0, 50)], rows))[1]
    assert canonical.subsets == ()
    assert canonical.rejects["reason"].unique().to_list() == [
        "no vehicle of this direction drives, so that its road has no axis"
    ]


def write_map(path, lanes, *, missing=False):
    """A map of straight lanes to the north, by lanelet: x of its left and right bound, in m from the origin."""
    nodes, ways, relations = [], [], []
    lat = 50.88 + np.arange(80) * 1e-4
    for lanelet, bounds in lanes.items():
        for x in bounds:
            lon = np.full(80, 6.87)
            for _ in range(20):
                east, north = project_utm(lat, lon, 32)
                lon = lon + (350_000 + x - east) / 70_000
            ids = range(len(nodes) + 1, len(nodes) + 81)
            nodes += [f'<node id="{i}" lat="{a:.10f}" lon="{b:.10f}"/>' for i, a, b in zip(ids, lat, lon, strict=True)]
            # The order of nodes says nothing about the direction.
            refs = "".join(f'<nd ref="{i}"/>' for i in (reversed(ids) if x else ids))
            ways.append(f'<way id="{len(ways) + 1}">{refs}</way>')
        members = f'<member type="way" ref="{len(ways) - 1}" role="left"/>'
        members += f'<member type="way" ref="{len(ways) + 1000 * missing}" role="right"/>'
        relations.append(f'<relation id="{lanelet}">{members}<tag k="type" v="lanelet"/></relation>')
    path.parent.mkdir(parents=True, exist_ok=True)
    return write(path, "\n".join(["<osm>", *nodes, *ways, *relations, "</osm>"]).encode()), north[0] - 5_640_000


LANES = {11: (-1.75, 1.75), 12: (1.75, 5.25)}


def test_the_map_of_the_location_gives_axes_and_lanes(tmp_path):
    path, _ = write_map(tmp_path / "maps" / "location3.osm", LANES)
    other, _ = write_map(tmp_path / "maps" / "location4.osm", LANES)
    _, north = project_utm(np.array([50.88]), np.array([6.87]), 32)
    meta = meta_row(yUtmOrigin=float(north[0]) + 60)
    paths = write_recording(tmp_path / "data", VEHICLES_ROWS, NORTH, meta=meta)
    canonical = read([*paths, path, other])[1]
    tracks = by_name(canonical)["00-north"].tracks.filter(frame=0)
    assert tracks["x_m"].to_list() == pytest.approx([0, 30, 64], abs=0.02)
    assert tracks["y_m"].to_list() == pytest.approx([1.75, 4.75, 5.25], abs=0.02)
    assert tracks["lane"].to_list() == [1, 2, 2]
    assert canonical.log.filter(dialect="lanelet2").select("rows_read", "rows_kept").rows() == [(2, 2)]
    assert any("location3.osm, 2 lanelets" in note for note in canonical.notes)


@pytest.mark.parametrize(("mapped", "others"), [(True, SOUTH), (True, []), (False, SOUTH)])
def test_a_vehicle_with_a_turned_heading_does_not_shift_the_lanes(tmp_path, mapped, others):
    path, _ = write_map(tmp_path / "location3.osm", {**LANES, 21: (-6.25, -9.75)})
    _, north = project_utm(np.array([50.88]), np.array([6.87]), 32)
    # It drives to the south in lanelet 21, at x = -8, and its heading says north.
    wrong = drive(4, (-8.0, 60.0), (0, -20), 90.0, frames=20, laneletId=21)
    vehicles = [*VEHICLES_ROWS, vehicle_row(4, 20)]
    meta = meta_row(yUtmOrigin=float(north[0]) + 60)
    paths = write_recording(tmp_path / "data", vehicles, [*NORTH, *others, *wrong], meta=meta)
    canonical = read([*paths, *[path] * mapped])[1]
    subset = by_name(canonical)["00-north"]
    tracks = subset.tracks.filter(frame=0).sort("vehicle_id")
    assert tracks["lane"].to_list() == [1, 2, 2, None]
    # The left edge is at x = -1.75, half of 3.5 m left of lanelet 11.
    assert tracks["y_m"].to_list() == pytest.approx([1.75, 4.75, 5.25, -6.25], abs=0.02)
    assert subset.facts["lanes"].to_list() == [2]


def test_of_several_maps_of_a_location_the_one_in_the_same_download_counts(tmp_path):
    near, _ = write_map(tmp_path / "b" / "maps" / "location3.osm", LANES)
    far, _ = write_map(tmp_path / "a" / "maps" / "location3.osm", LANES)
    paths = write_recording(tmp_path / "b" / "data", VEHICLES_ROWS, NORTH)
    (unit,) = group(recognise([*paths, far, near])).units
    assert [file.path for file in unit.files[3:]] == [near]


def test_a_map_without_the_lanelets_of_a_recording_is_not_said_to_be_used(tmp_path):
    path, _ = write_map(tmp_path / "location3.osm", {71: (-1.75, 1.75)})
    canonical = read([*write_recording(tmp_path, VEHICLES_ROWS, NORTH), path])[1]
    (note,) = [note for note in canonical.notes if "location3.osm" in note]
    assert "has none of the lanelets that vehicles use: road axes and lanes are fitted to the tracks" in note


def test_damaged_maps_are_refused_and_lanelets_without_bounds_are_counted(tmp_path):
    path, _ = write_map(tmp_path / "location3.osm", LANES)
    found = read_lanelet_map(*recognise([path]), 6.9, (350_000.0, 5_640_000.0))
    assert (found.lanelets, found.skipped) == (2, 0)
    middles = found.points.group_by("lanelet").agg(pl.col("x_m", "width_m", "angle_rad").mean()).sort("lanelet")
    assert middles["x_m"].to_list() == pytest.approx([0, 3.5], abs=1e-3)
    assert middles["width_m"].to_list() == pytest.approx([3.5, 3.5], abs=2e-3)
    assert middles["angle_rad"].to_list() == pytest.approx([np.pi / 2] * 2, abs=1e-3)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SourceError, match=r"damaged or cut short .* move it\s+away"):
        read_lanelet_map(*recognise([path]), 6.9, (0.0, 0.0))
    path, _ = write_map(tmp_path / "location3.osm", LANES, missing=True)
    with pytest.raises(SourceError, match=r"no lanelet in it \(2 without their bounds\)"):
        read_lanelet_map(*recognise([path]), 6.9, (0.0, 0.0))


def test_a_recording_tells_its_dataset(tmp_path):
    rows = [",".join(row.split(",")[:17]) for row in NORTH[:50]]
    made = {"ind": "truck_bus", "round": "van"}
    for place, (name, kind) in enumerate(made.items()):
        paths = write_urban(tmp_path / name, [vehicle_row(0, 50, kind)], rows, number=f"0{place}")
        assert [unit.dataset for unit in group(recognise(paths)).units] == [name]
    paths = write_urban(tmp_path / "either", [vehicle_row(0, 50)], rows)
    assert not group(recognise(paths)).units
    (refusal,) = group(recognise(paths)).refusals
    assert "--dataset ind, or --dataset round" in refusal
    assert [unit.dataset for unit in group(recognise(paths), only="round").units] == ["round"]
    assert [unit.dataset for unit in group(recognise(paths), only="exid").units] == []


def test_files_that_do_not_belong_together_are_refused(tmp_path):
    paths = write_recording(tmp_path, VEHICLES_ROWS, NORTH)
    (refusal,) = group(recognise(paths[:2])).refusals
    assert "00_tracks.csv missing" in refusal
    write_recording(tmp_path, VEHICLES_ROWS, NORTH, meta=meta_row(7))
    with pytest.raises(SourceError, match="expected id 0, as the file's name says, got 7"):
        read(paths)
    write_recording(tmp_path, VEHICLES_ROWS[:1], NORTH)
    with pytest.raises(SourceError, match=r"has no row in 00_tracksMeta\.csv"):
        read(paths)
    assert EXID.detect(b"trackId,frame,xCenter\n", "00_tracks.csv") is None
