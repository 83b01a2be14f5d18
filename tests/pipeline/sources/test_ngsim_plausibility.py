"""Units and times that a file does not state are found in its rows, or the file is refused."""

import pytest
from polars.testing import assert_frame_equal
from raw_texts import TEXT_NAMES, US_101_0750, as_csv, check_accounts, read_ngsim, tracks_of, write
from traffic_rows import FEET_COLUMNS, FEET_M, make_traffic, scale

from tracklake.pipeline.sources.source import SourceError

TRAFFIC = make_traffic()
POSITIONS = ("Local_X", "Local_Y", "Space_Headway")


def read(folder, rows, names=TEXT_NAMES, header=None, name="my drive.csv"):
    found, (spilled,) = read_ngsim(folder, write(folder / name, as_csv(rows, names, header=header)))
    ((recording, canonical),) = found.items()
    check_accounts(canonical, entries_from=[name])
    return recording, tracks_of(canonical).drop("subset"), [note.split(": ", 1)[1] for note in spilled.notes]


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    recording, tracks, notes = read(tmp_path_factory.mktemp("expected"), TRAFFIC)
    assert (recording, notes) == ("us-101-0750", [])
    return tracks


def test_a_file_in_metres_is_read_as_metres_with_notes(tmp_path, expected):
    _, tracks, notes = read(tmp_path, scale(TRAFFIC, FEET_M))
    assert_frame_equal(tracks, expected, abs_tol=2e-4)
    assert [note.split(":")[-1].strip() for note in notes] == [
        "positions are in metres, and are read as such",
        "their sizes are in metres, and are read as such",
        "speeds and accelerations are read as such",
    ]


def test_units_behind_the_names(tmp_path, expected):
    units = dict.fromkeys(FEET_COLUMNS, "(m)") | {"v_Vel": "(km/h)", "v_Acc": "(m/s2)"}
    rows = scale(scale(TRAFFIC, FEET_M), 3.6, ["v_Vel"])
    _, tracks, notes = read(tmp_path, rows, header=[name.lower() + units.get(name, "") for name in TEXT_NAMES])
    assert_frame_equal(tracks, expected, abs_tol=2e-4)
    assert notes == []


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (scale(TRAFFIC, 1.09728, ["v_Vel"]), "1.0.. times v_Vel|0.9.. times v_Vel, as if v_Vel were in km/h"),
        (scale(TRAFFIC, 2, ["v_Vel"]), "0.500 times v_Vel, which fits no unit of speed"),
        (scale(TRAFFIC, FEET_M, [*POSITIONS, "v_length", "v_Width"]), None),
        (scale(TRAFFIC, 0.5, ["Global_Time"]), "advances by 50 ms between two frames"),
    ],
    ids=["km/h", "twice", "speed in ft/s", "half the time"],
)
def test_units_that_do_not_fit_are_refused(tmp_path, expected, rows, message):
    rows = [row | {"Global_Time": round(float(row["Global_Time"]))} for row in rows]
    if message is None:  # positions in metres beside speeds in ft/s are clear
        assert_frame_equal(read(tmp_path, rows)[1], expected, abs_tol=2e-4)
        return
    with pytest.raises(SourceError, match=message):
        read(tmp_path, rows)


def test_lengths_in_metres_alone_are_refused_where_no_lane_tells_the_positions(tmp_path):
    names = [name for name in TEXT_NAMES if name != "Lane_ID"]
    with pytest.raises(SourceError, match=r"v_length of 4\.4 looks like metres, and nothing tells"):
        read(tmp_path, scale(TRAFFIC, FEET_M), names)


KEY = US_101_0750
TIMES = {
    "0": ("Global_Time is 0 in every row, so the frames tell one recording", lambda _: 0),
    "whole seconds": ("Global_Time is in whole seconds, so", lambda frame: (KEY + 100 * frame) // 1000),
    "from the start": ("Global_Time counts from the recording's start, so", lambda frame: 100 * frame),
    "empty": ("Global_Time is missing, so", lambda _: ""),
    "NaN": ("Global_Time is missing, so", lambda _: "NaN"),
}


@pytest.mark.parametrize("kind", TIMES)
def test_without_usable_times_the_frames_tell_one_recording_named_by_the_file(tmp_path, expected, kind):
    note, time = TIMES[kind]
    recording, tracks, notes = read(tmp_path, [row | {"Global_Time": time(row["Frame_ID"])} for row in TRAFFIC])
    assert recording == "my-drive"
    assert notes[0].startswith(note)
    assert_frame_equal(tracks, expected)


def test_a_file_without_times(tmp_path, expected):
    names = [name for name in TEXT_NAMES if name != "Global_Time"]
    recording, tracks, notes = read(tmp_path, TRAFFIC, names, name="us-101-0805.csv")
    assert (recording, notes) == ("us-101-0805", ["no times tell its recordings apart, so it is read as one"])
    assert_frame_equal(tracks, expected)


def test_times_in_seconds_are_read_exactly(tmp_path, expected):
    rows = [row | {"Global_Time": f"{(KEY + 100 * row['Frame_ID']) / 1000:.1f}"} for row in TRAFFIC]
    recording, tracks, notes = read(tmp_path, rows)
    assert (recording, notes) == ("us-101-0750", ["Global_Time is in seconds, and is read as such"])
    assert_frame_equal(tracks, expected)
