"""Every line is kept, or rejected with its number, its text and a reason."""

import gzip

import polars as pl
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal
from raw_texts import physical_lines
from raw_texts import write as write_bytes

from tracklake.pipeline.sources.csv import Layout, fetch_lines, raw_files, read_chunks, read_head
from tracklake.pipeline.sources.csv.line_bytes import split_lines, squeeze_blanks
from tracklake.pipeline.sources.csv.plain_text import recognise_form
from tracklake.pipeline.sources.csv.reader import _parse_line_by_line, _parse_strictly, parse_lines
from tracklake.pipeline.sources.source import RawFile, SourceError

DTYPES = {"id": pl.Int32(), "count": pl.Int32(), "x": pl.Float64(), "site": pl.String()}
NAMES = ("id", "note", "count", "x", "site")
LAYOUT = Layout(
    names=NAMES,
    dtypes=DTYPES,
    required=frozenset({"id", "x", "site"}),
    thousands=frozenset({"count"}),
    bounds={"id": (0, None), "x": (-100.0, 100.0)},
    choices={"site": ("here", "there")},
)
PLAIN = Layout(
    names=("id", "note", "count", "x"),
    dtypes={name: DTYPES[name] for name in ("id", "count", "x")},
    required=frozenset({"id", "count", "x"}),
    header_lines=0,
    blanks=True,
)
HEADER = b"id,note,count,x,site\n"
GOOD = b'1,a,"1,156",2.5,here\n2,,3,-1e1,There\n3,"b,c",,.5,here\n'


def write(path, data):
    """The file, as readers take it."""
    return RawFile(write_bytes(path, data), path.name)


def rows_of(frame):
    return frame.select("line", *[name for name in DTYPES if name in frame.columns]).rows()


def read(tmp_path, data, layout=LAYOUT, chunk_bytes=1 << 20):
    chunks = list(read_chunks(write(tmp_path / "raw.csv", data), layout, chunk_bytes=chunk_bytes))
    return (
        pl.concat([chunk.frame for chunk in chunks]),
        pl.concat([chunk.rejects for chunk in chunks]),
        sum(chunk.rows_read for chunk in chunks),
    )


def test_good_lines_are_typed_and_numbered(tmp_path):
    frame, rejects, rows_read = read(tmp_path, HEADER + GOOD)
    assert rows_of(frame) == [(2, 1, 1156, 2.5, "here"), (3, 2, 3, -10.0, "There"), (4, 3, None, 0.5, "here")]
    assert rejects.is_empty()
    assert rows_read == 3
    assert dict(frame.schema) == {"line": pl.Int64(), **DTYPES}


