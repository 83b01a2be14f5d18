"""What the subsets' pages draw by themselves: rasters, axes, lines and time-space diagrams."""

import math
import re
import struct
import zlib
from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.quality_reports.plots.axes import Scale, draw_line, find_range, format_number, make_ticks
from tracklake.quality_reports.plots.distributions import find_speed_range
from tracklake.quality_reports.plots.rasters import EMPTY, LEVELS, encode_png, grade_values, make_palette
from tracklake.quality_reports.plots.time_space import COLUMNS, ROWS, Grid, draw_lanes, make_grid, rasterise
from tracklake.quality_reports.summaries import query, query_frame


def read_png(content: bytes) -> tuple[dict[bytes, bytes], np.ndarray]:
    """The chunks of a PNG of palette entries, and the entries: read as the specification says, filter 0 only."""
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        kind, body = content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        assert struct.unpack(">I", content[at + 8 + length : at + 12 + length]) == (zlib.crc32(kind + body),)
        chunks[kind] = body
        at += 12 + length
    width, height, depth, colour, *rest = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    assert (depth, colour, rest) == (8, 3, [0, 0, 0])
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, width + 1)
    assert not rows[:, 0].any(), "a filter"
    return chunks, rows[:, 1:]


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_a_png_holds_the_palette_entries(height, width, seed):
    indices = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)
    chunks, read = read_png(encode_png(indices))
    assert list(chunks) == [b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"]
    assert (read == indices).all()
    assert len(chunks[b"PLTE"]) == 3 * 256
    assert chunks[b"PLTE"][3:6] == bytes.fromhex("440154"), "the least value: viridis begins with its darkest"
    assert chunks[b"PLTE"][-3:] == bytes.fromhex("b5de2b")
    assert chunks[b"tRNS"] == b"\x00", "only the first entry is transparent"


def test_the_palette_grows_lighter_step_by_step():
    colours = make_palette()[1:].astype(float)
    lightness = colours[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > -0.6).all(), "rounding of single channels apart"
    assert (lightness[20::20] - lightness[:-20:20][: len(lightness[20::20])] > 5).all()


def test_values_are_graded_from_the_first_colour_to_the_last():
    values = np.array([np.nan, -3.0, 0.0, 12.5, 25.0, 99.0])
    assert grade_values(values, 0, 25).tolist() == [EMPTY, 1, 1, 128, LEVELS, LEVELS]


@given(st.floats(-1e6, 1e6), st.floats(1e-2, 1e6), st.integers(2, 12))
def test_ticks_are_round_and_within(low, span, most):
    high = low + span
    ticks = make_ticks(low, high, most)
    assert len(ticks) <= most + 1
    assert all(low - span * 1e-6 <= tick <= high + span * 1e-6 for tick in ticks)
    steps = {float(f"{later - tick:.3g}") for tick, later in pairwise(ticks)}
    assert len(steps) <= 1
    assert all(f"{step:e}"[0] in "125" for step in steps)


def test_ticks_by_hand():
    assert make_ticks(0, 66, 10) == [0, 10, 20, 30, 40, 50, 60]
    assert make_ticks(-0.3, 0.9, 4) == [0, 0.5]
    assert format_number(-1250.0) == "\N{MINUS SIGN}1,250"
    assert find_range(pl.Series([3.0, None, 3.0]), 2.0) == pytest.approx((1.9, 4.1))


def test_a_line_breaks_at_gaps_and_missing_values():
    points = pl.DataFrame(
        {
            "time_s": [0.0, 1.0, 2.0, 5.0, 6.0, 7.0],
            "x_m": [0.0, 1.0, 2.0, 5.0, None, 7.0],
            "follows": [False, True, True, False, True, True],
        }
    )
    drawn = draw_line(points, Scale(0, 10, 0, 100), Scale(0, 10, 100, 0), "x_m", "time_s")
    assert drawn == "M0.0 100.0h0L10.0 90.0L20.0 80.0M50.0 50.0h0M70.0 30.0h0"


ENTRIES = st.lists(
    st.tuples(
        st.sampled_from([None, 1, 2]),
        st.integers(0, 400).map(lambda frame: frame / 10),
        st.floats(-20, 300, width=32).map(lambda x: round(x, 2)),
        st.integers(0, 40).map(float),
    ),
    min_size=1,
    max_size=30,
)


@given(ENTRIES)
@settings(max_examples=10, deadline=None)
def test_cells_hold_the_mean_speed_of_their_entries(open_lake, entries):
    rows = [
        {"vehicle_id": number, "frame": round(time_s * 10), "lane": lane, "time_s": time_s, "x_m": x_m, "speed_mps": v}
        for number, (lane, time_s, x_m, v) in enumerate(entries)
    ]
    where = {"dataset": "highd", "subset": "01-upper"}
    other = {**where, "subset": "01-lower", "vehicle_id": 0, "frame": 1, "time_s": 0.0, "x_m": 9e3, "speed_mps": 99.0}
    lake = open_lake(tracks=[{**where, "y_m": 0.0, **row} for row in rows] + [{"y_m": 0.0, **other}])
    extent = query(lake, "subset_extent", where)[0]
    grid = make_grid(extent)
    assert grid.columns <= COLUMNS
    assert grid.rows <= ROWS
    cells = query_frame(lake, "subset_time_space", {**where, **grid.parameters()})
    expected: dict[tuple, list[float]] = {}
    first_s, first_x = min(row["time_s"] for row in rows), min(row["x_m"] for row in rows)
    for row in rows:
        column = math.floor((row["time_s"] - first_s) / grid.seconds)
        cell = (row["lane"], column, math.floor((row["x_m"] - first_x) / grid.metres))
        expected.setdefault(cell, []).append(row["speed_mps"])
    found = {(lane, column, row): speed for lane, column, row, speed in cells.rows()}
    assert found.keys() == expected.keys()
    for cell, speeds in expected.items():
        assert found[cell] == pytest.approx(sum(speeds) / len(speeds))
        assert 0 <= cell[1] < grid.columns
        assert 0 <= cell[2] < grid.rows


GRID = Grid(first_s=0.0, seconds=1.0, columns=3, first_x_m=10.0, metres=5.0, rows=2, top_mps=30.0)


def test_the_roads_end_is_uppermost():
    cells = pl.DataFrame({"lane": [1, 1], "grid_column": [0, 2], "grid_row": [0, 1], "speed_mps": [7.0, 9.0]})
    speeds = rasterise(GRID, cells)
    assert speeds.shape == (2, 3)
    assert (speeds[1, 0], speeds[0, 2]) == (7.0, 9.0)
    assert np.isnan(speeds).sum() == 4


def test_every_lane_has_its_diagram_and_its_marks():
    cells = pl.DataFrame(
        {"lane": [None, 1, 2], "grid_column": [0, 0, 1], "grid_row": [0, 0, 1], "speed_mps": [1.0, 2.0, 3.0]},
        schema_overrides={"lane": pl.Int16},
    )
    marks = pl.DataFrame({"lane": [2], "grid_column": [0], "grid_row": [0]}, schema_overrides={"lane": pl.Int16})
    drawn = dict(draw_lanes(GRID, cells, marks))
    assert list(drawn) == [None, 1, 2]
    assert [svg.count("l6 6m0-6l-6 6") for svg in drawn.values()] == [0, 0, 2], "a cross and its halo"
    for svg in drawn.values():
        assert "position (m)" in svg
        assert "time since the recording began (s)" in svg
        assert len(re.findall(r'href="data:image/png;base64,[A-Za-z0-9+/=]+"', svg)) == 1


@pytest.mark.parametrize(
    ("speeds", "ends"),
    [
        ([0, 12, 20], (0.0, 21.0)),
        ([24, 30, 33], (23.0, 34.0)),
        ([-3, 5], (-3.0, 6.0)),
        ([5], (4.0, 10.0)),
    ],
)
def test_a_speed_axis_is_not_half_empty(speeds, ends):
    assert find_speed_range(speeds) == ends
