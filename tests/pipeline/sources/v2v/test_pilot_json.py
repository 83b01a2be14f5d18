import json

import polars as pl
import pytest
from message_logs import REAL, needs_real_messages, write_log
from test_uper import FRAME

from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.pilot_json import decode_texts, read_pilot_json, recognise_pilot_json

# After usdot-jpo-ode/jpo-ode, data/bsmLogDuringEvent.json, its first message (Apache-2.0), shortened.
DECODED = {
    "metadata": {
        "bsmSource": "RV",
        "recordType": "bsmLogDuringEvent",
        "logFileName": "bsmLogDuringEvent.gz",
        "odeReceivedAt": "2019-04-09T18:07:12.352Z",
        "recordGeneratedAt": "2018-05-01T16:04:23.694Z",
        "receivedMessageDetails": {"rxSource": "NA"},
    },
    "payload": {
        "data": {
            "coreData": {
                "msgCnt": 95,
                "id": "31325431",
                "secMark": 23794,
                "position": {"latitude": 40.5657318, "longitude": -105.0318485, "elevation": 1472.8},
                "accelSet": {"accelLat": 0.5, "accelLong": -0.52, "accelVert": 0.1, "accelYaw": 1.25},
                "accuracy": {"semiMajor": 12.70, "semiMinor": 12.40},
                "transmission": "NEUTRAL",
                "speed": 0.10,
                "heading": 250.9125,
                "brakes": {"traction": "unavailable"},
                "size": {"width": 190, "length": 570},
            },
            "partII": [{"id": "VehicleSafetyExtensions", "value": {}}],
        }
    },
}
RAW = {
    "metadata": {"bsmSource": "RV", "recordGeneratedAt": "2018-05-01T16:04:23.694Z"},
    "payload": {
        "data": {
            "value": {
                "BasicSafetyMessage": {
                    "coreData": {
                        "msgCnt": "95",
                        "id": "31325431",
                        "secMark": "23794",
                        "lat": "405657318",
                        "long": "-1050318485",
                        "elev": "14728",
                        "accuracy": {"semiMajor": "254", "semiMinor": "248", "orientation": "65535"},
                        "transmission": "neutral",
                        "speed": "5",
                        "heading": "20073",
                        "angle": "127",
                        "accelSet": {"long": "-52", "lat": "50", "vert": "5", "yaw": "125"},
                        "size": {"width": "190", "length": "570"},
                    }
                }
            }
        }
    },
}
UNAVAILABLE = {
    "elev": -4096,
    "speed": 8191,
    "heading": 28800,
    "angle": 127,
    "secMark": 65535,
    "accelSet": {"long": 2001, "lat": 2001, "vert": -127, "yaw": 0},
    "accuracy": {"semiMajor": 255, "semiMinor": 255, "orientation": 65535},
    "size": {"width": 0, "length": 0},
    "transmission": {"unavailable": {}},
}


def write(record: object, **changes: object) -> str:
    """Write a record as a line, with changes to its metadata or its core data."""
    copy = json.loads(json.dumps(record))
    data = copy["payload"]["data"]
    core = data["coreData"] if "coreData" in data else data["value"]["BasicSafetyMessage"]["coreData"]
    for name, value in changes.items():
        (core if name in core else copy["metadata"])[name] = value
    return json.dumps(copy)


def test_both_dialects_of_the_same_message_give_the_same_values(tmp_path):
    raw = read_pilot_json(write_log(tmp_path, write(DECODED), write(RAW), write(json.loads(write(RAW)))))
    assert raw.rejects.is_empty()
    row = raw.frame.row(0, named=True)
    expected = {
        "lat_deg": 40.5657318,
        "lon_deg": -105.0318485,
        "elevation_m": 1472.8,
        "speed_mps": 0.1,
        "heading_deg": 250.9125,
        "accel_mps2": -0.52,
        "lateral_accel_mps2": 0.5,
        "vertical_accel_mps2": 0.980665,  # 0.1 g
        "yaw_rate_degps": 1.25,
        "semi_major_m": 12.7,
        "semi_minor_m": 12.4,
        "length_m": 5.7,
        "width_m": 1.9,
    }
    for index in range(3):
        row = raw.frame.row(index, named=True)
        assert {name: row[name] for name in expected} == pytest.approx(expected)
        assert (row["message_count"], row["temporary_id"], row["second_mark_ms"]) == (95, "31325431", 23794)
        assert (row["steering_angle_deg"], row["orientation_deg"]) == (None, None)
        assert row["transmission"] == "neutral"
        assert (row["received_us"], row["utc_us"]) == (1_525_190_663_694_000, None)


