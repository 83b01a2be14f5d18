"""The gap to the leader, by hand and against a slow loop."""

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.gaps import add_gaps

GAP_SCHEMA = {
    "vehicle_id": pl.Int32,
    "frame": pl.Int32,
    "x_m": pl.Float64,
    "leader_id": pl.Int32,
    "headway_recorded_m": pl.Float32,
}


@pytest.mark.parametrize("use_recorded", [True, False])
def test_gaps_by_hand(use_recorded):
    tracks = pl.DataFrame(
        [
            (1, 1, 10.0, 2, 99.0),  # 30 - 4.5 - 10, whatever was recorded
            (1, 2, 11.0, 2, 20.25),  # the leader has no entry: 20.25 - 4.5, if recorded headways count
            (1, 3, 12.0, 2, None),  # no entry, nothing recorded
            (1, 4, 13.0, 8, 20.0),  # an unknown leader
            (1, 5, 14.0, None, 20.0),  # no leader
            (1, 6, 15.0, 3, 20.0),  # a leader of unknown length
            (1, 7, 9.9996, None, None),
            (2, 1, 30.0, None, None),
            (2, 7, 10.0004, 1, None),  # overlap: 9.9996 - 5 - 10.0004, to the millimetre
            (3, 6, 50.0, None, None),
        ],
        schema=GAP_SCHEMA,
        orient="row",
    )
    vehicles = pl.DataFrame(
        {"vehicle_id": [1, 2, 3], "length_m": [5.0, 4.5, None]}, schema_overrides={"vehicle_id": pl.Int32}
    )
    found = add_gaps(tracks, vehicles, use_recorded_headway=use_recorded)
    second = 15.75 if use_recorded else None
    assert found["gap_m"].to_list() == [15.5, second, None, None, None, None, None, None, -5.001, None]
    assert found.drop("gap_m").equals(tracks)


@given(
    rows=st.dictionaries(
        st.tuples(st.sampled_from([0, 1, 7, 2**31 - 1]), st.integers(0, 12)),
        st.tuples(st.integers(0, 400), st.sampled_from([None, 0, 1, 7, 8, 2**31 - 1]), st.sampled_from([None, 30.0])),
    ),
    lengths=st.dictionaries(st.sampled_from([0, 1, 7, 2**31 - 1]), st.sampled_from([None, 4.5])),
    use_recorded=st.booleans(),
)
@settings(deadline=None)
def test_gaps_are_those_of_a_slow_loop(rows, lengths, use_recorded):
    tracks = pl.DataFrame(
        [(*key, float(x), leader, headway) for key, (x, leader, headway) in sorted(rows.items())],
        schema=GAP_SCHEMA,
        orient="row",
    )
    vehicles = pl.DataFrame(
        list(lengths.items()), schema={"vehicle_id": pl.Int32, "length_m": pl.Float64}, orient="row"
    )
    expected = []
    for (_, frame), (x, leader, recorded) in sorted(rows.items()):
        headway = rows[leader, frame][0] - x if (leader, frame) in rows else None
        if headway is None and use_recorded:
            headway = recorded
        length = lengths.get(leader)
        expected.append(None if leader is None or headway is None or length is None else headway - length)
    assert add_gaps(tracks, vehicles, use_recorded_headway=use_recorded)["gap_m"].to_list() == expected
