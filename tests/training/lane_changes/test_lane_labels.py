"""Lane changes are found where they are, end at the target lane's centre, and begin T_d earlier."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lane_tracks import CODES, MARKINGS, SHORT, open_tracks, track
from tensor_loop import BY_VEHICLE, IN_TIME, UNDIVIDED, random_tables
from tensor_tables import write

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.lane_changes.examples import (
    LaneForestSettings,
    find_labelled,
    find_maneuvers,
    label_rows,
    label_samples,
)


def letters(folder, **settings):
    """The label of every row as one letter: k, l, r."""
    names = {code: letter for letter, code in CODES.items()}
    return "".join(names[code] for code in label_rows(folder, find_maneuvers(folder, **settings)))


# The road: centres at 2, 6 and 10 m, markings at 4 and 8 m. Two ticks a second, T_d of 2 s: a maneuver is its last row
# and the four before it.
CASES = {
    "to the right, until it is beyond the centre": (
        [2, 2, 2, 2, 3, 4.5, 5.5, 6.2, 6.2, 6.2],
        "kkkrrrrrkk",
    ),
    "to the left, until it is at the centre but for the tolerance": (
        [6, 6, 6, 6, 5, 3.5, 2.5, 2.1, 2.0, 2.0],
        "kkklllllkk",
    ),
    "at the centre at once": ([2, 2, 2, 2, 2, 2, 6.0, 6, 6], "kkrrrrrkk"),
    "never there: the row nearest to it, the first of two": ([2, 2, 2, 2, 2, 5, 5.5, 5.2, 5.5, 5.4], "kkrrrrrkkk"),
    "there only after T_d: not looked for so late": ([2, 2, 2, 2, 4.5, 5, 5, 5.2, 5.3, 6.2, 6], "kkkkrrrrrkk"),
    "no earlier than its run": ([2, 4.5, 6, 6], "rrrk"),
    "until the run's end": ([2, 2, 2, 2, 2, 4.1, 4.6], "kkrrrrr"),
    "two lanes at once": ([2, 2, 2, 2, 2, 9, 10, 10], "kkrrrrrk"),
    "the earlier of two holds until its end": ([2, 2, 2, 2, 4.5, 6, 6, 9, 10, 10], "krrrrrrrrk"),
    "there and back": ([2, 2, 2, 2, 2, 5, 5.5, 3.5, 2, 2], "kkrrrrrllk"),
    "left again before the centre": ([2, 2, 2, 2, 2, 5, 3, 2, 2, 2], "krrrrrllkk"),
    "nothing across a gap": ([2, 2, 2, None, 6, 6, 6], "kkkkkk"),
    "a change before and after a gap": ([2, 6, 6, None, 6, 6, 2, 2], "rrklllk"),
    "a single row": ([2], "k"),
}


@pytest.mark.parametrize(("y_m", "expected"), CASES.values(), ids=CASES)
@pytest.mark.parametrize("storage", ["float32", "int16-centimetres"])
def test_by_hand(tmp_path, y_m, expected, storage):
    folder = open_tracks(tmp_path / "t", {"a": track(3, y_m)}, storage=storage)
    assert letters(folder, start_s=2.0) == expected


# As above, with a T_d of 4 s: from the last row at the old lane's centre, or beyond it, on.
MEASURED = {
    "from the centre on": ([2, 2, 2, 2, 3, 4.5, 5.5, 6.2, 6.2], "kkkrrrrrk"),
    "from the other side of it": ([2, 2, 1.5, 2.5, 3, 4.5, 6, 6, 6], "kkrrrrrkk"),
    "within the tolerance": ([6, 6, 6, 5.95, 5, 3.5, 2, 2], "kkkllllk"),
    "never there: the last of the rows nearest to it": ([2.5, 2.5, 2.5, 3, 4.5, 6, 6], "kkrrrrk"),
    "at once": ([2, 2, 2, 2, 6, 6], "kkkrrk"),
    "no longer than T_d": ([2] + [2.5 + 0.1 * at for at in range(14)] + [4.1, 6, 6], "k" * 8 + "r" * 9 + "k"),
    "not before the lane was entered": ([2, 2, 2, 6.5, 7, 10, 10], "kkrrrrk"),
    "nor before the run": ([2.5, 3, 4.5, 6, 6], "rrrrk"),
    "nothing across a gap": ([2, 2, None, 2.5, 4.5, 6], "kkrrr"),
}


@pytest.mark.parametrize(("y_m", "expected"), MEASURED.values(), ids=MEASURED)
def test_a_measured_start_by_hand(tmp_path, y_m, expected):
    folder = open_tracks(tmp_path / "t", {"a": track(3, y_m)})
    assert letters(folder, start_s=4.0, measured_start=True) == expected


def test_vehicles_and_subsets_do_not_touch(tmp_path):
    right, left = [2, 2, 2, 2, 2, 6, 6], [6, 6, 6, 6, 6, 2, 2]
    rows = {"a": track(1, right) + track(2, [6] * 7) + track(2**31 - 1, left), "b": track(1, left)}
    assert letters(open_tracks(tmp_path / "t", rows), start_s=2.0) == "krrrrrk" + "k" * 7 + "klllllk" * 2


def test_a_lane_that_is_not_known_is_no_lane(tmp_path):
    lane = [1, 1, 0, 2, 2, 2, 2, 1]
    folder = open_tracks(tmp_path / "t", {"a": track(1, [2, 2, 5, 6, 6, 6, 6, 2], lane=lane)})
    assert letters(folder, start_s=1.0) == "kkkkklll", "from lane 2 to 1 only: what lies between 1 and 2 is unknown"


def test_settings_are_seconds_and_metres_at_any_rate(tmp_path):
    y_m = [2.0] * 20 + [5.0, 5.2, 5.6, 5.8, 6.0] + [6.0] * 5
    rows = {"a": track(1, y_m)}
    at_2_hz = open_tracks(tmp_path / "2", rows)
    at_5_hz = open_tracks(tmp_path / "5", rows, protocol=type(SHORT)(name="five", rate_hz=5, split="mine"))
    assert [letters(folder, start_s=2.0).count("r") for folder in (at_2_hz, at_5_hz)] == [5, 11]
    assert letters(at_2_hz, start_s=2.0, tolerance_m=0.45).index("r") == 18, "5.6 m is there: row 22, less 4"
    assert letters(at_2_hz, start_s=2.0).index("r") == 20, "6.0 m is: row 24, less 4"


def test_without_markings_lanes_are_nominal(tmp_path):
    """12 ft each: the second one's centre is at 18 ft."""
    centre = 18 * 0.3048
    assert centre == pytest.approx(1.5 * NOMINAL_LANE_M)
    y_m = [2, 2, 2, 2, 2, 2, 4, centre - 0.11, centre - 0.09, 6]
    folder = open_tracks(tmp_path / "t", {"a": track(1, y_m, lane=[1] * 6 + [2] * 4)}, markings=None)
    assert letters(folder, start_s=2.0) == "kkkkrrrrrk"