@pytest.mark.parametrize(("layout", "data"), [(LAYOUT, GOOD), (PLAIN, b" 1 a  2\t3.5 \r\n\t2 b 4 5\n3 c 6 7")])
def test_strict_and_line_by_line_agree(layout, data):
    rows = data.count(b"\n") + (not data.endswith(b"\n"))
    strict = _parse_strictly(data, layout, rows, 5)
    slow = _parse_line_by_line(data, layout, rows, 5)
    assert strict is not None
    assert slow.rejects.is_empty()
    assert_frame_equal(strict, slow.frame)
    assert strict["line"].to_list() == list(range(5, 5 + rows))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"", "blank line"),
        (b"  ", "blank line"),
        (b"1,a,2,\0003,here", "NUL byte"),
        (b"1,\xff,2,3,here", "not UTF-8"),
        (b"id,note,count,x,site", "repeated header"),
        (b'"ID","note","count","x","site"', "repeated header"),
        (b'1,"a,2,3,here', "unbalanced quotes"),
        (b'1,a"b"c,2,3,here', "misplaced quotes"),
        (b'1,"a"b,2,3,here', "misplaced quotes"),
        (b'1,"a""b",2,3,here', "misplaced quotes"),
        (b"1,a,2,3", "4 fields instead of 5"),
        (b"1", "1 fields instead of 5"),
        (b"1,a,2,3,here,", "6 fields instead of 5"),
        (b"1,,a,2,3,here", "6 fields instead of 5"),
        (b"x,a,2,3,here", "not a number: id"),
        (b"1,a,two,3,here", "not a number: count"),
        (b'1,a,"1,15",3,here', "not a number: count"),
        (b'1,a,"11,56,000",3,here', "not a number: count"),
        (b"1,a,2,nan,here", "not a number: x"),
        (b"1,a,2,inf,here", "not a number: x"),
        (b"1,a,2,-infinity,here", "not a number: x"),
        (b"1,a,2,1e999,here", "not a number: x"),
        (b"1.5,a,2,3,here", "not a plain whole number: id"),
        (b"1.12E+12,a,2,3,here", "digits lost in scientific notation (a spreadsheet rounded it): id"),
        (b"1.5e+00,a,2,3,here", "not a plain whole number: id"),
        (b"1,a,2.5,3,here", "not a plain whole number: count"),
        (b"99999999999,a,2,3,here", "out of range: id"),
        (b'1,a,"99,999,999,999",3,here', "out of range: count"),
        (b"-1,a,2,3,here", "out of range: id"),
        (b"1,a,2,100.001,here", "out of range: x"),
        (b"1,a,2,-1e300,here", "out of range: x"),
        (b",a,2,3,here", "empty: id"),
        (b"1,a,2,,here", "empty: x"),
        (b"1,a,2,3,", "empty: site"),
        (b"1,a,2,3,her", "unknown value: site"),
        (b'1,a,2,3,""', "empty: site"),
    ],
)
def test_every_reason(tmp_path, line, reason):
    data = HEADER + GOOD + line + b"\n" + GOOD
    frame, rejects, rows_read = read(tmp_path, data)
    assert rejects.select("line", "reason").rows() == [(5, reason)]
    assert rejects["text"][0] == line.decode("utf-8", errors="replace")
    assert frame["line"].to_list() == [2, 3, 4, 6, 7, 8]
    assert rows_read == 7


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"", "blank line"),
        (b" \t\r", "blank line"),
        (b"1 a 2", "3 fields instead of 4"),
        (b"1 a 2 3 4", "5 fields instead of 4"),
        (b"1 a 2 3\r4", "5 fields instead of 4"),
        (b"id note count x", "repeated header"),
        (b"1 a 2 1,5", "not a number: x"),
        (b'"1" a 2 3', "not a number: id"),
    ],
)
def test_every_reason_between_blanks(tmp_path, line, reason):
    frame, rejects, rows_read = read(tmp_path, b"1 a 2 3\n" + line + b"\n  2 \t b 4 5\n", PLAIN)
    assert rejects.rows() == [(2, reason, line.removesuffix(b"\r").decode())]
    assert rows_of(frame) == [(1, 1, 2, 3.0), (3, 2, 4, 5.0)]
    assert rows_read == 3


def test_a_field_too_many_shifts_no_column_even_if_every_wanted_value_would_parse(tmp_path):
    """Field 2 is not wanted, so a reader that stops at the last wanted field would accept 9 as the count."""
    layout = Layout(names=("id", "count", "x", "rest"), dtypes={"id": pl.Int32(), "count": pl.Int32()},
                    required=frozenset({"id"}))  # fmt: skip
    frame, rejects, rows_read = read(tmp_path, b"id,count,x,rest\n1,2,3,4\n1,9,2,3,4\n1,2\n1,2,3,\n", layout)
    assert frame.rows() == [(2, 1, 2), (5, 1, 2)]
    assert rejects["reason"].to_list() == ["5 fields instead of 4", "2 fields instead of 4"]
    assert rows_read == 4


def test_whole_numbers_written_with_a_fraction_of_zero(tmp_path):
    frame, rejects, _ = read(tmp_path, HEADER + b'1.0,a,"1,156.00",2.5,here\n-0.0,a,,2.5,here\n')
    assert rejects.is_empty()
    assert rows_of(frame) == [(2, 1, 1156, 2.5, "here"), (3, 0, None, 2.5, "here")]


def test_whole_numbers_in_scientific_notation_that_lost_no_digit(tmp_path):
    lines = b"1.113000e+03,a,,2.5,here\n1e0,a,5.000000000000000000e+00,2.5,here\n"
    frame, rejects, _ = read(tmp_path, HEADER + lines)
    assert rejects.is_empty()
    assert rows_of(frame) == [(2, 1113, None, 2.5, "here"), (3, 1, 5, 2.5, "here")]


@pytest.mark.parametrize("word", ["NaN", "nan", "NA", "<NA>", "null", "None", " NaN "])
def test_words_for_a_missing_value(tmp_path, word):
    """Null where the column may be null, else no number."""
    frame, rejects, _ = read(tmp_path, HEADER + f"1,a,{word},2.5,here\n2,a,3,{word},here\n".encode())
    assert rows_of(frame) == [(2, 1, None, 2.5, "here")]
    assert rejects.rows() == [(3, "not a number: x", f"2,a,3,{word},here")]


