import json

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from message_logs import REAL, needs_real_messages, write_log

from tracklake.pipeline.sources.v2v.uper import decode_hex, read_hex, recognise_hex

# usdot-jpo-ode/jpo-cvdp, data/CO-Motorways_test.json, its first message (Apache-2.0); what it decodes to stands there.
FRAME = (
    "0014505767567EDDDFA3E68037E116658105B0DA9414000070F402B0FD630FA1007F82800000000000A5C01F81844EE7040DBF2014904853"
    "D058FBF201E984D16505BCBEE02AC0563130563BDB04001AA1ED00"
)
PUBLISHED = {
    "message_count": 93,
    "temporary_id": "9D59FB77",
    "second_mark_ms": 32399,
    "lat_deg": 39.1874242,
    "lon_deg": -104.8498164,
    "elevation_m": 2091.7,
    "semi_major_m": 2.0,
    "semi_minor_m": 2.0,
    "orientation_deg": 0.0,
    "speed_mps": 9.76,
    "heading_deg": 8.6,
    "steering_angle_deg": 127 * 1.5,  # the code for unavailable
    "accel_mps2": -4.16,
    "lateral_accel_mps2": 20.01,  # likewise
    "vertical_accel_mps2": -127 * 0.02 * 9.80665,  # likewise
    "yaw_rate_degps": -1.25,
    "width_m": 0.0,
    "length_m": 0.0,
    "transmission": None,
    "reason": None,
}
LAYOUT = (7, 32, 16, 31, 32, 16, 8, 8, 16, 3, 13, 15, 8, 12, 12, 8, 16, 15, 10, 12)
"""Widths of the core data in bits: counter, id, second mark, ... yaw rate, brakes, width, length."""


def decode_slowly(digits: str) -> list[int]:
    """Cut the bits after `0014`, a length of one octet and three bits into fields."""
    bits = "".join(f"{int(digit, 16):04b}" for digit in digits)[24 + 3 :]
    fields, at = [], 0
    for width in LAYOUT:
        fields.append(int(bits[at : at + width], 2))
        at += width
    return fields


def test_a_published_message_is_decoded():
    row = decode_hex(pl.Series([FRAME])).row(0, named=True)
    assert set(row) == set(PUBLISHED)
    for name, value in PUBLISHED.items():
        assert row[name] == (pytest.approx(value, abs=1e-9) if isinstance(value, float) else value), name


@given(st.lists(st.binary(min_size=37, max_size=37), min_size=1, max_size=5))
@settings(max_examples=30, deadline=None)
def test_fields_are_cut_at_the_right_bits(messages):
    texts = [f"001425{message.hex()}" for message in messages]
    decoded = decode_hex(pl.Series(texts))
    for row, text in zip(decoded.to_dicts(), texts, strict=True):
        fields = decode_slowly(text)
        assert row["message_count"] == fields[0]
        assert row["temporary_id"] == f"{fields[1]:08X}"
        assert row["second_mark_ms"] == fields[2]
        assert row["lat_deg"] == pytest.approx((fields[3] - 900_000_000) / 1e7)
        assert row["lon_deg"] == pytest.approx((fields[4] - 1_799_999_999) / 1e7)
        assert row["transmission"] == dict(enumerate(("neutral", "park", "forwardGears", "reverseGears"))).get(
            fields[9]
        )
        assert row["speed_mps"] == pytest.approx(fields[10] * 0.02)
        assert row["heading_deg"] == pytest.approx(fields[11] * 0.0125)
        assert row["steering_angle_deg"] == pytest.approx((fields[12] - 126) * 1.5)
        assert row["yaw_rate_degps"] == pytest.approx((fields[16] - 32767) * 0.01)
        assert (row["width_m"], row["length_m"]) == pytest.approx((fields[18] / 100, fields[19] / 100))


@pytest.mark.parametrize(
    ("digits", "reason"),
    [
        (FRAME.lower(), None),
        ("0x" + FRAME, None),
        (FRAME + "00", None),  # octets after the message
        ("0380010000" + FRAME, None),  # a header before it
        ("00140000140000" + FRAME, None),  # a header with something like a message in it
        ("0" + FRAME, "an odd number of hex digits"),
        ("00" + "0" + FRAME + "0", "no basic safety message (0014)"),  # not at a whole octet
        ("G" + FRAME[1:], "no hex digits"),
        ("", "no basic safety message (0014)"),
        (None, "no hex digits"),
        (FRAME[:-2], "the length of the message does not fit its octets"),
        ("001424" + FRAME[6:78], "the length of the message does not fit its octets"),  # too short for the core data
        ("0014", "the length of the message does not fit its octets"),
        ("0014FF" + "00" * 300, "the length of the message does not fit its octets"),
        ("001305" + "0014250000", "message 19 of J2735, not a basic safety message (20)"),
        ("001203112233", "message 18 of J2735, not a basic safety message (20)"),
        ("00" * 60, "no basic safety message (0014)"),
    ],
)
def test_what_is_no_message_is_refused_with_a_reason(digits, reason):
    # Neighbors on both sides: one message's octets must not serve another.
    decoded = decode_hex(pl.Series([FRAME, digits, FRAME], dtype=pl.String))
    assert decoded["reason"].to_list() == [None, reason, None]
    assert decoded["message_count"].to_list() == [93, 93 if reason is None else None, 93]


