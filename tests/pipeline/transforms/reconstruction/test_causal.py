"""The causal filter against a textbook loop over one vehicle at a time; nothing of the future enters."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.reconstruction import causal
from tracklake.pipeline.transforms.reconstruction.causal import filter_tracks

SCHEMA = {"vehicle_id": pl.Int32, "frame": pl.Int32, "x_m": pl.Float64, "y_m": pl.Float64}


def make_tracks(rows):
    return pl.DataFrame(rows, schema=SCHEMA, orient="row")


def facts(rate):
    return {"frame_rate_hz": rate}


def textbook(entries, rate, axis):
    """frame -> state, one entry after another; axis 0 along, 1 across."""
    if axis == 0:
        size, density, noise = 3, causal.JERK_M2PS5, causal.NOISE_X_M
        start = [causal.START_SPEED_MPS, causal.START_ACCEL_MPS2]
    else:
        size, density, noise = 2, causal.LATERAL_ACCEL_M2PS3, causal.NOISE_Y_M
        start = [causal.START_LATERAL_SPEED_MPS]
    observe = np.eye(1, size)
    found, before = {}, None
    for frame, *position in entries:
        z = position[axis]
        if before is None or (frame - before) / rate > 2.0:
            state = np.array([z, *(mean for mean, _ in start)])
            cov = np.diag([noise**2, *(sigma**2 for _, sigma in start)])
        else:
            dt = (frame - before) / rate
            if size == 3:
                move = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]])
                added = np.array(
                    [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
                )
            else:
                move = np.array([[1, dt], [0, 1]])
                added = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            state, cov = move @ state, move @ cov @ move.T + density * added
            total = (observe @ cov @ observe.T).item() + noise**2
            surprise = z - state[0]
            share = surprise**2 / total / 9
            if share > 1:
                total += noise**2 * (share - 1)
            gain = (cov @ observe.T)[:, 0] / total
            state = state + gain * surprise
            cov = (np.eye(size) - np.outer(gain, observe[0])) @ cov
            found[frame] = state
        before = frame
    return found


ENTRIES = st.lists(
    st.tuples(st.integers(0, 2**31 - 1).map(lambda n: n % 3 if n % 7 else 2**31 - 1), st.integers(0, 120)),
    unique=True,
    max_size=60,
)


def scatter(places, seed):
    rng = np.random.default_rng(seed)
    return [
        (vehicle, frame, 2.0 * frame + rng.normal(0, 1), 5 + rng.normal(0, 0.2) + 3 * (rng.random() < 0.05))
        for vehicle, frame in places
    ]


@settings(max_examples=40, deadline=None)
@given(ENTRIES, st.integers(0, 99), st.sampled_from((10.0, 25.0)))
def test_agrees_with_the_textbook_vehicle_by_vehicle(places, seed, rate):
    rows = scatter(places, seed)
    found = filter_tracks(make_tracks(rows), facts(rate))
    expected = []
    for vehicle in sorted({row[0] for row in rows}):
        own = sorted(row[1:] for row in rows if row[0] == vehicle)
        along, across = textbook(own, rate, 0), textbook(own, rate, 1)
        expected += [
            (vehicle, frame, x[0], across[frame][0], x[1], x[2], across[frame][1]) for frame, x in along.items()
        ]
    assert found.columns == [*SCHEMA, "speed_mps", "accel_mps2", "lateral_speed_mps"]
    assert [row[:2] for row in found.rows()] == [row[:2] for row in expected]
    for row, wanted in zip(found.rows(), expected, strict=True):
        assert row == pytest.approx(wanted, rel=1e-5, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(ENTRIES, st.integers(0, 99), st.integers(0, 120), st.sampled_from((10.0, 25.0)))
def test_later_entries_change_no_earlier_estimate(places, seed, moment, rate):
    """Later entries of every vehicle are moved, and in a second variant left out."""
    rows = scatter(places, seed)
    now = filter_tracks(make_tracks(rows), facts(rate)).filter(pl.col("frame") <= moment)
    moved = [(v, f, x + 500.0 * (f > moment), y - 7.0 * (f > moment)) for v, f, x, y in rows]
    for variant in (moved, [row for row in rows if row[1] <= moment]):
        again = filter_tracks(make_tracks(variant), facts(rate)).filter(pl.col("frame") <= moment)
        assert again.equals(now)


def test_row_order_does_not_matter_and_an_empty_subset_is_empty():
    rows = scatter([(vehicle, frame) for vehicle in (4, 1) for frame in range(30)], 1)
    assert filter_tracks(make_tracks(rows), facts(10)).equals(filter_tracks(make_tracks(rows[::-1]), facts(10)))
    assert filter_tracks(make_tracks([]), facts(10)).is_empty()


@pytest.mark.parametrize("rate", [10, 25])
def test_steady_driving_is_estimated_better_than_it_was_recorded(rate):
    """30 s at 20 m/s, noise of 0.25 m: from 3 s on, differences err by 3.5 m/s or more, the filter by 0.5."""
    frames = np.arange(30 * rate)
    truth = 20.0 * frames / rate
    recorded = truth + np.random.default_rng(5).normal(0, causal.NOISE_X_M, len(frames))
    rows = [(1, int(frame), x, 2.0) for frame, x in zip(frames, recorded, strict=True)]
    found = filter_tracks(make_tracks(rows), facts(rate)).filter(pl.col("frame") >= 3 * rate)
    position = np.sqrt(np.mean((found["x_m"].to_numpy() - truth[3 * rate :]) ** 2))
    speed = np.sqrt(np.mean((found["speed_mps"].to_numpy() - 20.0) ** 2))
    assert position < 0.18
    assert speed < 0.5 < np.std(np.diff(recorded) * rate)
    assert found["lateral_speed_mps"].abs().max() < 1e-3


def test_a_jump_of_the_camera_gives_no_impossible_speed():
    """One position 3 m ahead hardly counts, all from there on are followed; after 100 m, the tables' range holds."""
    for jump, stays, limit in ((3.0, False, 20.5), (3.0, True, 25.5), (100.0, True, 100.0)):
        ahead = [jump * (frame >= 100 if stays else frame == 100) for frame in range(200)]
        found = filter_tracks(make_tracks([(1, f, 2.0 * f + ahead[f], 2.0) for f in range(200)]), facts(10))
        assert 20.0 < found["speed_mps"].max() <= limit
        assert found["x_m"][-1] == pytest.approx(398.0 + ahead[-1], abs=0.05)


def test_after_a_long_gap_the_filter_begins_again():
    """20 frames at 10 Hz are bridged, 21 are not: the entry after them has no estimate."""
    for gap, begins in ((20, False), (21, True)):
        frames = [0, 1, 2, 2 + gap, 3 + gap]
        found = filter_tracks(make_tracks([(1, frame, 1.5 * frame, 0.0) for frame in frames]), facts(10))
        assert ((2 + gap) not in found["frame"].to_list()) is begins
