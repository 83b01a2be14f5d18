"""One id, one vehicle, whatever the order of the rows."""

from collections import defaultdict

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identity_rows import TOP, drive, entry, identify


def test_nothing_to_split_keeps_ids_and_reads_zero_as_none():
    found = identify([entry(5, 2, 1.0, follower=7), entry(5, 1, 0.0, leader=6, follower=None),
                      entry(2, 1, 3.0, leader=None)])  # fmt: skip
    assert found.ids_split == 0
    assert found.entries.select("vehicle_id", "frame", "leader_id", "follower_id").rows() == [
        (2, 1, None, None),
        (5, 1, 6, None),
        (5, 2, None, 7),
    ]


def test_the_vehicle_seen_first_keeps_the_id():
    found = identify([entry(5, 9, 0.0, announced=1, leader=90), entry(5, 3, 0.0, announced=2),
                      entry(5, 6, 0.0, announced=3)])  # fmt: skip
    assert found.ids_split == 1
    # 90 is a leader's id, so that new ids begin beyond it.
    assert found.entries.select("vehicle_id", "frame").rows() == [(5, 3), (91, 6), (92, 9)]


def test_several_ids_are_split_at_once():
    found = identify([entry(source, part, 0.0, announced=part) for source in (1, 2, 3) for part in (7, 8)])
    assert found.ids_split == 3
    assert found.entries.select("vehicle_id", "source_id", "announced").rows() == [
        (1, 1, 7), (2, 2, 7), (3, 3, 7), (4, 1, 8), (5, 2, 8), (6, 3, 8)]  # fmt: skip


def test_twins_seen_first_in_one_frame_are_numbered_by_their_values():
    twins = [*drive(5, [1, 2], 7.0, 3.5), *drive(5, [1, 2], 7.0, 0.0)]
    for rows in (twins, twins[::-1]):
        numbered = identify(rows).entries.select("vehicle_id", "y_m").rows()
        assert numbered == [(5, 0.0), (5, 0.0), (6, 3.5), (6, 3.5)]


def test_other_ids_are_left_alone_when_one_is_split():
    found = identify([*drive(5, [1, 2], 0.0), *drive(5, [1, 2], 90.0), *drive(4, [1, 2], 50.0, leader=9, follower=5)])
    assert found.ids_split == 1
    other = found.entries.filter(pl.col("source_id") == 4)
    assert other.select("vehicle_id", "frame", "leader_id", "follower_id").rows() == [(4, 1, 9, 5), (4, 2, 9, 5)]


def test_missing_constants_are_a_constant_too():
    assert identify([entry(5, 1, 0.0, length=None), entry(5, 2, 1.0, length=None)]).ids_split == 0
    split = identify([entry(5, 1, 0.0, length=None), entry(5, 1, 1.0, length=None)])
    assert split.ids_split == 1
    assert split.entries["vehicle_id"].to_list() == [5, 6]


def test_entries_that_lack_a_constant_have_that_of_the_others():
    """A case where the later frames stand only in a file without sizes."""
    found = identify([entry(5, 1, 0.0, announced=9), entry(5, 2, 1.0, length=None), entry(5, 3, 2.0)])
    assert found.ids_split == 0
    assert found.entries.select("vehicle_id", "announced", "length").rows() == [(5, 9, 4.0), (5, None, None),
                                                                               (5, None, 4.0)]  # fmt: skip
    # With two vehicles of that id, nothing says whose they are: they are followed by themselves.
    found = identify([entry(5, 1, 0.0, announced=9), entry(5, 1, 50.0, announced=8), entry(5, 2, 1.0)])
    assert found.entries.select("vehicle_id", "announced").rows() == [(5, 8), (6, 9), (7, None)]


def test_a_leader_is_the_vehicle_of_that_id_in_the_frame_and_lane():
    two = [
        entry(5, frame, 50.0, announced=announced, lane=lane)
        for frame in (1, 2)
        for announced, lane in ((9, 1), (8, 2))
    ]
    seven = [entry(7, 1, 0.0, lane=1, leader=5), entry(7, 2, 1.0, lane=2, leader=5, follower=5),
             entry(7, 3, 2.0, lane=2, leader=5, follower=6)]  # fmt: skip
    found = identify([*two, *seven])
    # The vehicle that announces 8 (lane 2) sorts first and keeps the id; the other is 8, beyond 7. No vehicle 5 is
    # behind in frame 2, so that the follower is the one in the lane; no vehicle 5 lasts until frame 3.
    follower = found.entries.filter(pl.col("vehicle_id") == 7).select("leader_id", "follower_id").rows()
    assert follower == [(8, None), (5, 5), (None, 6)]


