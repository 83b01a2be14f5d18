"""The columns of a file are known by its header, or found to fit; never silently something else."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal
from raw_texts import TEXT_NAMES, as_csv, ngsim, ngsim_row, tracks_of
from traffic_rows import make_traffic, reorder

from tracklake.pipeline.sources.ngsim_heading import read_heading
from tracklake.pipeline.sources.source import SourceError

TRAFFIC = make_traffic()
PLAIN = as_csv(TRAFFIC, TEXT_NAMES)
OTHER_NAMES = ("id", "frame", "total", "time", "x", "y", "gx", "gy", "length", "width", "class", "v", "a", "lane",
               "leader", "follower", "gap", "headway time")  # fmt: skip


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return tracks_of(ngsim(tmp_path_factory.mktemp("expected"), PLAIN))


def bare(names=TEXT_NAMES):
    return as_csv(TRAFFIC, names, header=())


HEADED = {
    "blanks in names": as_csv(TRAFFIC, TEXT_NAMES, header=[name.replace("_", " ").upper() for name in TEXT_NAMES]),
    "units": PLAIN.replace(b"Local_X", b"local_x(ft)").replace(b"v_Vel", b"V_Vel [ft/s]"),
    "names of the US-101 download": PLAIN.replace(b"Preceding", b"Preceeding")
    .replace(b"Space_Headway", b"Space_Hdwy").replace(b"Time_Headway", b"Time_Hdwy"),
    "blanks between the names": PLAIN.replace(b",", b" "),
    "a number sign before the names": b"# " + PLAIN.replace(b",", b" "),
    "a comment above the names": b"# from a script\n\n" + PLAIN,
    "row names": b"".join(b"%d " % number * (number > 0) + line.replace(b",", b" ") + b"\n"
                          for number, line in enumerate(PLAIN.splitlines())),
    "no header": bare(),
    "an index and no header": b"".join(b"%d," % number + line + b"\n" for number, line in enumerate(bare().split())),
    "a further column and no header": bare().replace(b"\n", b",0.5\n"),
    "a comment and no header": b"recorded in 2005\n" + bare(),
}  # fmt: skip


@pytest.mark.parametrize("name", HEADED)
def test_columns_are_matched(tmp_path, expected, name):
    assert_frame_equal(tracks_of(ngsim(tmp_path, HEADED[name])), expected)


@pytest.mark.parametrize("separator", [b",", b"\t", b" "])
def test_a_header_of_unknown_names_is_never_one_bad_line(tmp_path, separator):
    """Each column has the place of another one: without its header the file looks like the original's."""
    data = as_csv(TRAFFIC, reorder(("Local_X", "Local_Y")), header=[name.replace(" ", "_") for name in OTHER_NAMES])
    with pytest.raises(SourceError) as refused:
        ngsim(tmp_path, data.replace(b",", separator))
    message = str(refused.value)
    assert "line 1: a header without Vehicle_ID, Frame_ID, Local_X, Local_Y, v_Vel" in message
    assert "not understood: id, frame, total, time, x, y" in message
    assert '[columns]\nVehicle_ID = "id"\nFrame_ID = "frame"\nLocal_X = "?"\n' in message


@pytest.mark.parametrize(
    ("swaps", "columns"),
    [
        ([("Local_X", "Local_Y")], "Local_X = 6\nLocal_Y = 5"),
        ([("v_Vel", "v_Acc")], "v_Vel = 13"),
        ([("Preceding", "Following")], "Preceding = 16\nFollowing = 15"),
        ([("Vehicle_ID", "Frame_ID")], "Vehicle_ID = 2\nFrame_ID = 1"),
        ([("v_length", "v_Width")], "v_length = 10\nv_Width = 9"),
        ([("Vehicle_ID", "Frame_ID"), ("Local_X", "Local_Y")], "ID = 2\nFrame_ID = 1\nLocal_X = 6\nLocal_Y = 5"),
    ],
)  # fmt: skip
def test_swapped_columns_without_header_are_found_and_named(tmp_path, swaps, columns):
    with pytest.raises(SourceError, match="its columns are not what they are called") as refused:
        ngsim(tmp_path, bare(reorder(*swaps)))
    assert columns in str(refused.value)


@pytest.mark.parametrize(
    ("one", "other", "problem"),
    [
        ("Local_X", "Local_Y", "times as far along Local_X"),
        ("v_length", "v_Width", r"v_Width of 14.* is larger than v_length of 6"),
        ("Preceding", "Following", "only 0% of the vehicles in Preceding are ahead"),
        ("Vehicle_ID", "Frame_ID", "Global_Time advances by 0 ms"),
        ("v_Vel", "v_Acc", "times v_Vel, which fits no unit of speed"),
    ],
)
def test_swapped_columns_under_a_header_are_refused(tmp_path, one, other, problem):
    with pytest.raises(SourceError, match=problem):
        ngsim(tmp_path, as_csv(TRAFFIC, reorder((one, other)), header=TEXT_NAMES))


INDISTINCT = {"Global_X", "Global_Y", "Total_Frames"}
"""Columns that do not matter, or that nothing else in a file tells."""


@given(order=st.permutations(TEXT_NAMES))
@settings(max_examples=20, deadline=None)
def test_no_order_of_columns_is_read_under_wrong_names(tmp_path_factory, order):
    try:
        found = tracks_of(ngsim(tmp_path_factory.mktemp("order"), bare(order)))
    except (SourceError, AssertionError):  # refused, or no row could be read
        return
    moved = {name for name, given in zip(TEXT_NAMES, order, strict=True) if name != given}
    assert moved <= INDISTINCT, found.height


def test_a_unit_that_is_not_known_is_refused(tmp_path):
    with pytest.raises(SourceError, match=r"'Local_X\(yd\)' has a unit that is not known. Expected one of ft"):
        ngsim(tmp_path, PLAIN.replace(b"Local_X", b"Local_X(yd)"))


@pytest.mark.parametrize(
    "data",
    [b"", b"a,b,c\n1,2,3\n", b"date value\n1 2\n", b"%PDF-1.4 some text\n", b"name,size\n" + bare()[:0], b'"\r"x,y\n'],
)
def test_other_files_are_no_recordings(data):
    assert read_heading(data, "other") is None


def test_a_damaged_first_line_is_no_header(tmp_path):
    rows = as_csv([ngsim_row(7, frame) for frame in (1, 2, 3)], TEXT_NAMES, header=())
    canonical = ngsim(tmp_path, rows.replace(b"7,1,", b"7,x,", 1))
    assert canonical.rejects.select("line", "reason").rows() == [(1, "not a number: Frame_ID")]
