from datetime import UTC, datetime
from pathlib import Path

import polars as pl
import pytest
from lake_sources import EXCERPTS

from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.bsmp1 import FIELDS, read_bsmp1, recognise_bsmp1
from tracklake.pipeline.sources.v2v.messages import MESSAGE_SCHEMA

LINE = "7,12,9,500000,305419896,5,23500,35.9482912785,-83.9344627161,250.5,12.5,304.05,1.5,-0.25,0.1,-3.5,4,100,80"
REAL = EXCERPTS.parent / "v2v"


def write_file(tmp_path: Path, *lines: str) -> RawFile:
    path = tmp_path / "messages.csv"
    path.write_text("".join(f"{line}\n" for line in lines))
    return RawFile(path, path.name)


def change(**cells: object) -> str:
    values = dict(zip(FIELDS, LINE.split(","), strict=True)) | {name: str(value) for name, value in cells.items()}
    return ",".join(values[name] for name in FIELDS)


@pytest.mark.parametrize("header", [(), (",".join(FIELDS),)], ids=["bare", "header"])
def test_a_line_becomes_one_message(tmp_path, header):
    raw = read_bsmp1(write_file(tmp_path, *header, LINE))
    assert raw.frame.schema == MESSAGE_SCHEMA
    assert raw.rows_read == 1
    assert raw.rejects.is_empty()
    row = raw.frame.row(0, named=True)
    assert row["line"] == 1 + len(header)
    # Gentime counts from 2004-01-01 UTC; 305419896 is 0x12345678.
    assert row["utc_us"] == datetime(2004, 1, 1, 0, 0, 0, 500_000, UTC).timestamp() * 1e6
    given = {"receiver": "7", "sender": "9", "own": False, "temporary_id": "12345678", "message_count": 5}
    given |= {"second_mark_ms": 23500, "received_us": None, "lat_deg": 35.9482912785, "lon_deg": -83.9344627161}
    given |= {"elevation_m": 250.5, "speed_mps": 12.5, "accel_mps2": 1.5, "lateral_accel_mps2": -0.25}
    given |= {"yaw_rate_degps": -3.5, "length_m": None, "transmission": None}
    assert {name: row[name] for name in given} == given
    assert row["heading_deg"] == pytest.approx(304.05, abs=1e-4)


def test_codes_for_unavailable_become_null(tmp_path):
    cells = {"Elevation": -409.6, "Speed": 163.82, "Heading": 360, "Ax": 20.01, "Ay": 20.01, "Az": -24.91}
    row = read_bsmp1(write_file(tmp_path, change(**cells, DSecond=65535, TxRandom=0))).frame.row(0, named=True)
    unknown = ["elevation_m", "speed_mps", "heading_deg", "accel_mps2", "lateral_accel_mps2", "vertical_accel_mps2"]
    assert [row[name] for name in [*unknown, "second_mark_ms"]] == [None] * 7
    assert row["temporary_id"] == "9"  # no random id: the device


@pytest.mark.parametrize(
    ("cells", "reason"),
    [
        ({"Latitude": 0, "Longitude": 0}, "position (0, 0)"),
        ({"Latitude": 80.01}, "latitude outside -84 to 80 degrees"),
        ({"Latitude": -84.01}, "latitude outside -84 to 80 degrees"),
        ({"Longitude": 180}, "longitude not between -180 and 180 degrees"),
        ({"Heading": 360.1}, "heading_deg outside 0 to 360"),
        ({"Speed": -0.5}, "speed_mps outside 0 to 200"),
        ({"MsgCount": 128}, "message count outside 0 to 127"),
        ({"Gentime": -1}, "time before 2004 or after 2100"),
        ({"Gentime": 2**62}, "time before 2004 or after 2100"),
        ({"Latitude": ""}, "empty: Latitude"),
        ({"TxDevice": "x"}, "not a number: TxDevice"),
        ({"Speed": "nan"}, None),
        ({"Latitude": 80, "Heading": 0}, None),
    ],
)
def test_impossible_messages_are_rejects_with_reason_and_text(tmp_path, cells, reason):
    line = change(**cells)
    raw = read_bsmp1(write_file(tmp_path, LINE, line, LINE))
    assert raw.rows_read == 3
    expected = [] if reason is None else [(2, reason, line)]
    assert raw.rejects.rows() == expected
    assert raw.frame["line"].to_list() == [1, 2, 3][: 3 - len(expected)] if not expected else [1, 3]