def test_a_leader_out_of_sight_is_the_vehicle_of_that_id_whose_frames_lie_either_side():
    """Id 1 is a car in frames 1-10 and a truck in frames 400-409, whose row of frame 405 is missing."""
    car = drive(1, range(1, 11), 0.0, length=4.572)
    truck = drive(1, [400, 401, 402, 403, 404, 406, 407, 408, 409], 60.0, length=18.288)
    behind = drive(9, [5, 200, 404, 405, 406, 500], -900.0, leader=1, follower=1)
    found = identify([*car, *truck, *behind])
    # The car keeps the id, the truck is 10, beyond 9. In frames 200 and 500 neither is there, nor before and after.
    named = found.entries.filter(pl.col("vehicle_id") == 9).select("frame", "leader_id", "follower_id").rows()
    assert named == [(frame, leader, leader) for frame, leader in
                     ((5, 1), (200, None), (404, 10), (405, 10), (406, 10), (500, None))]  # fmt: skip


def test_of_two_vehicles_out_of_sight_at_once_nobody_says_which_it_was():
    found = identify([*drive(5, [1, 2, 4], 60.0, 3.5), *drive(5, [1, 2, 4], 60.0), entry(9, 3, 0.0, leader=5)])
    assert found.ids_split == 1
    assert found.entries.filter(pl.col("vehicle_id") == 9)["leader_id"].to_list() == [None]
    # Where one of the two names the id itself, it is the other.
    found = identify([*drive(5, [1, 2, 3, 4], 60.0, 3.5, leader=5), *drive(5, [1, 2, 4], 60.0)])
    assert found.entries.filter(pl.col("frame") == 3).select("vehicle_id", "leader_id").rows() == [(6, 5)]


def in_frame_one(*others, x_m, lane, leader=0, follower=0):
    """(leader_id, follower_id) of vehicle 9 beside vehicles of id 5: [(x_m, lane), ...], by lengths 1, 2, 3 ..."""
    twins = [entry(5, 1, x, lane=on, length=float(place)) for place, (x, on) in enumerate(others, start=1)]
    found = identify([*twins, entry(9, 1, x_m, lane=lane, leader=leader, follower=follower)])
    return found.entries.filter(pl.col("vehicle_id") == 9).select("leader_id", "follower_id").row(0)


def test_leaders_are_the_nearest_ahead_and_followers_the_nearest_behind():
    # Vehicles of id 5 are numbered 5, 10, 11, 12 by their lengths.
    assert in_frame_one((80, 1), (60, 1), (40, 1), (20, 1), x_m=50, lane=1, leader=5, follower=5) == (10, 11)
    # In the same lane before nearer in another.
    assert in_frame_one((80, 1), (60, 2), (40, 2), (20, 1), x_m=50, lane=1, leader=5, follower=5) == (5, 12)
    # In another lane where there is none in the same.
    assert in_frame_one((80, 3), (60, 2), (40, 2), (20, 3), x_m=50, lane=1, leader=5, follower=5) == (10, 11)
    # On the right side in another lane before in the same lane on the wrong one; that only where there is no other.
    assert in_frame_one((40, 1), (60, 2), x_m=50, lane=1, leader=5) == (10, None)
    assert in_frame_one((40, 1), (30, 1), x_m=50, lane=1, leader=5) == (5, None)
    assert in_frame_one((40, None), (70, 1), (60, None), x_m=50, lane=None, leader=5) == (11, None)


def test_nobody_leads_or_follows_itself():
    found = identify([entry(5, 1, 0.0, length=3.0, leader=5, follower=5), entry(5, 1, 50.0, leader=5, follower=5),
                      entry(5, 2, 51.0, leader=5, follower=5), entry(6, 2, 9.0, leader=6, follower=6)])  # fmt: skip
    # In frame 1 each of the two is the other's; in frame 2 there is no one else.
    assert found.entries.select("vehicle_id", "frame", "leader_id", "follower_id").rows() == [
        (5, 1, 7, 7), (6, 2, None, None), (7, 1, 5, 5), (7, 2, None, None)]  # fmt: skip
    unsplit = identify([entry(6, 2, 9.0, leader=6, follower=6)])
    assert unsplit.entries.select("leader_id", "follower_id").rows() == [(None, None)]


