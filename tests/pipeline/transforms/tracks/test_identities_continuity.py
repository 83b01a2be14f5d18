"""Vehicles that share an id are distinguished by how they move."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from identity_rows import TOP, drive, entry, identify, places, tracks_of


def tracks(*vehicles, **how):
    """Sorted [(frame, x_m), ...] of each vehicle found, for rows given per vehicle."""
    found = identify([row for vehicle in vehicles for row in vehicle], **how)
    assert found.ids_split == (len(tracks_of(found)) > 1)
    return sorted(tracks_of(found).values())


def kept_apart(*vehicles, **how):
    """Whether each vehicle given is one vehicle found."""
    return tracks(*vehicles, **how) == sorted(places(vehicle) for vehicle in vehicles)


def test_twins_side_by_side():
    assert kept_apart(drive(5, range(1, 6), 10.0, 0.0), drive(5, range(1, 6), 10.0, 3.5))


def test_a_twin_that_is_missing_in_some_frames():
    """The one ahead is not seen in frames 3 and 4, the other not in 6: by their ranks they would change places."""
    behind, ahead = drive(5, [1, 2, 3, 4, 5, 7], 0.0), drive(5, [1, 2, 5, 6, 7], 30.0)
    assert kept_apart(behind, ahead)


def test_one_is_missing_just_when_the_other_comes_back():
    # In frame 3 there is only the one behind, in frame 4 only the one ahead, 31 m further up the road.
    assert kept_apart(drive(5, [1, 2, 3, 5, 6], 0.0), drive(5, [1, 2, 4, 5, 6], 30.0))


def test_twins_that_overtake():
    """30 m/s and 10 m/s: 3 m and 1 m a frame; the faster passes between frames 3 and 4, in a lane of its own or not."""
    for y_m in (3.5, 0.0):
        slow = drive(5, range(1, 8), 5.0)
        fast = drive(5, range(1, 8), 0.0, y_m, metres=3.0, speed=30.0)
        assert kept_apart(slow, fast)


def test_the_cheaper_way_for_two_in_all():
    """Two entries to two: the sum of both distances decides, not the least of the four."""
    # Expected in frame 2 at 1 and 3 m, found at 2.1 and 4.5 m: straight 1.1 + 1.5; crossed 3.5 + 0.9, though that is
    # the least.
    assert tracks([entry(5, 1, 0.0), entry(5, 1, 2.0), entry(5, 2, 2.1), entry(5, 2, 4.5)]) == [
        [(1, 0.0), (2, 2.1)], [(1, 2.0), (2, 4.5)]]  # fmt: skip


def test_three_twins():
    first, second, third = (drive(5, range(1, 9), x, y) for x, y in ((0.0, 0.0), (20.0, 3.5), (40.0, 7.0)))
    assert kept_apart(first, second, third)
    assert kept_apart(first[:3] + first[5:], second[:2] + second[4:], third[1:6])


def test_a_dozen_twins_in_one_queue():
    assert kept_apart(*(drive(5, range(1, 5), 8.0 * place) for place in range(12)))


def test_a_twin_that_leaves_while_another_enters():
    """One leaves at 604 m in frame 5; from frame 6 there is one at 0 m; the third drives in between all the time."""
    leaving, entering = drive(5, range(1, 6), 600.0), drive(5, range(6, 11), 0.0)
    assert kept_apart(leaving, entering, drive(5, range(1, 11), 300.0))


def test_twins_of_the_same_place():
    # No telling who is who: two vehicles nevertheless, and every row in one of them.
    found = identify([entry(5, 1, 0.0), entry(5, 1, 0.0), entry(5, 2, 1.0), entry(5, 2, 1.0)])
    assert sorted(tracks_of(found).values()) == [[(1, 0.0), (2, 1.0)]] * 2


def test_an_id_used_again_after_its_vehicle_left():
    first, again = drive(5, range(1, 50), 550.0), drive(5, range(400, 450), 0.0)
    assert kept_apart(first, again)
    found = identify([*again, *first])
    assert found.ids_split == 1
    assert [rows[0] for rows in tracks_of(found).values()] == [(1, 550.0), (400, 0.0)]
    assert list(tracks_of(found)) == [5, 6]


def test_an_id_used_three_times():
    assert kept_apart(*(drive(5, range(begin, begin + 40), 3.0) for begin in (1, 1000, 5000)))


@pytest.mark.parametrize(("back_m", "vehicles"), [(0.0, 1), (19.0, 1), (21.0, 2)])
def test_how_far_back_is_another_vehicle(back_m, vehicles):
    # Last seen at 102 m in frame 3, then after an absence.
    assert len(tracks(drive(5, [1, 2, 3], 100.0), drive(5, [30, 31], 102.0 - back_m))) == vehicles


@pytest.mark.parametrize(("far_m", "vehicles"), [(79.5, 1), (80.5, 2)])
def test_how_fast_is_another_vehicle(far_m, vehicles):
    # 10 frames are 1 s: 60 m/s and 20 m allow 80 m.
    assert len(tracks(drive(5, [1, 2, 3], 0.0), drive(5, [13, 14], 2.0 + far_m))) == vehicles


def test_a_gap_that_one_vehicle_can_have_had():
    # Standing for a minute, driving on unseen, in another lane after the gap: one vehicle each.
    assert len(tracks(drive(5, [1, 2, 3], 100.0), drive(5, [603, 604], 102.0, speed=0.0))) == 1
    assert len(tracks(drive(5, [1, 2, 3], 100.0), drive(5, [53, 54], 152.0, 7.0))) == 1


def test_a_jump_without_an_absence_is_an_error_of_the_recording():
    jumping = [*drive(5, [1, 2], 700.0), entry(5, 3, 200.0), *drive(5, [4, 5], 703.0)]
    assert len(tracks(jumping)) == 1
    # Neither where the id is looked at closely, because it is used again.
    assert kept_apart(jumping, drive(5, [300, 301], 0.0))


def test_on_streets_vehicles_turn():
    """Out of the subset and into it again, further back: another vehicle only after more frames than it announces."""
    first = drive(5, range(1, 11), 300.0, announced=100)
    assert len(tracks(first, drive(5, range(110, 120), 100.0, announced=100), one_way=False)) == 1
    assert len(tracks(first, drive(5, range(112, 122), 100.0, announced=100), one_way=False)) == 2
    assert len(tracks(first, drive(5, range(110, 120), 100.0, announced=100))) == 2
    # Nothing announced, nothing known.
    assert len(tracks(drive(5, [1], 300.0), drive(5, [900], 100.0), one_way=False)) == 1


def test_twins_in_the_other_direction_of_a_street_of_unknown_directions():
    assert kept_apart(
        drive(5, range(1, 8), 100.0, metres=-1.0), drive(5, [1, 2, 5, 6, 7], 100.0, 3.5, metres=-1.0), one_way=False
    )


def announcing(announced, *runs):
    """How many vehicles an id is whose runs of frames all could be one by position."""
    return len(tracks([entry(5, frame, float(frame), announced=announced) for run in runs for frame in run]))


def test_more_entries_than_announced():
    # All 20 frames announced twice over: two vehicles, though the second goes on where the first was.
    assert announcing(20, range(1, 21), range(60, 80)) == 2
    assert announcing(20, range(1, 21), range(60, 80), range(120, 140)) == 3
    # 20 + 9 of 20: too little to say. 20 + 10: two.
    assert announcing(20, range(1, 21), range(60, 69)) == 1
    assert announcing(20, range(1, 21), range(60, 70)) == 2
    # 30 frames without a gap: what is announced is wrong.
    assert announcing(20, range(1, 31), range(60, 70)) == 1
    assert announcing(0, range(1, 21), range(60, 80)) == 1
    assert announcing(None, range(1, 21), range(60, 80)) == 1


def test_more_entries_than_announced_are_parted_at_the_longest_absence():
    runs = [range(1, 8), range(10, 21), range(50, 60), range(63, 70)]
    found = identify([entry(5, frame, float(frame), announced=20) for run in runs for frame in run])
    assert [(rows[0][0], rows[-1][0]) for rows in tracks_of(found).values()] == [(1, 20), (50, 69)]


def test_frames_at_the_limit():
    assert len(tracks([entry(5, 0, 0.0), entry(5, TOP, 900.0)])) == 1
    assert kept_apart([entry(5, 0, 900.0)], [entry(5, TOP, 0.0)])


def absent_for(data, frames):
    """Some of the frames, always the first two and the last two."""
    inner = data.draw(st.sets(st.sampled_from(frames[2:-2])))
    return [frame for frame in frames if frame not in inner]


@given(
    lanes=st.lists(st.tuples(st.integers(0, 40), st.sampled_from([0.8, 1.0, 1.2])), min_size=2, max_size=4),
    rate=st.sampled_from([1, 3]),
    data=st.data(),
)
@settings(max_examples=20, deadline=None)
def test_twins_in_lanes_of_their_own_are_found_again(lanes, rate, data):
    """Constant speeds, one lane each, any frames missing: what was put together comes apart the same way.

    Frames numbered three times as fast at three times the rate are the same recording.
    """
    vehicles = []
    for lane, (start_m, metres) in enumerate(lanes):
        frames = absent_for(data, list(range(1, 12)))
        rows = drive(5, frames, float(start_m), 3.5 * lane, metres=metres, speed=10 * metres)
        vehicles.append([(source, frame * rate, *rest) for source, frame, *rest in rows])
    assert kept_apart(*vehicles, frame_rate_hz=10.0 * rate)


@given(
    steps=st.lists(
        st.tuples(st.sampled_from([1, 1, 2, 10, 50]), st.sampled_from([-400.0, -25.0, -15.0, 0.0, 5.0, 30.0, 90.0])),
        max_size=8,
    )
)
@settings(max_examples=35, deadline=None)
def test_one_entry_a_frame_is_one_vehicle_unless_an_absence_cannot_be(steps):
    frame, x_m = 1, 1000.0
    rows, broken = [entry(5, frame, x_m)], False
    for frames, metres in steps:
        frame, x_m = frame + frames, x_m + metres
        rows.append(entry(5, frame, x_m))
        broken |= frames > 1 and (metres < -20 or abs(metres) > 6 * frames + 20)
    assert (len(tracks(rows)) > 1) == broken