@pytest.mark.parametrize("as_text", [True, False])
def test_codes_for_unavailable_become_null(tmp_path, as_text):
    codes = json.loads(json.dumps(UNAVAILABLE), parse_int=str if as_text else int)
    frame = read_pilot_json(write_log(tmp_path, write(RAW, **codes))).frame
    unknown = [name for name in frame.columns[frame.columns.index("elevation_m") :] if name != "yaw_rate_degps"]
    assert frame.select(unknown).row(0) == (None,) * len(unknown)
    assert frame["second_mark_ms"].item() is None
    assert frame["yaw_rate_degps"].item() == 0  # the yaw rate has no such code


def test_decoded_values_may_be_text_or_missing(tmp_path):
    texts = {"speed": "0.10", "heading": "unavailable", "accelSet": None, "size": {"width": None}, "transmission": None}
    row = read_pilot_json(write_log(tmp_path, write(DECODED, **texts))).frame.row(0, named=True)
    assert row["speed_mps"] == pytest.approx(0.1)
    assert [row[name] for name in ("heading_deg", "accel_mps2", "width_m", "length_m", "transmission")] == [None] * 5


@pytest.mark.parametrize(
    ("metadata", "own", "receiver"),
    [
        ({"bsmSource": "EV"}, True, None),
        ({"bsmSource": "RV"}, False, None),
        ({"bsmSource": None, "recordType": "bsmTx"}, True, None),
        # What a roadside unit forwards says bsmTx, too, and comes from many vehicles.
        (
            {"recordType": "bsmTx", "receivedMessageDetails": {"rxSource": "RSU"}, "originIp": "172.18.0.1"},
            False,
            "172.18.0.1",
        ),
    ],
)
def test_own_messages_and_receivers(tmp_path, metadata, own, receiver):
    row = read_pilot_json(write_log(tmp_path, write(DECODED, **metadata))).frame.row(0, named=True)
    assert (row["own"], row["receiver"]) == (own, receiver)


def test_records_without_core_data_are_decoded_from_their_hex(tmp_path):
    in_payload = {"metadata": {"bsmSource": "EV"}, "payload": {"data": {"bytes": FRAME}}}
    in_metadata = {"metadata": {"asn1": FRAME, "odeReceivedAt": "2018-05-01T16:04:23.694Z"}, "payload": {}}
    broken = {"metadata": {"asn1": FRAME[:-2]}, "payload": {}}
    raw = read_pilot_json(write_log(tmp_path, *map(json.dumps, (in_payload, in_metadata, broken))))
    assert raw.frame["lat_deg"].to_list() == pytest.approx([39.1874242] * 2)
    assert raw.frame["own"].to_list() == [True, False]
    assert raw.frame["received_us"].to_list() == [None, 1_525_190_663_694_000]
    assert raw.rejects.rows() == [(3, "the length of the message does not fit its octets", json.dumps(broken))]


def test_every_line_is_accounted_for(tmp_path):
    position = {"latitude": 40.5, "longitude": "x", "elevation": 0}
    lines = {
        write(DECODED): None,
        "": "blank line",
        write(DECODED)[:-1]: "no JSON object",
        "\x01": "no JSON object",
        "[1, 2]": "no basic safety message",
        "5": "no basic safety message",
        '{"payload": {"data": "text"}}': "no basic safety message",
        '{"metadata": {}, "payload": {"dataType": "OdeTimPayload"}}': "no basic safety message",
        write(RAW, lat="900000001"): "no position",
        write(RAW, lat="0", long="0"): "position (0, 0)",
        write(RAW, lat="40.5657318"): "lat or long is no whole number",
        write(DECODED, position=position): "not a number: position.longitude",
        write(DECODED, position=[1, 2]): "no position",
        write(DECODED, speed="fast"): "not a number: speed",
        write(DECODED, speed="NaN") + " ": None,
        write(DECODED, msgCnt=128): "message count outside 0 to 127",
        write(DECODED, size={"width": 190, "length": 10_001}): "length_m outside 0 to 100",
        write(DECODED, recordGeneratedAt="1999-01-01T00:00:00Z"): "time before 2004 or after 2100",
        "[" * 50_000 + "]" * 10_000: "no JSON object",
        '{"a":' * 10_000 + "1" + "}" * 10_000: "no basic safety message",
        '{"a":"' + "x" * 65_536 + '"}': "longer than 65536 characters",
        write(RAW): None,
    }
    raw = read_pilot_json(write_log(tmp_path, *lines))
    assert raw.rows_read == len(lines)
    expected = {number: reason for number, reason in enumerate(lines.values(), start=1) if reason is not None}
    assert dict(raw.rejects.select("line", "reason").iter_rows()) == expected
    assert raw.frame["line"].to_list() == [n for n in range(1, len(lines) + 1) if n not in expected]
    assert raw.rejects["text"].to_list()[:2] == ["", write(DECODED)[:-1]]
    assert raw.rejects["text"].str.len_chars().max() < 65_537


