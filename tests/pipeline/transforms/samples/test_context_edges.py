"""Edge cases of samples and their context, whole: every one against the slow loops of slow_context.py."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_context import fill_grid, judge, label, list_nearest, put_on_clock

from tracklake.pipeline.transforms.samples.selection import draw_samples
from tracklake.schemas.missing_starts import MISSING_STARTS
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.samples import NEIGHBORS, SAMPLE_COUNTS, SAMPLE_DROPS, SAMPLES

INT32_MAX = 2**31 - 1
RATES = [(25.0, 10), (25.0, 5), (10.0, 10), (10.0, 5)]
IDS = st.sampled_from([0, 1, 2, 7, 900, INT32_MAX - 1, INT32_MAX])
LANES = st.integers(0, 3)
STEPS = st.integers(-200, 1500)
"""Millimetres a frame."""


@st.composite
def tracks(draw, vehicle, *, frames=None, lanes=LANES, x=None):
    """Entries of one vehicle: speeds and lanes change on the way."""
    if frames is None:
        first = draw(st.integers(1, 12))
        frames = range(first, first + draw(st.integers(1, 40)))
    x_mm, y_mm, lane = draw(st.integers(0, 40_000)) if x is None else x, draw(st.integers(0, 12_000)), draw(lanes)
    changes = draw(st.dictionaries(st.integers(1, 40), st.tuples(lanes, STEPS), max_size=3))
    step, entries = draw(STEPS), []
    for frame in frames:
        lane, step = changes.get(frame, (lane, step))
        x_mm += step
        entries.append((vehicle, frame, x_mm, y_mm, lane))
    return entries


def together(draw, ids, **how):
    return [entry for vehicle in sorted(ids) for entry in draw(tracks(vehicle, **how))]


@st.composite
def one_vehicle(draw):
    return draw(tracks(draw(IDS)))


@st.composite
def one_frame(draw):
    return together(draw, draw(st.sets(IDS, min_size=1)), frames=[draw(st.integers(1, 6))])


@st.composite
def shorter_than_any_window(draw):
    """Too short for three positions at 5 Hz; at 10 Hz some are just long enough."""
    first = draw(st.integers(1, 4))
    frames = range(first, first + draw(st.integers(1, 6)))
    return together(draw, draw(st.sets(IDS, min_size=1)), frames=frames)


@st.composite
def side_by_side(draw):
    """The second does all that the first does, in its lane or the next."""
    own = draw(tracks(1, lanes=st.integers(1, 2)))
    apart, other = draw(st.integers(-1, 1)), draw(st.sampled_from([0, 2, INT32_MAX]))
    return sorted([*own, *((other, frame, x, y + 3500 * apart, lane + apart) for _, frame, x, y, lane in own)])


@st.composite
def lane_zero(draw):
    return together(draw, draw(st.sets(IDS, min_size=1, max_size=4)), lanes=st.integers(0, 1))


@st.composite
def leaves_and_returns(draw):
    """Gaps from one frame to longer than a history, and somebody to see it all."""
    first, away = draw(st.integers(1, 25)), draw(st.integers(1, 30))
    frames = [*range(1, 1 + first), *range(1 + first + away, 1 + first + away + draw(st.integers(1, 25)))]
    return [*draw(tracks(1, frames=frames)), *draw(tracks(2, frames=range(1, 50)))]


@st.composite
def all_in_one_cell(draw):
    """Within two metres of one another, more than a lane of the grid holds."""
    frames = [*range(1, draw(st.integers(8, 14)))]
    speed = draw(STEPS)
    entries = []
    for vehicle in range(draw(st.integers(2, 17))):
        x, y, lane = draw(st.integers(0, 40)) * 50, draw(st.integers(0, 3)) * 1000, draw(st.sampled_from([1, 1, 1, 2]))
        entries += [(vehicle, frame, x + speed * frame, y, lane) for frame in frames]
    return entries


SCENES = {
    scene.__name__: scene()
    for scene in (
        one_vehicle, one_frame, shorter_than_any_window, side_by_side, lane_zero, leaves_and_returns, all_in_one_cell,
    )
}  # fmt: skip


def draw_from(entries, protocol, frame_rate_hz, *, early=(), findings=()):
    dtypes = {"vehicle_id": pl.Int32, "frame": pl.Int32, "x_m": pl.Float64, "y_m": pl.Float64, "lane": pl.Int16}
    rows = [(vehicle, frame, x / 1000, y / 1000, lane) for vehicle, frame, x, y, lane in entries]
    found = {"vehicle_id": pl.Int32, "severity": pl.String, "first_frame": pl.Int32, "last_frame": pl.Int32}
    ids = sorted({vehicle for vehicle, *_ in entries})
    return draw_samples(
        pl.DataFrame(rows, schema=dtypes, orient="row"),
        pl.DataFrame({"vehicle_id": ids, "early": [vehicle in early for vehicle in ids]}),
        MISSING_STARTS.empty(),
        pl.DataFrame(findings, schema=found, orient="row"),
        protocol=protocol,
        dataset="highd",
        subset="01-upper",
        first_frame=1,
        frame_rate_hz=frame_rate_hz,
        excluded=False,
    )


@pytest.mark.parametrize("scene", SCENES)
@settings(max_examples=10, deadline=None)
@given(st.data(), st.sampled_from(RATES))
def test_agrees_with_loops_over_entries(scene, data, rates):
    entries = data.draw(SCENES[scene])
    frame_rate_hz, rate_hz = rates
    protocol = Protocol(
        "short", rate_hz=rate_hz, history_s=0.4, horizon_s=1.0, nearest=data.draw(st.integers(0, 4)),
        drop_error_findings=data.draw(st.booleans()),
    )  # fmt: skip
    early = data.draw(st.sets(IDS, max_size=1))
    spans = st.tuples(IDS, st.sampled_from(["error", "info"]), st.integers(1, 45), st.integers(0, 5))
    findings = [(who, severity, first, first + more) for who, severity, first, more in data.draw(st.lists(spans))]

    rules = {"first_frame": 1, "frame_rate_hz": frame_rate_hz}
    clock = put_on_clock(entries, rate_hz=rate_hz, **rules)
    samples, around, drops, collisions, crowded_out = [], [], {}, 0, 0
    for vehicle, tick in sorted(clock):
        reason = judge(clock, vehicle, tick, protocol, early=early, findings=findings, **rules)
        if reason:
            drops[reason] = drops.get(reason, 0) + 1
            continue
        nearest = list_nearest(clock, vehicle, tick, protocol.nearest) if protocol.nearest else None
        place = clock[vehicle, tick]
        samples.append((vehicle, tick, place.frame, place.lane, *label(clock, vehicle, tick, rate_hz), nearest))
        grid, moved, homeless = fill_grid(clock, vehicle, tick)
        around += [(vehicle, tick, cell, *neighbor) for cell, neighbor in sorted(grid.items())]
        collisions, crowded_out = collisions + moved, crowded_out + homeless

    drawn = draw_from(entries, protocol, frame_rate_hz, early=early, findings=findings)
    assert drawn[SAMPLES].drop("protocol", "dataset", "subset").rows() == samples
    assert dict(drawn[SAMPLE_DROPS].select("reason", "entries").iter_rows()) == drops
    found = drawn[NEIGHBORS].drop("protocol", "dataset", "subset")
    assert found.rows() == [(*row[:4], float(np.float32(row[4] / 2000))) for row in around]
    counts = (len(clock), len(samples), len(around), collisions, crowded_out)
    assert drawn[SAMPLE_COUNTS].drop("protocol", "dataset", "subset", "all_collisions").row(0) == counts


def test_the_scenes_give_samples_and_collisions():
    """Fifteen on one spot of a lane: around each are 14 for 13 cells, of whom 13 find their cell taken."""
    entries = [(vehicle, frame, 1000 * frame, 0, 1) for vehicle in range(15) for frame in range(1, 10)]
    drawn = draw_from(entries, Protocol("short", rate_hz=10, history_s=0.4, nearest=3), 10.0)
    assert drawn[SAMPLES]["tick"].unique().to_list() == [4, 5, 6]
    assert drawn[SAMPLES]["nearest"].to_list()[:6:3] == [[1, 2, 3], [0, 2, 3]]
    names = ("entries_on_clock", "samples", "neighbors", "collisions", "crowded_out")
    assert drawn[SAMPLE_COUNTS].select(names).row(0) == (135, 45, 45 * 13, 45 * 13, 45)
