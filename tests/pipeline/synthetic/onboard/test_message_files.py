import json
from datetime import UTC, datetime

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_logs import MESSAGE, make_messages
from test_uper import FRAME

from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.bsmp1 import read_bsmp1, recognise_bsmp1
from tracklake.pipeline.sources.v2v.pilot_json import read_pilot_json, recognise_pilot_json
from tracklake.pipeline.synthetic.onboard.bsmp1_files import write_bsmp1
from tracklake.pipeline.synthetic.onboard.hex_files import encode_messages, write_hex
from tracklake.pipeline.synthetic.onboard.pilot_files import write_pilot

RESOLUTION = {
    "lat_deg": 1e-7,
    "lon_deg": 1e-7,
    "elevation_m": 0.1,
    "speed_mps": 0.02,
    "heading_deg": 0.0125,
    "accel_mps2": 0.01,
    "lateral_accel_mps2": 0.01,
    "vertical_accel_mps2": 0.196133,
    "yaw_rate_degps": 0.01,
    "steering_angle_deg": 1.5,
    "semi_major_m": 0.05,
    "semi_minor_m": 0.05,
    "orientation_deg": 0.0055,
    "length_m": 0.01,
    "width_m": 0.01,
}
"""Steps in which J2735 counts, in the unit of each column."""
RANGES = {
    "lat_deg": (-83.9, 79.9),
    "lon_deg": (-179.99, 179.99),
    "elevation_m": (-409.5, 6143.9),
    "speed_mps": (0, 163.8),
    "heading_deg": (0, 359.99),
    "accel_mps2": (-20, 20),
    "lateral_accel_mps2": (-20, 20),
    "vertical_accel_mps2": (-24.7, 24.9),
    "yaw_rate_degps": (-327.67, 327.67),
    "steering_angle_deg": (-189, 189),
    "semi_major_m": (0, 12.7),
    "semi_minor_m": (0, 12.7),
    "orientation_deg": (0, 359.99),
    "length_m": (0.01, 40.95),
    "width_m": (0.01, 10.23),
}
BSMP1_COLUMNS = [*RANGES][: [*RANGES].index("steering_angle_deg")]
NEVER_NULL = ("lat_deg", "lon_deg", "yaw_rate_degps")

WRITERS = {
    "bsmp1": (write_bsmp1, read_bsmp1, recognise_bsmp1),
    "wyoming": (lambda path, rows: write_pilot(path, rows, "wyoming"), read_pilot_json, recognise_pilot_json),
    "tampa": (lambda path, rows: write_pilot(path, rows, "tampa"), read_pilot_json, recognise_pilot_json),
    "hex": (write_hex, read_pilot_json, recognise_pilot_json),
}


def draw_value(name: str) -> st.SearchStrategy[float | None]:
    values = st.floats(*RANGES[name], width=64)
    return values if name in NEVER_NULL else st.none() | values


MESSAGES = st.lists(
    st.fixed_dictionaries(
        {
            **{name: draw_value(name) for name in RANGES},
            "temporary_id": st.integers(1, 2**32 - 1).map("{:08X}".format),
            "message_count": st.integers(0, 127),
            "own": st.booleans(),
            "transmission": st.sampled_from([None, "neutral", "park", "forwardGears", "reverseGears"]),
            "utc_us": st.integers(1_300_000_000_000, 2_000_000_000_000).map(lambda ms: 1000 * ms),
        }
    ).filter(lambda row: (round(row["lat_deg"], 7), round(row["lon_deg"], 7)) != (0, 0)),
    min_size=1,
    max_size=4,
)


