"""`tracklake export sumo-fcd`: SUMO itself replays the tracks, at every frame, to the millimetre."""

import subprocess
import xml.etree.ElementTree as ElementTree

import numpy as np
import polars as pl
import pytest
from export_lakes import ingest
from hypothesis import given
from hypothesis import strategies as st

from tracklake.pipeline.export.folder import ExportError
from tracklake.pipeline.export.sumo import export as sumo_export
from tracklake.pipeline.export.sumo import floating_cars
from tracklake.pipeline.export.sumo.export import NAMES, export_sumo_fcd
from tracklake.pipeline.export.sumo.floating_cars import add_ends, find_half_step, list_types, place_vehicles
from tracklake.pipeline.export.sumo.road import Road, find_road
from tracklake.pipeline.lake import load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.synthetic.sumo import find_sumo
from tracklake.schemas import TRACKS

ROAD = Road(0.0, 500.0, (0.0, 4.0, 8.0), "the recording's markings")
FACTS = {"first_frame": 1, "frame_rate_hz": 10.0, "lanes": 2, "lane_markings_m": None}


def make_rows(seed=3):
    """Three lanes of 12 ft: present at the first frame, beginning later, gaps, overlaps, standstill, off the road."""
    random = np.random.default_rng(seed)
    rows = []
    for vehicle in range(1, 16):
        lane, first = 1 + vehicle % 3, 1 + 4 * (vehicle // 4)
        y, x = random.uniform(0, 300), 12 * lane - 6 + random.normal(0, 2)
        for frame in range(first, first + int(random.integers(1, 60))):
            y += random.choice([0.0, 4.0, 9.0])
            x += random.normal(0, 0.3)
            if random.random() > 0.04:
                rows.append((vehicle, frame, f"{x - 30 * (vehicle == 15):.3f}", f"{y:.3f}", lane))
    return rows


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    return ingest(
        tmp_path_factory.mktemp("lakes") / "lake", tmp_path_factory.mktemp("raw"), {"us-101-0750": make_rows()}, ["01"]
    )


def read_fcd(path, rate):
    """(id, frame since the first one) -> x, y, speed, lane."""
    found = {}
    for step in ElementTree.parse(path).getroot():
        frame = (float(step.get("time")) - 1.0) * rate
        assert frame == pytest.approx(round(frame), abs=1e-6)
        for own in step:
            key = own.get("id"), round(frame)
            assert key not in found
            found[key] = *(float(own.get(name)) for name in ("x", "y", "speed")), own.get("lane")
    return found


@pytest.mark.parametrize(
    ("subset", "rate", "gaps", "tracks_from"),
    [("us-101-0750", 10, True, "recorded"), ("us-101-0750", 10, True, "filtered"), ("01-upper", 25, False, "recorded")],
)
def test_replayed_positions_are_those_of_the_tracks(lake, tmp_path, subset, rate, gaps, tracks_from):
    settings = Settings(lake=lake, tracks_from=tracks_from)
    export = export_sumo_fcd(settings, tmp_path / "out", subset)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*NAMES}
    home, replayed = find_sumo(), tmp_path / "replayed.xml"
    call = [home / "bin" / "sumo", "-c", tmp_path / "out" / "replay.sumocfg", "--fcd-output", replayed]
    done = subprocess.run(call, env={"SUMO_HOME": str(home)}, capture_output=True, text=True, check=True, timeout=60)
    assert done.stderr == ""

    facts = sumo_export._choose_subset(lake, load(lake), subset)
    reader = LakeReader(lake, load(lake)).open_subset(facts["dataset"], subset)
    tracks = reader.read_tracks(settings)
    assert (tracks["x_m"] != reader.table(TRACKS)["x_m"]).any() is (tracks_from == "filtered")
    written, shown = read_fcd(tmp_path / "out" / "fcd.xml", rate), read_fcd(replayed, rate)
    assert len(written) == len(shown) == tracks.height == export.entries
    parts, before = {}, {}
    markings = find_road(tracks, facts).markings_m
    for vehicle, frame, time_s, x, y, lane, speed in tracks.select(
        "vehicle_id", "frame", "time_s", "x_m", "y_m", "lane", "speed_mps"
    ).iter_rows():
        parts[vehicle] = parts.get(vehicle, 0) + (before.get(vehicle) != frame - 1)
        before[vehicle] = frame
        at = round(time_s * rate)
        name = f"{vehicle}.{parts[vehicle]}" if parts[vehicle] > 1 else str(vehicle)
        for found in (written[str(vehicle), at], shown[name, at]):
            assert found[:3] == pytest.approx((x, -y, speed), abs=0.0011)
        assert written[str(vehicle), at][3] == f"road_{export.lanes - lane}"
        to_marking = min(abs(y - own) for own in markings)
        if to_marking > 0.01 and markings[0] < y < markings[-1]:
            lies_in = sum(own < y for own in markings)
            assert shown[name, at][3] == f"road_{export.lanes - lies_in}"
    assert (max(parts.values()) > 1) is gaps
    assert any(round(t * rate) == 0 for t in tracks["time_s"])