def test_damaged_lines_are_rejects(tmp_path):
    raw = read_bsmp1(write_file(tmp_path, LINE, "", LINE + ",1", "\0", LINE[:20], LINE))
    assert raw.frame["line"].to_list() == [1, 6]
    assert raw.rejects["line"].to_list() == [2, 3, 4, 5]
    assert raw.rejects["reason"].to_list() == [
        "blank line",
        "20 fields instead of 19",
        "NUL byte",
        "5 fields instead of 19",
    ]


def test_own_messages_are_those_of_the_receiving_device(tmp_path):
    raw = read_bsmp1(write_file(tmp_path, LINE, change(TxDevice=7)))
    assert raw.frame["own"].to_list() == [False, True]


def test_the_mark_of_generated_messages_is_read(tmp_path):
    assert not read_bsmp1(write_file(tmp_path, LINE)).synthetic
    assert read_bsmp1(write_file(tmp_path, LINE, change(FileId="synthetic"))).synthetic


def test_only_lines_of_bsmp1_are_recognised():
    assert recognise_bsmp1(LINE.encode())
    assert recognise_bsmp1(b"\xef\xbb\xbf" + ",".join(FIELDS).encode() + b"\r\n" + LINE.encode())
    assert recognise_bsmp1(change(FileId="synthetic").encode())
    assert not recognise_bsmp1(LINE.rpartition(",")[0].encode())
    assert not recognise_bsmp1(change(Latitude=3594).encode())
    assert not recognise_bsmp1(change(Gentime=0.5).encode())
    assert not recognise_bsmp1(b"")
    assert not recognise_bsmp1(b",".join([b"a"] * 19))


@pytest.mark.skipif(not REAL.is_dir(), reason="the real messages are not at hand")
def test_real_messages():
    raw = read_bsmp1(RawFile(REAL / "bsmp1_knoxville.csv", "bsmp1_knoxville.csv"))
    assert (raw.rows_read, raw.frame.height, raw.rejects.height) == (281, 281, 0)
    assert raw.frame["own"].all()
    # The first line of the file, rounded to single precision but for the position.
    row = raw.frame.row(0, named=True)
    assert (row["lat_deg"], row["lon_deg"]) == (35.9482912785, -83.9344627161)
    assert row["speed_mps"] == pytest.approx(1.2573485488, abs=1e-6)
    assert not raw.synthetic


@pytest.mark.skipif(not REAL.is_dir(), reason="the real messages are not at hand")
def test_real_error_cases():
    raw = read_bsmp1(RawFile(REAL / "bsmp1_errors.csv", "bsmp1_errors.csv"))
    # Lines 2 to 4 lie at (90, 180), line 5 heads 900 degrees; speeds up to 75 m/s are unlikely, not impossible.
    assert raw.rejects["line"].to_list() == [2, 3, 4, 5]
    assert raw.rejects["reason"].to_list() == [
        *["latitude outside -84 to 80 degrees"] * 3,
        "heading_deg outside 0 to 360",
    ]
    assert raw.rejects["text"][3].startswith("1,1,1,0,0,0,0,34.706185,-86.433355,0,1.2573485488,900.0,")
    assert (raw.rows_read, raw.frame.height) == (138, 134)
    assert raw.frame.select((pl.col("speed_mps") > 60).sum()).item() == 11