def test_rows_near_the_end_of_their_run_are_not_judged(tmp_path):
    folder = open_tracks(tmp_path / "t", {"a": track(1, [2] * 6) + track(2, [2] * 3)})
    assert find_labelled(folder, np.arange(9), start_s=2.0).tolist() == [True] * 2 + [False] * 7
    assert find_labelled(folder, np.arange(9), start_s=1.0).tolist() == [True] * 4 + [False] * 2 + [True] + [False] * 2


def loop_over_rows(folder, start_s, tolerance_m, markings, measured_start):
    """The same row by row."""

    def measure_offset(row, lane):
        centre = (markings[lane - 1] + markings[lane]) / 2 if markings else (lane - 0.5) * NOMINAL_LANE_M
        return np.float32(middle + step * float(folder.position_m[row, 1])) - centre

    ticks, labels = round(start_s * folder.protocol.rate_hz), ["k"] * len(folder.lane)
    for run in range(len(folder.run_first_row) - 1):
        first, last = int(folder.run_first_row[run]), int(folder.run_first_row[run + 1]) - 1
        taken = first - 1  # rows up to here belong to an earlier maneuver
        for row in range(first + 1, last + 1):
            before, lane = int(folder.lane[row - 1]), int(folder.lane[row])
            if before == lane or 0 in (before, lane):
                continue
            step = 1 if folder.step_m is None else folder.step_m[1]
            middle = 0.0 if folder.step_m is None else folder.centre_m[folder.run_subset[run]][1]
            end, nearest = None, None
            for later in range(row, min(last, row + ticks) + 1):
                if folder.lane[later] != lane:
                    break
                offset = measure_offset(later, lane)
                if nearest is None or abs(offset) < nearest[0]:
                    nearest = abs(offset), later
                if (offset if lane > before else -offset) >= -tolerance_m:
                    end = later
                    break
            end = nearest[1] if end is None else end
            start = max(first, end - ticks)
            if measured_start:
                left = nearest = None
                for earlier in range(row - 1, max(first, row - ticks) - 1, -1):
                    if folder.lane[earlier] != before:
                        break
                    offset = measure_offset(earlier, before)
                    if nearest is None or abs(offset) < nearest[0]:
                        nearest = abs(offset), earlier
                    if (-offset if lane > before else offset) >= -tolerance_m:
                        left = earlier
                        break
                start = max(start, nearest[1] if left is None else left)
            for covered in range(max(start, taken + 1), end + 1):
                labels[covered] = "r" if lane > before else "l"
            taken = end
    return "".join(labels)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME, BY_VEHICLE]),
    storage=st.sampled_from(["float32", "int16-decimetres"]),
    markings=st.sampled_from([None, MARKINGS]),
    start_s=st.sampled_from([0.5, 1.0, 3.0]),
    tolerance_m=st.sampled_from([0.0, 0.1, 1.5]),
    measured_start=st.booleans(),
)
def test_as_an_obvious_loop_finds_them(seed, splits, storage, markings, start_s, tolerance_m, measured_start):
    """Random lanes and places, with gaps, cut runs, borders of blocks, no or one vehicle."""
    with tempfile.TemporaryDirectory() as home:
        written = write(Path(home) / "t", random_tables(seed), splits, storage=storage, markings=markings)
        folder = TensorFolder.open(written)
        expected = loop_over_rows(folder, start_s, tolerance_m, markings, measured_start)
        found = letters(folder, start_s=start_s, tolerance_m=tolerance_m, measured_start=measured_start)
        assert found == expected
        del folder


def test_lane_centres_are_refused(tmp_path):
    """A vehicle that is at one lane's centre and then at the other's has not been seen to change lanes."""
    folder = open_tracks(tmp_path / "t", {"a": track(3, [2, 2, 2, 2, 2, 2, 6.0, 6, 6])})
    folder.index["subsets"][0]["lateral_positions"] = "lane centres"
    with pytest.raises(TracklakeError, match=r"lateral positions of highd/a are lane centres. .* a lake without them"):
        label_samples(folder, None, LaneForestSettings())