def make_tracks(rows):
    """Rows of (vehicle, frame, x, y, lane, speed)."""
    schema = {
        "vehicle_id": pl.Int32, "frame": pl.Int32, "x_m": pl.Float64, "y_m": pl.Float64, "lane": pl.Int16,
        "speed_mps": pl.Float32,
    }  # fmt: skip
    return pl.DataFrame(rows, schema=schema, orient="row").with_columns(heading_rad=pl.lit(None, pl.Float32))


def make_types(*numbers):
    rows = [(number, "truck", 12.0, None) for number in numbers]
    schema = {"vehicle_id": pl.Int32, "class": pl.String, "length_m": pl.Float32, "width_m": pl.Float32}
    return list_types(pl.DataFrame(rows, schema=schema, orient="row"))


def test_the_files_by_hand(tmp_path, monkeypatch):
    """Vehicle 5 in lane 1 of 2 at frames 1 and 2, backwards at the second; vehicle 6 at frame 2, without a lane."""
    monkeypatch.setattr(floating_cars, "CHUNK_ROWS", 2)  # several pieces
    tracks = make_tracks([(5, 1, 10.0, 1.5, 1, 20.0), (5, 2, 12.0, 1.25, 1, -1.0), (6, 2, 30.0, 9.0, None, 30.0)])
    placed = place_vehicles(tracks, make_types(5, 6), ROAD, FACTS)
    floating_cars.write_fcd(tmp_path / "fcd.xml", placed, ROAD, 50, number_parts=False)
    vehicle = (
        '        <vehicle id="{}" x="{}" y="{}" angle="90.0" type="truck_12.0_unknown" speed="{}" pos="{}" lane="{}"/>'
    )
    assert (tmp_path / "fcd.xml").read_text().splitlines()[1:] == [
        "<fcd-export>",
        '    <timestep time="1.0">',
        vehicle.format(5, 10.0, -1.5, 20.0, 10.0, "road_1"),
        "    </timestep>",
        '    <timestep time="1.1">',
        vehicle.format(5, 12.0, -1.25, 0.0, 12.0, "road_1"),
        vehicle.format(6, 30.0, -9.0, 30.0, 30.0, "road_0"),
        "    </timestep>",
        "</fcd-export>",
    ]
    with_ends = add_ends(placed, ROAD, 50).sort("vehicle_id", "step")
    assert with_ends.select("vehicle_id", "step", "x").rows() == [
        (5, -1, 9.0), (5, 0, 10.0), (5, 2, 12.0), (5, 3, 500.0), (6, 1, 28.5), (6, 2, 30.0), (6, 3, 500.0),
    ]  # fmt: skip
    floating_cars.write_types(tmp_path / "types.xml", make_types(5, 6))
    assert (
        '<vType id="truck_12.0_unknown" vClass="truck" length="12.0" maxSpeed' in (tmp_path / "types.xml").read_text()
    )