@pytest.mark.parametrize("source", [0, 1, TOP - 1, TOP])
def test_a_single_row(source):
    found = identify([entry(source, 1, 0.0)])
    assert found.ids_split == 0
    assert found.entries["vehicle_id"].to_list() == [source]


def test_no_rows():
    found = identify([])
    assert found.entries.is_empty()
    assert found.entries.columns[-3:] == ["vehicle_id", "leader_id", "follower_id"]
    assert found.ids_split == 0


def test_ids_at_the_limit_get_free_ones_below():
    found = identify([*drive(TOP, [1, 2], 0.0), *drive(TOP, [1, 2], 90.0), entry(1, 1, 40.0, leader=2, follower=3)])
    # 1 is a vehicle, 2 and 3 are named: 4 is the lowest id that is free.
    assert found.entries.select("vehicle_id", "x_m").rows() == [
        (1, 40.0), (4, 90.0), (4, 91.0), (TOP, 0.0), (TOP, 1.0)]  # fmt: skip


ids = st.sampled_from([0, 1, 2, 3, TOP - 1, TOP])
rows = st.lists(
    st.builds(
        entry,
        ids,
        st.integers(1, 3) | st.sampled_from([40, TOP]),
        st.integers(0, 40).map(float) | st.sampled_from([-300.0, 600.0]),
        st.sampled_from([0.0, 3.5]),
        speed=st.sampled_from([0.0, 10.0, -2.0]),
        announced=st.sampled_from([None, 0, 1, 10, 20]),
        length=st.sampled_from([4.0, 12.0, None]),
        lane=st.sampled_from([None, 1, 2]),
        leader=ids | st.none(),
        follower=ids | st.none(),
    ),
    min_size=1,
    max_size=14,
)


@given(rows=rows, one_way=st.booleans(), data=st.data())
@settings(max_examples=70, deadline=None)
def test_every_entry_has_one_vehicle_and_the_order_of_rows_is_irrelevant(rows, one_way, data):
    found = identify(rows, one_way=one_way)
    entries = found.entries
    names = entries.columns[:10]
    # Nothing but the ids is changed, and no row is lost.
    assert sorted(map(repr, entries.select(names).rows())) == sorted(map(repr, rows))
    assert entries.select("vehicle_id", "frame").is_unique().all()
    assert entries.select("vehicle_id", "frame").rows() == sorted(entries.select("vehicle_id", "frame").rows())
    vehicles = defaultdict(dict)
    for source, vehicle, frame in entries.select("source_id", "vehicle_id", "frame").rows():
        vehicles[source].setdefault(vehicle, frame)
    assert found.ids_split == sum(len(found) > 1 for found in vehicles.values())
    named = {row[0] for row in rows} | {row[8] for row in rows} | {row[9] for row in rows}
    for source, firsts in vehicles.items():
        # The vehicle seen first has the source's id; the others have ids that were nowhere before.
        assert firsts[source] == min(firsts.values())
        assert all(vehicle == source or vehicle not in named for vehicle in firsts)
    assert len({vehicle for firsts in vehicles.values() for vehicle in firsts}) == sum(map(len, vehicles.values()))
    frames = {vehicle: rows["frame"] for (vehicle,), rows in entries.partition_by("vehicle_id", as_dict=True).items()}
    of_source = {vehicle: source for source, firsts in vehicles.items() for vehicle in firsts}
    for role in ("leader", "follower"):
        for own, frame, recorded, resolved in entries.select(
            "vehicle_id", "frame", f"{role}_source_id", f"{role}_id"
        ).rows():
            assert resolved != own
            others = {vehicle: frames[vehicle] for vehicle in vehicles[recorded] if vehicle != own}
            if len(vehicles[recorded]) < 2:
                assert resolved == (None if recorded in (0, None, of_source[own]) else recorded)
            elif there := [vehicle for vehicle, seen in others.items() if frame in seen]:
                assert resolved in there
            else:
                around = [vehicle for vehicle, seen in others.items() if seen.min() < frame < seen.max()]
                assert resolved == (around[0] if len(around) == 1 else None)
    again = identify(data.draw(st.permutations(rows)), one_way=one_way)
    assert again.entries.equals(entries)
    assert again.ids_split == found.ids_split
