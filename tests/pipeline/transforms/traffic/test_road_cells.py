"""Edie's flow, density and speed on a grid, and virtual detectors: by hand, conserved, and against slow loops."""

import math
from itertools import pairwise

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from traffic_scenes import complete, draw_rows, drive, make_scene

from tracklake.pipeline.transforms.traffic.detectors import count_passages
from tracklake.pipeline.transforms.traffic.edie import measure_cells
from tracklake.schemas import EDIE, VIRTUAL_DETECTORS


def measure(scene, **cell):
    cells, skipped = measure_cells(scene, **cell)
    rows = complete(cells, EDIE).to_dicts() if cells.width else []
    return rows, {name: count for name, count in skipped.items() if count}


def count(scene, **grid):
    passages, skipped = count_passages(scene, **grid)
    rows = complete(passages, VIRTUAL_DETECTORS).to_dicts() if passages.width else []
    return rows, {name: count for name, count in skipped.items() if count}


def test_a_line_is_divided_at_the_borders_of_cells():
    """One line from 80 m at 0 s to 130 m at 1 s (50 m/s): 20 m and 0.4 s before the border at 100 m.

    The border in time at 0.5 s lies 5 m beyond it: 5 m in 0.1 s, then 25 m in 0.5 s.
    """
    scene = make_scene(
        [{"vehicle_id": 1, "frame": 0, "x_m": 80.0}, {"vehicle_id": 1, "frame": 1, "x_m": 130.0}], rate_hz=1.0
    )
    cells, skipped = measure(scene, cell_m=100, cell_s=0.5)
    found = [
        [cell[name] for name in ("from_m", "from_s", "length_m", "seconds", "vehicles", "distance_m", "time_s")]
        for cell in cells
    ]
    expected = [
        [0, 0, 20, 0.5, 1, 20, 0.4],
        [0, 0.5, 20, 0.5, 0, 0, 0],
        [100, 0, 30, 0.5, 1, 5, 0.1],
        [100, 0.5, 30, 0.5, 1, 25, 0.5],
    ]
    assert [value for row in found for value in row] == pytest.approx([value for row in expected for value in row])
    assert skipped == {}
    assert cells[3]["flow_vph"] == pytest.approx(3600 * 25 / (30 * 0.5))
    assert cells[3]["density_vpkm"] == pytest.approx(1000 * 0.5 / (30 * 0.5))
    assert [cell["speed_mps"] for cell in cells] == pytest.approx([50, None, 50, 50])


def test_a_detector_counts_fronts_and_what_stands_above_it():
    """Three vehicles of 4 m at 20 m/s pass 100 m at 0.25, 1.3 and 4.05 s: 0.2 s each above it.

    Intervals of 2 s; the recording lasts 5 s. A fourth stands with its front at 101 m all the time in lane 2, where a
    fifth passes.
    """
    frames = range(51)
    rows = [row for n, at in enumerate((0.25, 1.3, 4.05)) for row in drive(n, frames, 100 - 20 * at, 20)]
    detectors, _ = count(make_scene(rows), spacing_m=100, interval_s=2)
    at_100 = [row for row in detectors if row["detector_m"] == 100]
    assert [(row["lane"], row["interval_s"], row["seconds"], row["vehicles"]) for row in at_100] == [
        (1, 0, 2, 2), (1, 2, 2, 0), (1, 4, 1, 1),
    ]  # fmt: skip
    assert [row["flow_vph"] for row in at_100] == [3600, 0, 3600]
    assert [row["time_mean_speed_mps"] for row in at_100] == pytest.approx([20, None, 20])
    assert [row["occupancy"] for row in at_100] == pytest.approx([0.2, 0, 0.2])
    rows += drive(8, frames, 101, 0, lane=2) + drive(9, frames, 60, 30, lane=2)
    detectors, _ = count(make_scene(rows), spacing_m=100, interval_s=2)
    assert [row["occupancy"] for row in detectors if (row["detector_m"], row["lane"]) == (100, 2)] == [1, 1, 1]


def test_space_mean_speed_is_the_harmonic_mean():
    rows = drive(1, range(41), 50, 20) + drive(2, range(41), 50, 40)
    detectors, _ = count(make_scene(rows), spacing_m=100, interval_s=10)
    assert detectors[0]["time_mean_speed_mps"] == pytest.approx(30)
    assert detectors[0]["space_mean_speed_mps"] == pytest.approx(2 / (1 / 20 + 1 / 40))


def test_a_front_that_wavers_passes_once_and_unknown_lengths_have_no_occupancy():
    places = [98.0, 101.0, 99.0, 102.0, 103.0]
    rows = [{"vehicle_id": 1, "frame": frame, "x_m": x_m} for frame, x_m in enumerate(places)]
    ((row,), _) = count(make_scene(rows, lengths={1: None}), spacing_m=100, interval_s=10)
    assert (row["vehicles"], row["occupancy"], row["time_mean_speed_mps"]) == (1, None, pytest.approx(30))


def test_gaps_single_entries_and_missing_lanes_are_counted():
    rows = drive(1, [0, 1, 3, 4], 95, 20, lane=lambda frame: None if frame == 4 else 1) + drive(2, [0], 0, 0)
    reasons = {"one_entry": 1, "frame_gap": 1, "no_lane": 1}
    scene = make_scene(rows)
    assert measure(scene, cell_m=100, cell_s=1)[1] == count(scene, spacing_m=100, interval_s=1)[1] == reasons
    assert measure(make_scene(drive(1, range(3), 5, 0)), cell_m=10, cell_s=1) == ([], {"no_extent": 3})
    every_second = drive(1, range(0, 20, 2), 0, 20)
    assert measure(make_scene(every_second), cell_m=10, cell_s=1) == ([], {"frame_gap": 9})
    assert count(make_scene([]), spacing_m=10, interval_s=1) == ([], {})