@pytest.mark.parametrize("form", WRITERS)
@given(rows=MESSAGES)
@settings(max_examples=12, deadline=None)
def test_what_is_written_is_read_to_the_resolution_of_the_format(tmp_path_factory, form, rows):
    write, read, recognise = WRITERS[form]
    given_rows = make_messages(*({**row, "received_us": row["utc_us"] + 40_000} for row in rows))
    path = tmp_path_factory.getbasetemp() / f"log-{form}"
    write(path, given_rows)
    assert recognise(path.read_bytes()[:65_536])
    raw = read(RawFile(path, path.name))
    assert raw.synthetic
    assert raw.rejects.is_empty()
    assert raw.frame["line"].to_list() == given_rows["line"].to_list()
    for name in BSMP1_COLUMNS if form == "bsmp1" else RANGES:
        for found, expected in zip(raw.frame[name].to_list(), given_rows[name].to_list(), strict=True):
            if expected is None:
                assert found is None, name
            else:
                apart = abs(found - expected)
                turned = min(apart, 360 - apart) if name in ("heading_deg", "orientation_deg") else apart
                assert turned <= 0.51 * RESOLUTION[name] + 1e-6 * abs(expected) * (name[:3] not in ("lat", "lon")), name
    same = ["temporary_id", "message_count", "own", *(["transmission"] if form != "bsmp1" else [])]
    assert raw.frame.select(same).equals(given_rows.select(same))
    assert raw.frame["second_mark_ms"].to_list() == [row["utc_us"] // 1000 % 60_000 for row in rows]
    if form == "bsmp1":
        assert raw.frame["utc_us"].to_list() == [row["utc_us"] for row in rows]
    else:
        assert raw.frame["received_us"].to_list() == given_rows["received_us"].to_list()


def test_a_published_message_is_encoded_as_published():
    # The core data of the message that test_uper decodes, less its optional parts: the bits after the first three.
    unknown = ["lateral_accel_mps2", "vertical_accel_mps2", "steering_angle_deg", "length_m", "width_m", "transmission"]
    row = dict.fromkeys(unknown) | {"second_mark_ms": 32_399, "orientation_deg": 0.0, "semi_minor_m": 2.0}
    (encoded,) = encode_messages(make_messages(row)).to_list()
    published, ours = (f"{int(text, 16):0{4 * len(text)}b}"[24:] for text in (FRAME, encoded))
    end = 3 + 253
    assert ours[3:end] == published[3:end]
    assert encoded.startswith("001425")
    assert len(encoded) == 2 * (3 + 37)


def test_lines_look_as_in_the_formats(tmp_path):
    messages = make_messages({"utc_us": int(datetime(2018, 5, 1, 16, 4, 23, 694_000, UTC).timestamp() * 1e6)})
    write_bsmp1(tmp_path / "bsmp1", messages)
    # 1,525,190,663.694 s since 1970 less 1,072,915,200 s; 0x9D59FB77 = 2,639,919,991.
    assert (tmp_path / "bsmp1").read_text() == (
        "1,synthetic,0,452275463694000,2639919991,93,23694,39.1874242,-104.8498164,2091.7,9.76,8.6,-4.16,0.5,0.0,-1.25,"
        "0,0,0\n"
    )
    write_pilot(tmp_path / "wyoming", messages, "wyoming")
    core = json.loads((tmp_path / "wyoming").read_text())["payload"]["data"]["coreData"]
    assert core["position"] == {"latitude": 39.1874242, "longitude": -104.8498164, "elevation": 2091.7}
    assert core["size"] == {"width": 190, "length": 570}
    assert (core["id"], core["secMark"], core["transmission"]) == ("9D59FB77", 23_694, "FORWARDGEARS")
    write_pilot(tmp_path / "tampa", messages, "tampa")
    record = json.loads((tmp_path / "tampa").read_text())
    assert record["metadata"]["logFileName"] == "synthetic"
    assert record["metadata"]["recordGeneratedAt"] == "2018-05-01T16:04:23.750Z"
    core = record["payload"]["data"]["value"]["BasicSafetyMessage"]["coreData"]
    assert [core[key] for key in ("lat", "long", "elev", "speed")] == ["391874242", "-1048498164", "20917", "488"]


def test_unknown_values_have_the_codes_of_the_formats(tmp_path):
    unknown = {name: None for name in MESSAGE if name in RANGES and name not in NEVER_NULL}
    messages = make_messages(unknown)
    write_bsmp1(tmp_path / "bsmp1", messages)
    assert (tmp_path / "bsmp1").read_text().split(",")[9:16] == (
        ["-409.6", "163.82", "360.0", "20.01", "20.01", "-24.908892", "-1.25"]
    )
    write_pilot(tmp_path / "tampa", messages, "tampa")
    data = json.loads((tmp_path / "tampa").read_text())["payload"]["data"]
    core = data["value"]["BasicSafetyMessage"]["coreData"]
    assert core["accelSet"] == {"long": "2001", "lat": "2001", "vert": "-127", "yaw": "-125"}
    assert core["accuracy"] == {"semiMajor": "255", "semiMinor": "255", "orientation": "65535"}
    assert [core[key] for key in ("elev", "speed", "heading", "angle")] == ["-4096", "8191", "28800", "127"]
    assert core["size"] == {"width": "0", "length": "0"}


def test_known_senders_are_written_and_kept_apart_from_the_receiver(tmp_path):
    messages = make_messages({"sender": "17"}, {"own": True}, {})
    write_bsmp1(tmp_path / "log", messages)
    frame = read_bsmp1(RawFile(tmp_path / "log", "log")).frame
    assert frame["sender"].to_list() == ["17", "1", None]
    assert frame["own"].to_list() == [False, True, False]
    with pytest.raises(ValueError, match="number of the receiver"):
        write_bsmp1(tmp_path / "log", messages.with_columns(sender=pl.lit("1")))