def test_an_empty_last_field_may_be_null(tmp_path):
    layout = Layout(**{**vars(LAYOUT), "required": frozenset({"id"})})
    frame, rejects, _ = read(tmp_path, HEADER + b"1,a,2,2.5,\n2,a,2,2.5\n3,a,2,2.5,there\n", layout)
    assert rows_of(frame) == [(2, 1, 2, 2.5, None), (4, 3, 2, 2.5, "there")]
    assert rejects["reason"].to_list() == ["4 fields instead of 5"]


def test_every_field_quoted(tmp_path):
    frame, rejects, _ = read(tmp_path, HEADER + b'"1","a","2","3.5","here"\r\n"2","","","3","there"\r\n')
    assert rejects.is_empty()
    assert rows_of(frame) == [(2, 1, 2, 3.5, "here"), (3, 2, None, 3.0, "there")]


@pytest.mark.parametrize("chunk_bytes", [1, 7, 30, 1 << 20])
@pytest.mark.parametrize("bom", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.parametrize("last", [b"", b"\n"])
def test_numbers_hold_across_chunks(tmp_path, chunk_bytes, bom, end, last):
    lines = [b"id,note,count,x,site", b"1,a,2,3,here", b"", b"bad", b"4,a,2,3,here", b"5,a,2,\0,here", b"6,a,2,3,here"]
    data = bom + end.join(lines) + (end if last else b"")
    frame, rejects, rows_read = read(tmp_path, data, chunk_bytes=chunk_bytes)
    assert frame.select("line", "id").rows() == [(2, 1), (5, 4), (7, 6)]
    assert rejects.rows() == [
        (3, "blank line", ""),
        (4, "1 fields instead of 5", "bad"),
        (6, "NUL byte", "5,a,2,\0,here"),
    ]
    assert rows_read == 6


def test_a_file_without_a_header_may_begin_with_a_byte_order_mark(tmp_path):
    data = b"\xef\xbb\xbf1 a 2 3\n2 b 4\n"
    frame, rejects, _ = read(tmp_path, data, PLAIN)
    assert frame["id"].to_list() == [1]
    assert rejects["line"].to_list() == [2]
    path = write(tmp_path / "bom.txt", data)
    assert fetch_lines(path, pl.Series([1, 2])).rows() == [(1, "1 a 2 3"), (2, "2 b 4")]


@pytest.mark.parametrize("data", [b"", b"id,note,count,x,site", HEADER, b"\xef\xbb\xbf" + HEADER])
def test_no_rows(tmp_path, data):
    chunks = list(read_chunks(write(tmp_path / "raw.csv", data), LAYOUT))
    assert sum(chunk.rows_read for chunk in chunks) == 0
    assert all(chunk.frame.is_empty() and chunk.rejects.is_empty() for chunk in chunks)


def test_compressed_files_are_read_alike(tmp_path):
    data = HEADER + GOOD * 50
    plain = read(tmp_path, data)
    packed = read(tmp_path, gzip.compress(data), chunk_bytes=64)
    assert_frame_equal(plain[0], packed[0])
    assert plain[2] == packed[2] == 150


@pytest.mark.parametrize("damage", ["cut", "cut early", "flipped", "magic only", "garbage after"])
def test_damaged_compression_is_a_clear_refusal(tmp_path, damage):
    whole = gzip.compress(HEADER + b"".join(b"%d,a,%d,3.%d,here\n" % (i, i, i * i) for i in range(20_000)))
    data = {
        "cut": whole[: len(whole) // 2],
        "cut early": whole[:30],
        "flipped": whole[:5000] + bytes([whole[5000] ^ 255]) * 40 + whole[5040:],
        "magic only": whole[:2],
        "garbage after": whole + b"\x1f\x8bgarbage",
    }[damage]
    path = write(tmp_path / "raw.csv.gz", data)
    with pytest.raises(SourceError, match=r"raw\.csv\.gz: the compressed file is damaged or cut short .*again"):
        list(read_chunks(path, LAYOUT))


def test_the_head_of_a_file_that_is_cut_short_can_still_be_recognised(tmp_path):
    whole = gzip.compress(HEADER + b"".join(b"%d,a,%d,3.%d,here\n" % (i, i, i * i) for i in range(20_000)))
    assert read_head(write(tmp_path / "a.gz", whole[: len(whole) // 2])).startswith(HEADER)
    with pytest.raises(SourceError, match="damaged"):
        read_head(write(tmp_path / "b.gz", whole[:2]))


def test_a_small_file_of_repeated_rows_is_refused_before_it_fills_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(raw_files, "FREE_TEXT_BYTES", 1000)
    path = write(tmp_path / "raw.csv.gz", gzip.compress(HEADER + b"1,a,2,3,here\n" * 20_000))
    with pytest.raises(SourceError, match=r"raw\.csv\.gz: unpacks to more than 0 MiB, 40 times its size.*repeats"):
        list(read_chunks(path, LAYOUT, chunk_bytes=1000))


def test_a_replacement_character_is_valid_text():
    lines = split_lines("\N{REPLACEMENT CHARACTER} ok\n".encode() + b"\xff\n")
    assert lines["utf8"].to_list() == [True, False]


def slow_squeeze(data):
    lines = data.replace(b"\t", b" ").replace(b"\r", b" ").split(b"\n")
    return b"\n".join(b" ".join(word for word in line.split(b" ") if word) for line in lines)


@given(st.text(alphabet=" \t\r\nab", max_size=60))
@settings(max_examples=35, deadline=None)
def test_squeezing_against_splitting_and_joining(text):
    assert squeeze_blanks(text.encode()) == slow_squeeze(text.encode())


def mutate(data, edits):
    """Apply (where, what, bytes): flip, cut, insert, copy a line, swap two fields of a line."""
    for where, what, extra in edits:
        at = where % (len(data) + 1)
        if what == "flip" and at < len(data):
            data = data[:at] + bytes([data[at] ^ (extra[0] if extra else 1)]) + data[at + 1 :]
        elif what == "cut":
            data = data[:at] + data[at + len(extra) * 3 :]
        elif what == "insert":
            data = data[:at] + extra + data[at:]
        elif what == "end":
            data = data[:at]
        else:
            lines = data.split(b"\n")
            line = where % len(lines)
            if what == "copy":
                lines.insert(where % 7, lines[line])
            else:
                fields = lines[line].split(b",")
                fields[0], fields[-1] = fields[-1], fields[0]
                lines[line] = b",".join(fields)
            data = b"\n".join(lines)
    return data


def edits():
    what = st.sampled_from(["flip", "cut", "insert", "copy", "swap", "insert", "end"])
    spice = st.sampled_from(
        [b'"', b",", b"\n", b"\r", b"\0", b"\xff", b" ", b"-", b"9", b".", b"e", b'""', b"\xef\xbb\xbf"]
    )
    return st.lists(st.tuples(st.integers(0, 5000), what, spice), min_size=1, max_size=6)


@given(edits=edits(), chunk_bytes=st.sampled_from([1, 20, 100, 1 << 20]), comma=st.booleans())
@example(edits=[(3, "insert", b'"'), (60, "insert", b'"')], chunk_bytes=1, comma=True)
@example(edits=[(5, "insert", b"\r")], chunk_bytes=1 << 20, comma=False)
@settings(max_examples=105, deadline=None)
def test_no_damage_crashes_or_loses_a_line(tmp_path_factory, edits, chunk_bytes, comma):
    good = GOOD * 3 if comma else b" 1 a  2\t3.5 \r\n\t2 b 4 5\n3 c 6 7\n" * 3
    data = mutate(good, edits)
    assume(recognise_form(data).is_plain)  # what ends in carriage returns alone has other lines
    layout = Layout(**{**vars(LAYOUT), "header_lines": 0}) if comma else PLAIN
    path = write(tmp_path_factory.mktemp("fuzz") / "raw", data)
    chunks = list(read_chunks(path, layout, chunk_bytes=chunk_bytes))
    lines = physical_lines(data)
    kept = [line for chunk in chunks for line in chunk.frame["line"]]
    rejected = {line: text for chunk in chunks for line, _, text in chunk.rejects.rows()}
    assert sorted(kept + list(rejected)) == sorted(lines)
    assert sum(chunk.rows_read for chunk in chunks) == len(lines)
    assert rejected == {line: lines[line] for line in rejected}
    # The size of the chunks, and so which of the two parsers reads a line, changes nothing.
    whole = parse_lines(data, layout)
    if chunks:
        assert_frame_equal(whole.frame, pl.concat([chunk.frame for chunk in chunks]))
        assert_frame_equal(whole.rejects, pl.concat([chunk.rejects for chunk in chunks]))