def test_lengths_above_127_take_two_octets():
    long = f"00148{len(FRAME) // 2 + 60:03X}" + FRAME[6:] + "00" * 63
    assert decode_hex(pl.Series([long]))["temporary_id"].to_list() == ["9D59FB77"]


def test_lines_of_a_plain_log_carry_times_in_several_forms(tmp_path):
    times = ["1525190663.694", "1525190663694", "1525190663694000", "2018-05-01T16:04:23.694Z"]
    raw = read_hex(
        write_log(tmp_path, "time,hex", *(f"{time},{FRAME}" for time in times), FRAME, f"{times[1]} {FRAME}")
    )
    assert raw.rows_read == raw.frame.height == 6
    assert raw.frame["line"].to_list() == [2, 3, 4, 5, 6, 7]
    assert raw.frame["received_us"].to_list() == [1_525_190_663_694_000] * 4 + [None, 1_525_190_663_694_000]
    row = raw.frame.row(0, named=True)
    # Codes for unavailable are null now.
    assert (row["steering_angle_deg"], row["lateral_accel_mps2"], row["length_m"]) == (None, None, None)
    assert not raw.frame["own"].any()


def test_every_line_of_a_plain_log_is_accounted_for(tmp_path):
    lines = [FRAME, "", f"yesterday,{FRAME}", "hello", FRAME[:-2], "A" * 70_000]
    raw = read_hex(write_log(tmp_path, *lines))
    assert raw.frame["line"].to_list() == [1]
    assert raw.rejects.select("line", "reason").rows() == [
        (2, "blank line"),
        (3, "no time before the digits"),
        (4, "neither hex digits nor a time and hex digits"),
        (5, "the length of the message does not fit its octets"),
        (6, "longer than 65536 characters"),
    ]
    assert raw.rejects["text"][3] == FRAME[:-2]
    assert raw.rows_read == 6


def test_only_plain_logs_are_recognised():
    assert recognise_hex(FRAME.encode())
    assert recognise_hex(f"time,hex\n1525190663.694,{FRAME}\n".encode())
    other = "0013050000112233"  # a message 19 of J2735
    assert recognise_hex(f"{other}\n{other}\n{FRAME}\n".encode())
    assert not recognise_hex(f"{other}\n".encode())
    assert not recognise_hex(f"hello, world!\n{FRAME}\n".encode())
    assert not recognise_hex(b"")
    assert not recognise_hex(b"time,hex\n")
    assert not recognise_hex(b"1,2,3\n")
    assert not recognise_hex(b"0015" + FRAME[4:].encode())


def test_a_line_of_blanks_is_judged_at_once():
    assert not recognise_hex(b"a" + b" " * 65_000 + b"!")  # by backtracking, these took minutes
    assert not recognise_hex(b" " * 65_000 + b"!")
    assert not recognise_hex(b"A" * 65_000 + b"!")


@needs_real_messages
def test_real_hex_agrees_with_its_published_decoding():
    records = [json.loads(line) for line in (REAL / "cvdp_hex_decoded.json").read_text().splitlines()]
    decoded = decode_hex(pl.Series([record["metadata"]["asn1"] for record in records]))
    assert len(records) == 6
    for record, row in zip(records, decoded.to_dicts(), strict=True):
        core = record["payload"]["data"]["value"]["BasicSafetyMessage"]["coreData"]
        assert row["temporary_id"] == core["id"]
        found = [round(row[name] * per_unit) for name, per_unit in (("lat_deg", 1e7), ("lon_deg", 1e7))]
        assert found == [core["lat"], core["long"]]
        assert round(row["speed_mps"] * 50) == core["speed"]
        assert round(row["yaw_rate_degps"] * 100) == core["accelSet"]["yaw"]
        assert [round(row[name] * 100) for name in ("width_m", "length_m")] == [*core["size"].values()]
    # The only message with a size: 348 x 607 cm.
    assert (decoded["width_m"][5], decoded["length_m"][5]) == (3.48, 6.07)
