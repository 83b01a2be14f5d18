"""Derived leaders and lanes against a slow loop, and by hand."""

import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.leaders import derive_lanes, derive_leaders

ENTRIES = st.lists(
    st.tuples(
        st.sampled_from([0, 1, 7, 2**31 - 1]), st.integers(1, 3), st.sampled_from([None, 1, 2]), st.integers(0, 3)
    ),
    max_size=12,
    unique_by=lambda entry: entry[:2],
)


def find_leader(entry, entries):
    """The vehicle next ahead in the lane, by a look at all."""
    vehicle, frame, lane, x = entry
    ahead = [
        (o[3], o[0]) for o in entries if lane is not None and o[1:3] == (frame, lane) and (o[3], o[0]) > (x, vehicle)
    ]
    return min(ahead)[1] if ahead else None


@settings(max_examples=40)
@given(ENTRIES)
def test_leaders_and_followers_are_those_a_loop_finds_in_any_order_of_rows(entries):
    schema = {"vehicle_id": pl.Int32, "frame": pl.Int32, "lane": pl.Int16, "x_m": pl.Float64}
    derived = derive_leaders(pl.DataFrame(entries, schema=schema, orient="row"))
    leaders = [find_leader(entry, entries) for entry in entries]
    assert derived["leader_id"].to_list() == leaders
    followers = {(leader, entry[1]): entry[0] for entry, leader in zip(entries, leaders, strict=True)}
    assert derived["follower_id"].to_list() == [followers.get(entry[:2]) for entry in entries]
    assert derived.select("vehicle_id", "frame", "lane", "x_m").rows() == entries


def test_lanes_are_as_wide_as_said_and_null_beside_the_road():
    offsets = pl.DataFrame({"y": [-0.1, 0.0, 3.6, 3.7, 14.6, 14.7]})
    lanes = offsets.select(derive_lanes(pl.col("y"), 3.6576, 4)).to_series()
    assert lanes.to_list() == [None, 1, 1, 2, 4, None]
    assert lanes.dtype == pl.Int16
