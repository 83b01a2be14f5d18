"""The strict parser and the line parser accept the same lines, with the same values."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal
from raw_texts import EXPORT_NAMES, TEXT_NAMES

from tracklake.pipeline.sources.csv.line_bytes import count_lines
from tracklake.pipeline.sources.csv.reader import _parse_line_by_line, _parse_strictly
from tracklake.pipeline.sources.highd import HIGHD_FORMAT
from tracklake.pipeline.sources.levelx import RECORDING, TRACKS, VEHICLES
from tracklake.pipeline.sources.ngsim_heading import CSV, CSV_BARE, TEXT, Heading


def cells_of(text):
    return text.split(" ")


ROW_18 = cells_of("5 6 155 1163030900 -48.125 726.116 2230536.396 1376263.872 15.1 6.6 2 0.00 0.00 0 0 3 12.5 1.25")
ROW_25 = cells_of(
    '5 6 "1,156" 1163030900 -48.125 726.116 2230536.396 1376263.872 15.1 6.6 2 0.00 0.00 0 121 201 0 1 4 1 0 455 '
    '"1,000.5" 9999.99 peachtree'
)
ROW_TRACKS = cells_of(
    "1 1 162.75 9.39 4.85 2.12 40.85 0.00 0.30 0.00 340.07 70.54 0.00 0.00 0.00 0.00 0 3 0 0 0 0 0 0 2"
)
ROW_VEHICLES = cells_of("1 4.85 2.12 1 140 140 Car 2 230.5 30.5 41.2 40.9 -1.00 -1.00 -1.00 0")
ROW_RECORDING = cells_of(
    "1 25.00 2 -1.00 09.2017 Tue 08:38 9.015600e+02 1.0 1.0 10 8 2 8.51;12.59;16.43 21.00;24.96;28.80"
)


def ngsim_layout(names, dialect=CSV):
    return Heading(dialect, tuple(names), int(dialect == CSV), dialect == TEXT).to_layout()


CASES = {
    "text": (ngsim_layout(TEXT_NAMES, TEXT), ROW_18),
    "plain": (ngsim_layout(TEXT_NAMES), ROW_18),
    "no header": (ngsim_layout(TEXT_NAMES, CSV_BARE), ROW_18),
    "export": (ngsim_layout(EXPORT_NAMES), ROW_25),
    "more columns": (ngsim_layout(("remark", *EXPORT_NAMES, "more")), ['"a,b"', *ROW_25, "x"]),
    "tracks": (HIGHD_FORMAT.build_layout(TRACKS), ROW_TRACKS),
    "vehicles": (HIGHD_FORMAT.build_layout(VEHICLES), ROW_VEHICLES),
    "recording": (HIGHD_FORMAT.build_layout(RECORDING), ROW_RECORDING),
}
CELLS = [
    *("", " ", '""', '"', '" "', '"5"', '" 5"', '"5 "', '"a"b', 'a"b', "null", "true", "x", "#5", "'5'", "\u0665"),
    *("1156.0", "+5", "+-5", "+5.0", ".5", "5.", "-.5", "1e3", "1E+3", "1.e5", "e5", "1.5e", "1d5", "0x10", "1_000"),
    *("inf", "-inf", "Infinity", "nan", "NaN", "1e400", "1e-400", "-0", "0005", " 5", "5 ", "\t5", "5\r", "\x0b5"),
    *('"1,15"', '"1,156"', '"-1,156"', '"1,156,789"', '"12,34,567"', '"1,156.25"', '"1,156.12345"', '"1,156."'),
    *("1,156", '"001,156"', "2147483647", "2147483648", "-1", "9223372036854775808", "1.12E+12", "1163030900.0"),
    *("9007199254740993", "0.30000000000000004", "1.0000000000000000001", "2.2250738585072011e-308", "\xa05", "5\x0c"),
    *("\ufeff5", "car", "TRUCK", "us-101", " us-101", '"I-80"', "8.51;12.59 ", "\x858.51"),
]
SPICE = [*(bytes([byte]) for byte in b'",\r\n\t .-+eE09\0\x0b\xff'), b"\xef\xbb\xbf", b'""', b'","', b",,", b"\r\n"]


@st.composite
def texts(draw, row, blanks):
    """A few lines of odd cells, with some bytes put in or cut out of them."""
    separator = st.sampled_from([" ", "  ", "\t"] if blanks else [","])
    lines = []
    for _ in range(draw(st.integers(1, 3))):
        cells = list(row)
        for place in draw(st.lists(st.integers(0, len(row) - 1), max_size=2)):
            cells[place] = draw(st.sampled_from(CELLS))
        margin = st.sampled_from(["", "", "", " ", "\t", "  "])
        lines.append(draw(margin) + draw(separator).join(cells) + draw(margin))
    data = draw(st.sampled_from(["\n", "\r\n"])).join(lines).encode() + draw(st.sampled_from([b"\n", b"", b"\r\n"]))
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, len(data)))
        data = data[:at] + draw(st.sampled_from([*SPICE, b""])) + data[at + draw(st.integers(0, 3)) :]
    return data


@pytest.mark.parametrize("case", CASES)
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_what_is_accepted_at_once_is_accepted_line_by_line(case, data):
    layout, row = CASES[case]
    check(data.draw(texts(row, layout.blanks)), layout)


@given(data=st.just(",".join(ROW_RECORDING).encode()))
@example(data=",".join([*ROW_RECORDING[:-1], ROW_RECORDING[-1] + " "]).encode())
@example(data=",".join([*ROW_RECORDING[:-2], " ", ROW_RECORDING[-1]]).encode())
@example(data=",".join([*ROW_RECORDING[:-2], '""', ROW_RECORDING[-1]]).encode())
@example(data=",".join('""' if cell == "Tue" else cell for cell in ROW_RECORDING).encode())
@settings(max_examples=1, deadline=None)
def test_blanks_and_quotes_around_a_text_do_not_depend_on_the_parser(data):
    check(data, CASES["recording"][0])


@pytest.mark.parametrize("case", CASES)
def test_the_rows_themselves_are_accepted_at_once(case):
    layout, row = CASES[case]
    assert len(row) == len(layout.names)
    assert check((layout.separator.join(row) + "\n").encode() * 2, layout) is not None


def check(data, layout):
    rows = count_lines(data)
    strict, slow = _parse_strictly(data, layout, rows, 1), _parse_line_by_line(data, layout, rows, 1)
    assert slow.frame.height + slow.rejects.height == slow.rows_read == rows
    if strict is not None:
        assert slow.rejects.is_empty()
        assert_frame_equal(strict, slow.frame, check_exact=True)
    return strict
