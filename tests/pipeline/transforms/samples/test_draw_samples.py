"""Every entry on the clock is a sample or is dropped for one reason, the first that applies."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.samples.selection import DROP_REASONS, draw_samples
from tracklake.schemas.findings import FINDINGS
from tracklake.schemas.missing_starts import MISSING_STARTS
from tracklake.schemas.protocols import CSP, Protocol
from tracklake.schemas.samples import NEIGHBORS, SAMPLE_COUNTS, SAMPLE_DROPS, SAMPLES

SHORT = Protocol(name="short", rate_hz=5, history_s=0.4, min_future_s=0.2)
"""Three positions of history, one of future."""
INT32_MAX = 2**31 - 1


def make_tracks(entries):
    """(vehicle_id, frame, x_m, lane) rows."""
    rows = [(vehicle, frame, x, 0.0, lane, 1.0) for vehicle, frame, x, lane in entries]
    schema = {
        "vehicle_id": pl.Int32,
        "frame": pl.Int32,
        "x_m": pl.Float64,
        "y_m": pl.Float64,
        "lane": pl.Int16,
        "speed_mps": pl.Float32,
    }
    return pl.DataFrame(rows, schema=schema, orient="row")


def make_missing(rows):
    """(vehicle_id, lane, cutoff_m, start_x_m, start_frame, first_missing_frame) rows."""
    names = ("vehicle_id", "lane", "cutoff_m", "start_x_m", "start_frame", "first_missing_frame")
    return pl.DataFrame(rows, schema={name: MISSING_STARTS.dtypes[name] for name in names}, orient="row")


def make_findings(rows):
    """(vehicle_id, severity, first_frame, last_frame) rows."""
    names = ("vehicle_id", "severity", "first_frame", "last_frame")
    return pl.DataFrame(rows, schema={name: FINDINGS.dtypes[name] for name in names}, orient="row")


def draw(
    entries,
    *,
    early=(),
    missing=(),
    findings=(),
    protocol=SHORT,
    first_frame=0,
    frame_rate_hz=10.0,
    excluded=False,
    last_lane=None,
):
    """Draw, validate, and check that nothing is lost: tables and {reason: entries}."""
    ids = sorted({vehicle for vehicle, *_ in entries})
    starts = pl.DataFrame(
        {"vehicle_id": ids, "early": [vehicle in early for vehicle in ids]},
        schema={"vehicle_id": pl.Int32, "early": pl.Boolean},
    )
    drawn = draw_samples(
        make_tracks(entries),
        starts,
        make_missing(list(missing)),
        make_findings(list(findings)),
        protocol=protocol,
        dataset="highd",
        subset="01-upper",
        first_frame=first_frame,
        frame_rate_hz=frame_rate_hz,
        excluded=excluded,
        last_lane=last_lane,
    )
    SAMPLES.validate(drawn[SAMPLES], where="test")
    SAMPLE_DROPS.validate(drawn[SAMPLE_DROPS], where="test")
    NEIGHBORS.validate(drawn[NEIGHBORS], where="test")
    drops = dict(drawn[SAMPLE_DROPS].select("reason", "entries").iter_rows())
    SAMPLE_COUNTS.validate(drawn[SAMPLE_COUNTS], where="test")
    assert set(drops) <= set(DROP_REASONS)
    counts = drawn[SAMPLE_COUNTS].row(0, named=True)
    assert counts["samples"] == drawn[SAMPLES].height
    assert counts["neighbors"] == drawn[NEIGHBORS].height
    assert drawn[SAMPLES].height + sum(drops.values()) == counts["entries_on_clock"]
    return drawn, drops


def count(drawn, name):
    return drawn[SAMPLE_COUNTS][name].item()


def drive(vehicle, frames, *, lane=1, x_m=0.0):
    return [(vehicle, frame, x_m + frame, lane) for frame in frames]


def test_lanes_beyond_the_last_count_as_the_last():
    """1 changes from lane 6 to 7, abreast of 2, 20 m ahead in lane 8: of no meaning where lanes from 6 on are one."""
    entries = [(1, frame, float(frame), 6 if frame < 10 else 7) for frame in range(21)] + drive(
        2, range(21), lane=8, x_m=20
    )
    drawn, _ = draw(entries)
    assert set(drawn[SAMPLES].filter(vehicle_id=1)["lateral_maneuver"]) == {"right"}
    assert set(drawn[NEIGHBORS].filter(vehicle_id=1)["cell"]) == {26 + 10}, "the right lane, from frame 10 on"
    folded, _ = draw(entries, last_lane=6)
    assert set(folded[SAMPLES]["lateral_maneuver"]) == {"keep"}
    assert set(folded[SAMPLES]["lane"]) == {6}
    ahead = folded[NEIGHBORS].filter(vehicle_id=1)
    assert (ahead.height, set(ahead["cell"])) == (folded[SAMPLES].filter(vehicle_id=1).height, {13 + 10}), (
        "the own lane"
    )


def test_collisions_are_counted_over_all_entries_at_10_hz():
    """Three vehicles within 2 m of each other in 21 frames: each of the 63 grids has two others in one cell."""
    entries = drive(1, range(21)) + drive(2, range(21), x_m=1) + drive(3, range(21), x_m=2)
    drawn, _ = draw(entries)
    assert (count(drawn, "all_collisions"), count(drawn, "collisions")) == (63, drawn[SAMPLES].height)
    excluded, _ = draw(entries, excluded=True)
    assert (count(excluded, "all_collisions"), count(excluded, "collisions")) == (63, 0)
    slower, _ = draw(entries, frame_rate_hz=5.0)
    assert count(slower, "all_collisions") is None
    unknown, _ = draw([*entries, (4, 0, 0.0, None)])
    assert count(unknown, "all_collisions") is None


def test_history_and_future_are_inclusive():
    """Ticks 0 to 10: ticks 0 and 1 lack history, tick 10 lacks a future."""
    drawn, drops = draw(drive(1, range(21)))
    assert drawn[SAMPLES]["tick"].to_list() == list(range(2, 10))
    assert drawn[SAMPLES]["frame"].to_list() == list(range(4, 20, 2))
    assert drops == {"short_history": 2, "short_future": 1}


@pytest.mark.parametrize(("rate_hz", "history"), [(5, 16), (10, 31)])
def test_three_seconds_are_16_positions_at_5_hz_and_31_at_10_hz(rate_hz, history):
    protocol = Protocol(name="p", rate_hz=rate_hz)
    last_of_history = (history - 1) * 10 // rate_hz  # frames at 10 Hz; 0.2 s more are needed
    assert draw(drive(1, range(last_of_history + 2)), protocol=protocol)[0][SAMPLES].is_empty()
    drawn, drops = draw(drive(1, range(last_of_history + 3)), protocol=protocol)
    assert drawn[SAMPLES]["tick"].to_list() == [history - 1]
    assert drops == {"short_history": history - 1, "short_future": 2 * rate_hz // 10}


def test_a_full_future_is_a_parameter():
    drawn, drops = draw(drive(1, range(150)), protocol=Protocol(name="full", min_future_s=5.0))
    assert drawn[SAMPLES]["tick"].to_list() == list(range(15, 50))  # ticks 0 to 74
    assert drops == {"short_history": 15, "short_future": 25}


def test_a_gap_begins_history_and_ends_future_anew():
    """Frames 10 and 11 are missing: ticks 0 to 4 and 6 to 10."""
    drawn, drops = draw(drive(1, [*range(10), *range(12, 21)]))
    assert drawn[SAMPLES]["tick"].to_list() == [2, 3, 8, 9]
    assert drops == {"short_history": 4, "short_future": 2}


def test_a_vehicle_that_returns_is_not_joined_to_the_next():
    drawn, drops = draw([*drive(1, [*range(3), *range(40, 43)]), *drive(2, range(43, 46))])
    assert drawn[SAMPLES].is_empty()
    assert drops == {"short_history": 5}  # ticks 0, 1; 20, 21; 22


def test_early_vehicles_give_no_samples_but_are_neighbors():
    drawn, drops = draw([*drive(1, range(21)), *drive(2, range(21), x_m=10.0)], early=(2,))
    assert drops == {"short_history": 4, "short_future": 2, "early_vehicle": 8}
    assert drawn[SAMPLES]["vehicle_id"].unique().to_list() == [1]
    assert drawn[NEIGHBORS]["neighbor_id"].to_list() == [2] * 8
    assert drawn[NEIGHBORS]["cell"].to_list() == [13 + 8] * 8  # 10 / 4.572 = 2.19


def test_would_be_neighbors_give_no_samples_at_those_frames():
    """A vehicle is missing on frames 7 to 11: ticks 4 and 5."""
    drawn, drops = draw(drive(1, range(21)), missing=[(9, 2, 0.0, 10.0, 12, 7)])
    assert drawn[SAMPLES]["tick"].to_list() == [2, 3, 6, 7, 8, 9]
    assert drops["would_be_neighbor"] == 2


def test_the_first_reason_counts():
    tracks = drive(1, range(3))
    everything = {"early": (1,), "missing": [(9, 1, 0.0, 10.0, 50, 0)]}
    assert draw(tracks, **everything, excluded=True)[1] == {"excluded_subset": 2}
    assert draw([(v, f, x, None) for v, f, x, _ in tracks], excluded=True)[1] == {"excluded_subset": 2}
    assert draw([(v, f, x, None) for v, f, x, _ in tracks], **everything)[1] == {"no_lane": 2}
    assert draw(tracks, **everything)[1] == {"short_history": 2}
    tracks = drive(1, range(7))
    assert draw(tracks, **everything)[1] == {"short_history": 2, "short_future": 1, "early_vehicle": 1}


def test_one_unknown_lane_is_enough_to_pass_the_subset_by():
    entries = drive(1, range(21))
    entries[3] = (*entries[3][:3], None)
    drawn, drops = draw(entries)
    assert drops == {"no_lane": 11}
    assert drawn[SAMPLES].is_empty()
    assert drawn[NEIGHBORS].is_empty()


def test_labels_and_clock_of_interpolated_samples():
    """25 to 10 Hz: odd ticks lie between frames. The lane changes to the right at frame 150."""
    entries = [(1, frame, 1.2 * frame, 1 if frame < 150 else 2) for frame in range(1, 301)]
    drawn, _ = draw(entries, protocol=Protocol(name="csp10", rate_hz=10), first_frame=1, frame_rate_hz=25.0)
    samples = drawn[SAMPLES]
    assert samples.select("tick", "frame").head(3).rows() == [(30, 76), (31, None), (32, 81)]
    assert samples.filter(pl.col("lane") == 2)["tick"].min() == 60  # frame 151; tick 59 lies at 148.5
    changes = samples.filter(lateral_maneuver="right")["tick"]
    # From 4 s before the first tick in lane 2 to 4 s after the last one in lane 1.
    assert (changes.min(), changes.max(), len(changes)) == (30, 99, 70)
    assert samples["longitudinal_maneuver"].unique().to_list() == ["normal"]


def test_collisions_are_counted_for_samples_only():
    """Three vehicles on one spot to the right; the lone sample is vehicle 1 at tick 2."""
    entries = [*drive(1, range(7)), *(e for v in (2, 3, 4) for e in drive(v, range(4, 7), lane=2))]
    drawn, _ = draw(entries)
    assert drawn[SAMPLES].select("vehicle_id", "tick").rows() == [(1, 2)]
    assert drawn[NEIGHBORS].select("neighbor_id", "cell").rows() == [(4, 31), (2, 32), (3, 33)]
    assert (count(drawn, "collisions"), count(drawn, "crowded_out")) == (2, 0)


ERRORS = Protocol(name="errors", rate_hz=5, history_s=0.4, horizon_s=0.6, min_future_s=0.2, drop_error_findings=True)
"""At 10 Hz the history begins 4 frames before the entry, the horizon ends 6 after it."""


@pytest.mark.parametrize(
    ("first", "last", "dropped"),
    [
        (20, 20, range(14, 25, 2)),
        (21, 21, range(16, 26, 2)),
        (19, 22, range(14, 27, 2)),
        (0, 90, range(4, 39, 2)),
        (90, 95, ()),
    ],
)
def test_findings_of_errors_drop_what_they_touch_where_the_protocol_says_so(first, last, dropped):
    """Samples at frames 4 to 38: dropped where [frame - 4, frame + 6] and the finding have a frame in common."""
    findings = [(1, "error", first, last)]
    kept = [frame for frame in range(4, 39, 2) if frame not in dropped]
    drawn, drops = draw(drive(1, range(41)), findings=findings, protocol=ERRORS)
    assert drawn[SAMPLES]["frame"].to_list() == kept
    assert drops.get("error_finding", 0) == len(dropped)
    ignoring, _ = draw(drive(1, range(41)), findings=findings, protocol=replace(ERRORS, drop_error_findings=False))
    assert ignoring[SAMPLES].height == 18


def test_findings_of_others_and_of_less_than_errors_drop_nothing():
    tracks = [*drive(1, range(41)), *drive(INT32_MAX, range(41), lane=2)]
    drawn, drops = draw(
        tracks, findings=[(0, "error", 0, 40), (1, "warning", 0, 40), (2, "error", 0, 40)], protocol=ERRORS
    )
    assert drawn[SAMPLES].height == 36
    assert "error_finding" not in drops
    drawn, drops = draw(tracks, findings=[(INT32_MAX, "error", 0, 40), (INT32_MAX, "error", 3, 3)], protocol=ERRORS)
    assert drawn[SAMPLES]["vehicle_id"].unique().to_list() == [1]
    assert drops["error_finding"] == 18
    assert drawn[NEIGHBORS]["neighbor_id"].unique().to_list() == [INT32_MAX]  # its track stays


@pytest.mark.parametrize(
    ("frame", "ticks"), [(33, range(7, 16)), (34, range(7, 16)), (35, range(8, 16)), (36, range(8, 17))]
)
def test_a_tick_between_two_frames_is_made_of_both(frame, ticks):
    """25 Hz on 10 Hz: tick k lies at frame 1 + 2.5 k, the window is [k - 2, k + 6]; frames 33 and 34 make tick 13."""
    protocol = Protocol(name="errors", rate_hz=10, history_s=0.2, horizon_s=0.6, drop_error_findings=True)
    drawn, drops = draw(
        drive(1, range(1, 102)),
        findings=[(1, "error", frame, frame)],
        protocol=protocol,
        first_frame=1,
        frame_rate_hz=25.0,
    )
    assert [tick for tick in range(2, 39) if tick not in drawn[SAMPLES]["tick"].to_list()] == list(ticks)
    assert drops["error_finding"] == len(ticks)


def test_the_future_lasts_at_least_as_long_as_asked_for():
    """0.5 s at 5 Hz are three ticks, for two are too few; what is a whole number of ticks but for rounding stays it."""
    assert [Protocol("p", min_future_s=seconds).min_future_ticks for seconds in (0.01, 0.2, 0.5, 0.6, 5.0)] == [
        1,
        1,
        3,
        3,
        25,
    ]


def test_no_entries_and_one_entry():
    drawn, drops = draw([])
    assert (count(drawn, "entries_on_clock"), drops) == (0, {})
    for excluded in (False, True):
        assert draw([], excluded=excluded)[0][SAMPLES].is_empty()
    _, drops = draw([(INT32_MAX, 0, 5.0, 0)])
    assert drops == {"short_history": 1}
    drawn, drops = draw([(1, 1, 5.0, 0)])  # not on the clock
    assert (count(drawn, "entries_on_clock"), drops) == (0, {})


def test_the_default_protocol():
    """20 s at 25 Hz are 100 ticks at 5 Hz: 15 without history, 1 without a future."""
    drawn, drops = draw(drive(1, range(1, 501)), protocol=CSP, first_frame=1, frame_rate_hz=25.0)
    assert drawn[SAMPLES]["protocol"].unique().to_list() == ["csp"]
    assert drawn[SAMPLES]["frame"].to_list() == list(range(76, 496, 5))
    assert drops == {"short_history": 15, "short_future": 1}


@st.composite
def traffic(draw_from):
    entries = []
    for vehicle in sorted(draw_from(st.sets(st.sampled_from([0, 1, 2, 3, INT32_MAX]), max_size=4))):
        first = draw_from(st.integers(0, 20))
        missing = draw_from(st.sets(st.integers(0, 30), max_size=2))
        x0, lane = draw_from(st.integers(0, 90)), draw_from(st.integers(0, 3))
        frames = [f for f in range(first, first + draw_from(st.integers(1, 30))) if f - first not in missing]
        entries += [(vehicle, f, float(x0 + f), lane) for f in frames]
    return entries


@settings(max_examples=20, deadline=None)
@given(
    traffic(),
    st.sets(st.sampled_from([0, 1, 2]), max_size=1),
    st.lists(st.tuples(st.integers(0, 3), st.integers(1, 40), st.integers(1, 45), st.integers(1, 20)), max_size=2),
)
def test_agrees_with_a_loop_over_entries(entries, early, windows):
    """At 10 Hz on a 5 Hz clock: kept entries and reasons, one at a time."""
    missing = [(99, lane, 0.0, float(x), start, max(0, start - frames)) for lane, x, start, frames in windows]
    frames_of = {}
    for vehicle, frame, _, _ in entries:
        frames_of.setdefault(vehicle, set()).add(frame)
    kept, drops = [], {}
    for vehicle, frame, x, lane in entries:
        if frame % 2:
            continue
        reason = None
        if not set(range(frame - 4, frame + 1)) <= frames_of[vehicle]:
            reason = "short_history"
        elif not {frame + 1, frame + 2} <= frames_of[vehicle]:
            reason = "short_future"
        elif vehicle in early:
            reason = "early_vehicle"
        else:
            for _, other_lane, cutoff_m, start_x_m, start, first in missing:
                if first <= frame <= start - 1:
                    would_be = cutoff_m + (start_x_m - cutoff_m) * (frame - first) / (start - first)
                    if abs(x - would_be) <= 40 + 1e-9 and abs(lane - other_lane) <= 1:
                        reason = "would_be_neighbor"
        if reason:
            drops[reason] = drops.get(reason, 0) + 1
        else:
            kept.append((vehicle, frame // 2))
    drawn, found = draw(entries, early=early, missing=missing)
    assert drawn[SAMPLES].select("vehicle_id", "tick").rows() == kept
    assert found == drops
    others = {(v, f // 2) for v, f, _, _ in entries if f % 2 == 0}
    for vehicle, tick, other in drawn[NEIGHBORS].select("vehicle_id", "tick", "neighbor_id").iter_rows():
        assert (vehicle, tick) in kept
        assert (other, tick) in others
        assert other != vehicle


def test_dense_traffic_gives_every_table_its_types():
    rng = np.random.default_rng(3)
    entries = [
        (vehicle, frame, float(x0 + 1.2 * frame), vehicle % 5 + 1)
        for vehicle, x0 in enumerate(rng.uniform(0, 640, 60))
        for frame in range(120)
    ]
    drawn, drops = draw(entries, protocol=CSP)
    assert drawn[SAMPLES].height == 60 * (60 - 15 - 1)
    assert drops == {"short_history": 60 * 15, "short_future": 60}
    # Positions relative to one another never change, so every vehicle has as many neighbors at each of its samples.
    assert drawn[NEIGHBORS].height % 44 == 0
    assert drawn[NEIGHBORS].height > 0
