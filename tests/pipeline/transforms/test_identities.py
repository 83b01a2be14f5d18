"""One id, one vehicle, whatever the order of the rows."""

import polars as pl
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.transforms.identities import identify_vehicles

TOP = 2**31 - 1
CONSTANTS = ("announced", "length")
SCHEMA = {
    "source_id": pl.Int32,
    "frame": pl.Int32,
    "announced": pl.Int32,
    "length": pl.Float64,
    "x_m": pl.Float64,
    "lane": pl.Int16,
    "leader_source_id": pl.Int32,
    "follower_source_id": pl.Int32,
}


def frame_of(rows):
    return pl.DataFrame(rows, schema=SCHEMA, orient="row")


def identify(rows):
    return identify_vehicles(frame_of(rows), constants=CONSTANTS)


def test_nothing_to_split_keeps_ids_and_reads_zero_as_none():
    found = identify([(5, 2, 9, 4.0, 1.0, 1, 0, 7), (5, 1, 9, 4.0, 0.0, 1, 6, None), (2, 1, 9, 4.0, 3.0, 1, None, 0)])
    assert found.ids_split == 0
    assert found.entries.select("vehicle_id", "frame", "leader_id", "follower_id").rows() == [
        (2, 1, None, None),
        (5, 1, 6, None),
        (5, 2, None, 7),
    ]


def test_the_vehicle_seen_first_keeps_the_id():
    found = identify([(5, 9, 1, 4.0, 0.0, 1, 0, 0), (5, 3, 2, 4.0, 0.0, 1, 0, 0), (5, 6, 3, 4.0, 0.0, 1, 90, 0)])
    assert found.ids_split == 1
    # 90 is a leader's id, so that new ids begin beyond it.
    assert found.entries.select("vehicle_id", "frame").rows() == [(5, 3), (91, 6), (92, 9)]


def test_several_ids_are_split_at_once():
    rows = [(vehicle, frame, part, 4.0, 0.0, 1, 0, 0) for vehicle in (1, 2, 3) for part in (7, 8) for frame in (part,)]
    found = identify(rows)
    assert found.ids_split == 3
    assert found.entries.select("vehicle_id", "source_id", "announced").rows() == [
        (1, 1, 7), (2, 2, 7), (3, 3, 7), (4, 1, 8), (5, 2, 8), (6, 3, 8)]  # fmt: skip


def test_twins_are_told_apart_along_the_road():
    rows = [(5, frame, 9, 4.0, x + frame, 1, 0, 0) for frame in (1, 2, 3) for x in (100.0, 10.0)]
    found = identify(rows)
    assert found.entries.select("vehicle_id", "x_m").rows() == [
        (5, 11.0), (5, 12.0), (5, 13.0), (6, 101.0), (6, 102.0), (6, 103.0)]  # fmt: skip


def test_a_leader_is_the_vehicle_of_that_id_in_the_frame_and_lane():
    two = [(5, frame, announced, 4.0, 50.0, lane, 0, 0) for frame in (1, 2) for announced, lane in ((9, 1), (8, 2))]
    rows = [*two, (7, 1, 3, 4.0, 0.0, 1, 5, 0), (7, 2, 3, 4.0, 0.0, 2, 5, 5), (7, 3, 3, 4.0, 0.0, 2, 5, 6)]
    found = identify(rows)
    follower = found.entries.filter(pl.col("vehicle_id") == 7).select("leader_id", "follower_id").rows()
    # The vehicle that announces 8 sorts first and keeps the id; frame 3 has no vehicle 5.
    assert follower == [(8, None), (5, 5), (5, 6)]


def test_missing_constants_are_a_constant_too():
    found = identify([(5, 1, None, None, 0.0, None, 0, 0), (5, 2, None, None, 1.0, None, 0, 0)])
    assert found.ids_split == 0
    split = identify([(5, 1, None, None, 0.0, None, 0, 0), (5, 1, None, None, 1.0, None, 5, 0)])
    assert split.ids_split == 1
    assert split.entries["vehicle_id"].to_list() == [5, 6]


def test_no_rows():
    found = identify([])
    assert found.entries.is_empty()
    assert found.ids_split == 0


ids = st.sampled_from([0, 1, 2, 3, TOP - 1, TOP])
rows = st.lists(
    st.tuples(
        ids,
        st.integers(1, 3),
        st.sampled_from([None, 10, 20]),
        st.sampled_from([4.0, 12.0]),
        st.integers(0, 40).map(float),
        st.sampled_from([None, 1, 2]),
        ids | st.none(),
        ids | st.none(),
    ),
    min_size=1,
    max_size=14,
)


@given(rows=rows, data=st.data())
@settings(max_examples=150, deadline=None)
def test_every_entry_has_one_vehicle_and_the_order_of_rows_is_irrelevant(rows, data):
    found = identify(rows)
    entries = found.entries
    assert entries.height == len(rows)
    # Nothing but the ids is changed.
    order = st.permutations(rows)
    key = list(SCHEMA)
    assert entries.select(key).sort(key).equals(frame_of(rows).sort(key))
    assert entries.select("vehicle_id", "frame").is_unique().all()
    assert entries.select("vehicle_id", "frame").rows() == sorted(entries.select("vehicle_id", "frame").rows())
    # A vehicle has one source id and one set of constants.
    per_vehicle = entries.group_by("vehicle_id").agg(pl.struct("source_id", *CONSTANTS).n_unique().alias("kinds"))
    assert (per_vehicle["kinds"] == 1).all()
    # Each source id goes on as one vehicle's id.
    assert set(frame_of(rows)["source_id"]) <= set(entries["vehicle_id"])
    split = entries.group_by("source_id").agg(pl.col("vehicle_id").n_unique().alias("vehicles"))
    assert found.ids_split == (split["vehicles"] > 1).sum()
    # A new id is nobody else's, be it as a recorded leader or follower.
    recorded = {value for row in rows for value in (row[0], row[6], row[7]) if value is not None}
    assert not (set(entries["vehicle_id"]) - set(frame_of(rows)["source_id"])) & recorded
    again = identify(data.draw(order))
    assert again.entries.equals(entries)