@given(st.sets(st.tuples(st.integers(1, 3), st.integers(1, 12)), min_size=1))
def test_every_run_of_frames_enters_and_leaves_once(places):
    tracks = make_tracks([(vehicle, frame, 5.0 * frame, 2.0, 1, 10.0) for vehicle, frame in places])
    placed = place_vehicles(tracks, make_types(1, 2, 3), ROAD, FACTS)
    first = {(v, 2 * (f - 1)) for v, f in places if (v, f - 1) not in places}
    last = {(v, 2 * (f - 1)) for v, f in places if (v, f + 1) not in places}
    assert {*placed.filter("enters").select("vehicle_id", "step").rows()} == first
    assert {*placed.filter("leaves").select("vehicle_id", "step").rows()} == last
    for vehicle, step, part in placed.select("vehicle_id", "step", "part").rows():
        assert part == sum(v == vehicle and s <= step for v, s in first)


def test_lanes_without_markings_are_estimated():
    """Vehicles 1 m left of the middle of lanes of 3.5 m that begin at y = 2, and a ramp that does not count."""
    rows = [(lane, 1, 0.0, 2 + 3.5 * (lane - 0.5) - 1, lane, 9.0) for lane in (1, 2, 3)] + [(9, 1, 9.0, 40.0, 5, 9.0)]
    road = find_road(make_tracks(rows), {"lanes": 3, "lane_markings_m": None})
    assert road.markings_m == pytest.approx([1, 4.5, 8, 11.5, 15, 18.5])
    assert (road.begin_m, road.end_m) == (-20, 29)
    only = find_road(make_tracks([(1, 1, 0.0, 5.0, 2, 9.0)]), {"lanes": None, "lane_markings_m": None})
    assert np.diff(only.markings_m) == pytest.approx(3.66)
    assert only.lanes == 2
    known = find_road(make_tracks(rows[:2]), {"lanes": 2, "lane_markings_m": [0.0, 3.0, 7.0]})
    assert known.markings_m == (0.0, 3.0, 7.0)
    none = find_road(make_tracks([(1, 1, 0.0, 5.0, None, 9.0)]), {"lanes": None, "lane_markings_m": None})
    assert none.lanes == 1


def test_frame_rates_that_sumo_cannot_count():
    assert [find_half_step(rate) for rate in (10.0, 25.0, 12.5)] == [50, 20, 40]
    with pytest.raises(ExportError, match="got 30 Hz"):
        find_half_step(30.0)


def test_messages_say_what_to_do(lake, tmp_path, command):
    out = tmp_path / "out"
    for arguments, message in (
        ((), "expected one subset, got 3: name one of highd/01-lower, highd/01-upper, ngsim/us-101-0750 with --subset"),
        (("--subset", "us-101-0751"), "no freeway subset is called us-101-0751; did you mean us-101-0750?"),
    ):
        done = command.here("export", "sumo-fcd", "--lake", lake, "--out", out, *arguments)
        assert done.code == 1
        assert message in " ".join(done.err.split())
        assert not out.exists()
    shown = command.here("export", "sumo-fcd", "--lake", lake, "--out", out, "--subset", "ngsim/us-101-0750")
    assert shown.code == 0, shown.err
    assert "gaps in tracks: replay.xml has a track's further parts" in shown.out
    with pytest.raises(ExportError, match="holds no freeway recordings"):
        export_sumo_fcd(Settings(lake=ingest(tmp_path / "empty", tmp_path, {})), tmp_path / "none")
    again = command.here("export", "sumo-fcd", "--lake", lake, "--out", out, "--subset", "01-lower")
    assert again.code == 1
    assert "--force" in again.err