def test_bytes_that_are_no_text_are_rejects(tmp_path):
    path = tmp_path / "log"
    path.write_bytes(write(DECODED).encode() + b"\n\xff\xfe\x80\n" + write(DECODED).encode())
    raw = read_pilot_json(RawFile(path, path.name))
    assert raw.frame["line"].to_list() == [1, 3]
    assert raw.rejects["reason"].to_list() == ["not UTF-8"]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_one_object_may_be_spread_over_lines(tmp_path, end):
    path = tmp_path / "message.json"
    path.write_bytes((json.dumps(DECODED, indent="\t") + "\n").replace("\n", end).encode())
    raw = read_pilot_json(RawFile(path, path.name))
    assert (raw.rows_read, raw.frame["line"].to_list()) == (1, [1])
    assert raw.frame["temporary_id"].item() == "31325431"


def test_the_mark_of_generated_messages_is_read(tmp_path):
    assert not read_pilot_json(write_log(tmp_path, write(DECODED))).synthetic
    assert read_pilot_json(write_log(tmp_path, write(DECODED), write(DECODED, logFileName="synthetic"))).synthetic


def test_single_texts_are_decoded():
    texts = pl.DataFrame(
        {"line": [1, 2, 3, 4], "text": [write(DECODED), f"1525190663.694,{FRAME}", "x", write(RAW, lat=0.5)]}
    )
    kept, rejects = decode_texts(texts)
    assert kept["temporary_id"].to_list() == ["31325431", "9D59FB77"]
    assert rejects.rows() == [
        (3, "neither hex digits nor a time and hex digits", "x"),
        (4, "lat or long is no whole number", write(RAW, lat=0.5)),
    ]


def test_only_logs_of_messages_are_recognised():
    assert recognise_pilot_json(write(RAW).encode())
    assert recognise_pilot_json(json.dumps(DECODED, indent=2).encode())
    assert recognise_pilot_json(b"\xef\xbb\xbf" + json.dumps({"payload": {"data": {"bytes": FRAME}}}).encode())
    assert not recognise_pilot_json(b'{"payload": 1}')
    assert not recognise_pilot_json(b"[1]")
    assert not recognise_pilot_json(b"")


@needs_real_messages
def test_real_decoded_messages():
    raw = read_pilot_json(RawFile(REAL / "ode_bsm_log.json", "ode_bsm_log.json"))
    assert (raw.rows_read, raw.frame.height) == (222, 222)
    assert raw.frame["own"].sum() == 129
    records = [json.loads(line) for line in (REAL / "ode_bsm_log.json").read_text().splitlines()]
    cores = [record["payload"]["data"]["coreData"] for record in records]
    assert raw.frame["lat_deg"].to_list() == [core["position"]["latitude"] for core in cores]
    assert raw.frame["accel_mps2"].to_list() == pytest.approx([core["accelSet"]["accelLong"] for core in cores])
    assert raw.frame["own"].to_list() == [record["metadata"]["bsmSource"] == "EV" for record in records]
    assert not raw.synthetic


@needs_real_messages
@pytest.mark.parametrize("name", ["cvdp_hex_decoded.json", "ode_hex_decoded.json"])
def test_real_core_data_agree_with_the_hex_beside_them(tmp_path, name):
    path = REAL / name
    raw = read_pilot_json(RawFile(path, name))
    text = path.read_text()
    records = [json.loads(text)] if raw.frame.height == 1 else [json.loads(line) for line in text.splitlines()]
    lines = [json.dumps({"metadata": record["metadata"], "payload": {}}) for record in records]
    from_hex = read_pilot_json(write_log(tmp_path, *lines))
    assert raw.frame.height == from_hex.frame.height == len(records)
    for name in raw.frame.columns:
        both = (raw.frame[name].to_list(), from_hex.frame[name].to_list())
        assert both[0] == (pytest.approx(both[1], rel=1e-6, abs=1e-6) if raw.frame[name].dtype.is_float() else both[1])