def lines_of(tracks):
    """Lane, vehicle, time and place of both ends of every line between successive frames."""
    entries = tracks.to_dicts()
    for before, now in pairwise(entries):
        if before["vehicle_id"] == now["vehicle_id"] and before["frame"] == now["frame"] - 1 and before["lane"]:
            times = before["frame"] / 10, now["frame"] / 10
            yield before["lane"], now["vehicle_id"], *times, before["x_m"], now["x_m"]


def slow_cells(tracks, cell_m, cell_s):
    """Distance, time and vehicles by lane and cell, one line after the other."""
    cells = {}
    for lane, vehicle, t0, t1, x0, x1 in lines_of(tracks):
        cuts = {0.0, 1.0}
        for low, high, size in ((x0, x1, cell_m), (t0, t1, cell_s)):
            for border in range(math.floor(min(low, high) / size), math.ceil(max(low, high) / size) + 1):
                if high != low and 0 < (border * size - low) / (high - low) < 1:
                    cuts.add((border * size - low) / (high - low))
        ordered = sorted(cuts)
        for begin, end in pairwise(ordered):
            middle = (begin + end) / 2
            key = lane, math.floor((x0 + middle * (x1 - x0)) / cell_m), math.floor((t0 + middle * (t1 - t0)) / cell_s)
            distance, time, who = cells.get(key, (0, 0, set()))
            took = (end - begin) * (t1 - t0)
            seen = {vehicle} if took > 1e-9 else set()  # else it only touches the cell's border, as far as floats tell
            cells[key] = distance + (end - begin) * (x1 - x0), time + took, who | seen
    return {key: (distance, time, len(who)) for key, (distance, time, who) in cells.items() if time > 1e-9}


@settings(max_examples=50)
@given(draw_rows(), st.sampled_from([7.0, 40.0, 500.0]), st.sampled_from([0.25, 0.3, 5.0]))
def test_cells_conserve_distance_and_time_and_are_those_of_a_loop(rows, cell_m, cell_s):
    scene = make_scene(rows)
    cells, _ = measure(scene, cell_m=cell_m, cell_s=cell_s)
    lines = list(lines_of(scene.tracks)) if scene.road_m else []
    assert sum(cell["distance_m"] for cell in cells) == pytest.approx(sum(x1 - x0 for *_, x0, x1 in lines), abs=1e-9)
    assert sum(cell["time_s"] for cell in cells) == pytest.approx(0.1 * len(lines))
    found = {
        (cell["lane"], round(cell["from_m"] / cell_m), round(cell["from_s"] / cell_s)): cell
        for cell in cells
        if cell["time_s"] > 1e-9
    }
    low, high = (math.floor(scene.road_m[0] / cell_m), math.ceil(scene.road_m[1] / cell_m) - 1) if lines else (0, 0)
    expected = {}
    for (lane, along, at), (distance, time, who) in slow_cells(scene.tracks, cell_m, cell_s).items():
        key = lane, min(max(along, low), high), at
        before = expected.get(key, (0, 0, 0))
        expected[key] = before[0] + distance, before[1] + time, max(before[2], who)
    assert {key: (cell["distance_m"], cell["time_s"]) for key, cell in found.items()} == {
        key: pytest.approx(value[:2]) for key, value in expected.items() if lines
    }
    assert all(cell["vehicles"] >= expected[key][2] for key, cell in found.items())


@settings(max_examples=50)
@given(draw_rows(), st.sampled_from([7.0, 40.0]), st.sampled_from([0.25, 5.0]))
def test_detectors_count_what_a_loop_counts(rows, spacing_m, interval_s):
    scene = make_scene(rows)
    detectors, _ = count(scene, spacing_m=spacing_m, interval_s=interval_s)
    furthest, passed, expected = {}, set(), {}
    last = max(0, math.ceil(round(scene.end_s / interval_s, 9)) - 1)
    entries = scene.tracks.to_dicts()
    for before, now in pairwise(entries):
        if before["vehicle_id"] != now["vehicle_id"] or before["frame"] != now["frame"] - 1:
            furthest = {}
            continue
        start = furthest.get("x", before["x_m"])
        furthest["x"] = max(start, now["x_m"])
        for number in range(math.floor(start / spacing_m) + 1, math.floor(furthest["x"] / spacing_m) + 1):
            if before["lane"] and (now["vehicle_id"], number) not in passed:
                passed.add((now["vehicle_id"], number))
                share = (number * spacing_m - before["x_m"]) / (now["x_m"] - before["x_m"])
                at = min(math.floor(round((before["frame"] + share) / 10 / interval_s, 9)), last)
                key = number, before["lane"], at
                expected[key] = expected.get(key, 0) + 1
    found = {
        (round(row["detector_m"] / spacing_m), row["lane"], round(row["interval_s"] / interval_s)): row["vehicles"]
        for row in detectors
        if row["vehicles"]
    }
    assert found == expected
    assert pl.Series([row["occupancy"] for row in detectors], dtype=pl.Float64).is_between(0, 1).all()
