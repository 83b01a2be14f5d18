"""Files in other encodings, with other line ends and separators, hold the rows of the plain file."""

import gzip

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_texts import TEXT_NAMES, as_csv, as_text, check_accounts, ngsim, ngsim_row, tracks_of, write

from tracklake.pipeline.sources.csv import fetch_lines
from tracklake.pipeline.sources.csv.plain_text import TextForm, convert_text, recognise_form
from tracklake.pipeline.sources.csv.raw_files import open_raw
from tracklake.pipeline.sources.source import RawFile

ROWS = [ngsim_row(7, f, Preceding=3, Following="", v_Acc="1.5", Space_Headway="50.25") for f in range(1, 6)]
PLAIN = as_csv(ROWS, TEXT_NAMES)
BARE = as_csv(ROWS, TEXT_NAMES, header=())

FORMS = {
    "utf-16": PLAIN.decode().encode("utf-16"),
    "utf-16 of the other byte order, without mark": PLAIN.decode().encode("utf-16-be"),
    "utf-16 with carriage returns": PLAIN.replace(b"\n", b"\r").decode().encode("utf-16"),
    "carriage returns alone": PLAIN.replace(b"\n", b"\r"),
    "semicolons": PLAIN.replace(b",", b";"),
    "semicolons and decimal commas": PLAIN.replace(b",", b";").replace(b".", b","),
    "the same, quoted": b"".join(
        b";".join(b'"%s"' % cell.replace(b".", b",") for cell in line.split(b",")) + b"\n"
        for line in PLAIN.splitlines()
    ),
    "the same, without header": BARE.replace(b",", b";").replace(b".", b","),
    "tabs": PLAIN.replace(b",", b"\t"),
    "tabs, without header": BARE.replace(b",", b"\t"),
}


@pytest.mark.parametrize("packed", [False, True], ids=["", "gzip"])
@pytest.mark.parametrize("name", FORMS)
def test_the_rows_are_those_of_the_plain_file(tmp_path, name, packed):
    expected = ngsim(tmp_path / "expected", PLAIN)
    data = FORMS[name]
    canonical = ngsim(tmp_path / "got", gzip.compress(data) if packed else data)
    assert tracks_of(canonical).equals(tracks_of(expected))
    assert canonical.rejects.is_empty()
    assert tracks_of(canonical)["follower_id"].null_count() == 5


@pytest.mark.parametrize("name", ["utf-16", "carriage returns alone", "semicolons and decimal commas"])
def test_a_rejected_row_keeps_its_number(tmp_path, name):
    bad = PLAIN.replace(b",1.5,", b",fast,", 3).replace(b",fast,", b",1.5,", 2)
    data = {
        "utf-16": bad.decode().encode("utf-16"),
        "carriage returns alone": bad.replace(b"\n", b"\r"),
        "semicolons and decimal commas": bad.replace(b",", b";").replace(b".", b","),
    }[name]
    canonical = ngsim(tmp_path, data)
    assert canonical.rejects.select("line", "reason").rows() == [(4, "not a number: v_Acc")]
    assert canonical.rejects["text"][0] == bad.splitlines()[3].decode()
    check_accounts(canonical, entries_from=["trajectories.csv"])


@pytest.mark.parametrize(
    "data",
    [
        PLAIN,
        PLAIN.replace(b"\n", b"\r\n"),
        as_text(ROWS[:1]),
        b"id,upperLaneMarkings,x\n1,8.51;12.59;16.43;20.1;24.5,2\n",
        b"",
        b"\r\n",
        bytes(range(256)),
    ],
    ids=["csv", "crlf", "text", "semicolons in a field", "empty", "blank line", "noise"],
)
def test_plain_text_stays_as_it_is(data):
    assert recognise_form(data).is_plain


@given(text=st.text(alphabet="ab;,.\r\n\u20ac\U0001f697", max_size=40), size=st.integers(1, 50))
@settings(max_examples=40, deadline=None)
def test_conversion_keeps_every_character(tmp_path_factory, text, size):
    """Read in pieces of any size, as from a stream that gives few bytes at a time."""
    form = TextForm("utf-16-le", ((b";", b","), (b",", b".")))
    path = write(tmp_path_factory.mktemp("form") / "raw", text.encode("utf-16-le"))
    with path.open("rb") as handle:
        stream = convert_text(handle, form)
        found = b"".join(iter(lambda: stream.read(size), b""))
    assert found.decode() == text.translate({ord(";"): ",", ord(","): "."})


def test_lines_are_fetched_from_the_plain_form(tmp_path):
    file = RawFile(write(tmp_path / "raw.csv", b"a;b;c;d;e\r1;2;3;4;5,5\r"), "raw.csv")
    assert fetch_lines(file, pl.Series([2])).rows() == [(2, "1,2,3,4,5.5")]
    with open_raw(file) as handle:
        assert handle.read() == b"a,b,c,d,e\n1,2,3,4,5.5\n"
