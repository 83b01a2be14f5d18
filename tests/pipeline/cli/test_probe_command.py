"""`tracklake probe`: it tells what a file is, and none of its values."""

import json
import re

import pytest
from highd_files import write_recording as write_highd
from levelx_files import drive, meta_row, vehicle_row, write_recording
from raw_texts import as_text, ngsim_row, write

NO_HEADER = "no known format, and no header with known names"
VEHICLES = [vehicle_row(0, 60), vehicle_row(1, 60, "truck")]
ROWS = drive(0, (123.456, -98.7654), (0, 20.125), 90.0, frames=60) + drive(
    1, (127.125, 44.3751), (0, 21.375), 90.0, frames=60
)


def list_values(path):
    """Values of a file that could identify it: numbers of three digits or more."""
    return {
        value for value in re.findall(r"-?\d+\.?\d*", path.read_text()) if len(value.strip("-.").replace(".", "")) > 3
    }


def probe(command, path, code=0):
    done = command.here("probe", path, "--json")
    assert done.code == code, done.err
    shown = command.here("probe", path)
    for file in [path] if path.is_file() else path.rglob("*.csv"):
        found = [
            value for value in list_values(file) if re.search(rf"(?<![\d.]){re.escape(value)}(?![\d.])", shown.out)
        ]
        assert not found, (file, found)
    return json.loads(done.out)["files"], shown.out


def columns_of(file):
    return {column["name"]: column for column in file["columns"]}


def test_a_sound_file_is_described_without_a_value(command, tmp_path):
    tracks = write_recording(tmp_path / "raw", VEHICLES, ROWS, meta=meta_row(xUtmOrigin=353_427.123))[2]
    ((file,), shown) = probe(command, tracks)
    assert (file["dataset"], file["dialect"], file["rows"], file["rejected"]) == ("exid", "exid-tracks", 120, {})
    columns = columns_of(file)
    assert columns["xCenter"] == {"name": "xCenter", "state": "read", "unit": "m", "filled": 1.0, "fits": None}
    assert columns["length"]["fits"] is columns["width"]["fits"] is True
    assert columns["odrLaneId"]["state"] == "not read"
    assert file["motion"] is True
    assert "positions and speeds: agree" in shown


def test_wrong_units_missing_and_unknown_columns_and_lost_rows_are_seen(command, tmp_path):
    paths = write_recording(tmp_path, VEHICLES, [*ROWS, "1,2,3"])
    text = paths[2].read_text().replace(",4.0,", ",13.12,").replace("laneWidth", "laneBreadth")
    paths[2].write_text(text)
    ((file,), shown) = probe(command, paths[2], code=3)
    columns = columns_of(file)
    assert columns["length"]["fits"] is False
    assert columns["laneWidth"]["state"] == "missing"
    assert columns["laneBreadth"]["state"] == "not read"
    assert file["rejected"] == {"3 fields instead of 39": 1}
    assert "IMPLAUSIBLE" in shown
    rows = [row.replace(",20.125,", ",72.45,").replace(",21.375,", ",76.95,") for row in ROWS]  # km/h
    ((file,), shown) = probe(command, write_recording(tmp_path / "speeds", VEHICLES, rows)[2], code=3)
    assert file["motion"] is False
    assert "DO NOT AGREE" in shown


def test_a_folder_is_described_file_by_file(command, tmp_path):
    write_recording(tmp_path / "raw", VEHICLES, ROWS)
    write_highd(tmp_path / "raw", number="02")
    write(tmp_path / "raw" / "notes.txt", b"hello")
    files, _ = probe(command, tmp_path / "raw")
    assert [(file["dataset"], file["dialect"]) for file in files] == [
        ("exid, ind or round", "levelx-recordingMeta"),
        ("exid", "exid-tracks"),
        ("exid, ind or round", "levelx-tracksMeta"),
        ("highd", "highd-recordingMeta"),
        ("highd", "highd-tracks"),
        ("highd", "highd-tracksMeta"),
    ]


def test_ngsim_without_header_and_logs_of_messages(command, tmp_path):
    rows = [ngsim_row(1, frame) for frame in range(1, 40)]
    ((file,), _) = probe(command, write(tmp_path / "trajectories.txt", as_text(rows)))
    assert (file["dataset"], file["rows"]) == ("ngsim", 39)
    assert columns_of(file)["Local_Y"]["unit"] == "ft"
    assert columns_of(file)["v_length"]["fits"] is True
    lines = (
        f"11,2,12,{305_000_000_000_000 + 100_000 * tick},3,{tick},{100 * tick},42.2{tick:03d},-83.7{tick:03d},250.5,"
        f"13.{tick:03d},90.5,0.25,0,0,0,1,3276.7,1\n"
        for tick in range(20)
    )
    log = write(tmp_path / "log.csv", "".join(lines).encode())
    ((file,), _) = probe(command, log)
    assert (file["dataset"], file["dialect"], file["rows"]) == ("v2v", "bsmp1", 20)
    assert columns_of(file)["speed_mps"]["unit"] == "m/s"


def test_a_list_of_documents(command, tmp_path):
    steps = range(50)
    sound = {
        "timestamp": [1_669_118_400 + step / 25 for step in steps],
        "x_position": [316_800 + step for step in steps],
    }
    sound |= {"y_position": [18.0] * 50, "length": 15.0, "width": [6.0, 6.5], "direction": 1, "coarse_vehicle_class": 0}
    documents = [sound] * 12 + [sound | {"x_position": []}, sound | {"direction": "at 77.77 N"}]
    path = write(tmp_path / "i24.json", json.dumps(documents).encode())
    ((file,), shown) = probe(command, path, code=3)
    assert (file["dataset"], file["rows"], sum(file["rejected"].values())) == ("i24", 14, 2)
    assert "77.77" not in shown
    assert columns_of(file)["length"] == {"name": "length", "state": "read", "unit": "ft", "filled": 1.0, "fits": True}


@pytest.mark.parametrize(
    ("content", "problem", "names"),
    [
        (b"", "empty", []),
        (b"Speed (m/s),track-id,colour\n77.77,8,red\n", "no known format", ["Speed (m/s)", "track-id", "colour"]),
        (b"77.77,red,88.88\n", f"{NO_HEADER}; 3 fields in its first line", []),
        (b"id,lane,77.77\n", f"{NO_HEADER}; 3 fields in its first line", []),
        (b"veh_12,at 77.77 N,northbound,lane\n", f"{NO_HEADER}; 4 fields in its first line", []),
        (b'{"lane":"77.77 N","id":"AB,123"},id,lane\n', f"{NO_HEADER}; 5 fields in its first line", []),
        (b'["x","y",id,lane,"at 77.77"]\n', f"{NO_HEADER}; 5 fields in its first line", []),
        (b"wagen;77.77;AB-123\n", f"{NO_HEADER}; 1 fields in its first line", []),
    ],
)
def test_what_is_not_known_is_described_without_a_value(command, tmp_path, content, problem, names):
    path = write(tmp_path / "other.csv", content)
    ((file,), shown) = probe(command, path, code=1)
    assert (file["dataset"], file["problem"]) == ("", problem)
    assert [column["name"] for column in file["columns"]] == names
    assert "77.77" not in shown


def test_a_missing_file_is_an_error(command, tmp_path):
    done = command.here("probe", tmp_path / "none.csv")
    assert done.code == 1
    assert "no such file or folder" in done.err
