"""`--columns` reads a table of the user's own by names, units, rate and site."""

import io
import re
from pathlib import Path

import polars as pl
import pytest
from polars.testing import assert_frame_equal
from raw_texts import TEXT_NAMES, as_csv, check_accounts, ngsim, tracks_of, write
from traffic_rows import make_traffic

from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.column_mapping import ColumnMapping, load_mapping
from tracklake.pipeline.sources.source import Part

DOCS = Path(__file__).parents[3] / "docs" / "data.md"
RATE_HZ = 25


@pytest.fixture
def mapping(tmp_path):
    """The example of docs/data.md."""
    (example,) = re.findall(r"```toml\n# mapping\.toml\n(.*?)```", DOCS.read_text(), flags=re.DOTALL)
    path = tmp_path / "mapping.toml"
    path.write_text(example)
    return load_mapping(path)


def drive(vehicles=3, frames=50):
    """Two lanes of 3.5 m, 25 m/s = 90 km/h, 1 m a frame at 25 Hz."""
    rows = [
        (vehicle, frame, 3.5 * (vehicle % 2) + 1.75, 40.0 * vehicle + frame, 90.0, 1 + vehicle % 2)
        for vehicle in range(1, vehicles + 1)
        for frame in range(frames)
    ]
    return pl.DataFrame(rows, schema=["id", "frame", "lateral", "along", "speed", "lane"], orient="row")


def read(folder, mapping, data, name="drive.csv", **named):
    """{recording: Canonical} of a file that discovery finds with a mapping."""
    path = write(folder / "raw" / name, data)
    found = discover(path, digest=lambda file: file.name, mapping=mapping, **named)
    ((source, unit),) = found.units
    (file,) = unit.files
    target = folder / "spilled"
    spilled = source.spill(file, target)
    return {
        recording: source.to_canonical(
            [Part(file, pl.scan_ipc(target / recording / "*.arrow"), spilled.rejects)], recording
        )
        for recording in spilled.recordings
    }


def as_parquet(frame):
    buffer = io.BytesIO()
    frame.write_parquet(buffer)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "write_as"),
    [
        ("drive.csv", lambda frame: frame.write_csv().encode()),
        ("drive.tsv", lambda frame: frame.select(reversed(frame.columns)).write_csv(separator="\t").encode()),
        ("drive.parquet", as_parquet),
    ],
)
def test_the_documented_example(tmp_path, mapping, name, write_as):
    ((recording, canonical),) = read(tmp_path, mapping, write_as(drive()), name).items()
    assert recording == "my-road-drive"
    (subset,) = canonical.subsets
    facts = subset.facts.row(0, named=True)
    expected = {
        "dataset": "custom",
        "site": "my-road",
        "lanes": 2,
        "frame_rate_hz": 25,
        "seconds": 2.0,
        "freeway": True,
    }
    assert {name: facts[name] for name in expected} == expected
    second = subset.tracks.filter(vehicle_id=2)
    # 40 m per vehicle and 1 m a frame; 90 km/h are 25 m/s; lane 1 has its middle at 1.75 m
    assert second["x_m"].to_list() == pytest.approx([80.0 + frame for frame in range(50)], abs=1e-6)
    assert second["time_s"].to_list() == pytest.approx([frame / RATE_HZ for frame in range(50)])
    assert second["speed_mps"].to_list() == pytest.approx([25.0] * 50, abs=1e-4)
    assert second["speed_cd_mps"][1] == pytest.approx(25.0, abs=1e-3)
    assert (second["y_m"][0], second["lane"][0]) == (pytest.approx(1.75, abs=1e-6), 1)
    check_accounts(canonical, entries_from=[name])


def test_columns_by_number_and_a_name_for_the_recording(tmp_path):
    numbered = ColumnMapping(
        columns={"Vehicle_ID": 1, "Frame_ID": 2, "Local_X": 3, "Local_Y": 4, "v_Vel": 5},
        units={"Local_X": "m", "Local_Y": "m", "v_Vel": "km/h"},
        rate_hz=RATE_HZ,
    )
    data = drive().write_csv(include_header=False).encode()
    assert list(read(tmp_path, numbered, data, recording="monday")) == ["monday"]


def test_a_mapped_file_of_ngsim_is_ngsims(tmp_path):
    rows = make_traffic()
    renamed = ColumnMapping(columns={name: f"c{number}" for number, name in enumerate(TEXT_NAMES)
                                     if name not in ("Global_X", "Global_Y")}, dataset="ngsim")  # fmt: skip
    data = as_csv(rows, TEXT_NAMES, header=[f"c{number}" for number in range(len(TEXT_NAMES))])
    ((recording, canonical),) = read(tmp_path, renamed, data).items()
    assert recording == "us-101-0750"
    assert_frame_equal(tracks_of(canonical), tracks_of(ngsim(tmp_path / "plain", as_csv(rows, TEXT_NAMES))))


def test_units_that_the_rows_deny_are_refused(tmp_path, mapping):
    wrong = mapping.model_copy(update={"units": {**mapping.units, "v_Vel": "m/s"}})
    with pytest.raises(SourceError, match=r"positions advance by 0\.278 times v_Vel.*Correct the mapping"):
        read(tmp_path, wrong, drive().write_csv().encode())


def test_files_without_the_mapped_columns_are_read_as_without_a_mapping(tmp_path, mapping):
    write(tmp_path / "raw" / "ngsim.csv", as_csv(make_traffic(), TEXT_NAMES))
    write(tmp_path / "raw" / "drive.csv", drive().write_csv().encode())
    write(tmp_path / "raw" / "other.csv", b"a,b\n1,2\n")
    found = discover(tmp_path / "raw", digest=lambda file: file.name, mapping=mapping)
    assert sorted((source.name, unit.files[0].name) for source, unit in found.units) == [
        ("custom", "drive.csv"), ("ngsim", "ngsim.csv")]  # fmt: skip
    assert "Nor has it the columns of the mapping: id, frame" in found.refusals[0]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x =", "Invalid value"),
        ("", "columns: Field required"),
        ("[columns]\nVehicle_ID = 1\n", "Frame_ID, Local_X, Local_Y, v_Vel missing"),
        ('[columns]\nFoo = "a"\n', "expected names among Vehicle_ID.*got Foo"),
        ('[columns]\nVehicle_ID="a"\nFrame_ID="a"\nLocal_X="b"\nLocal_Y="c"\nv_Vel="d"\n', "columns once"),
        ('[columns]\nVehicle_ID="?"\nFrame_ID="a"\nLocal_X="b"\nLocal_Y="c"\nv_Vel="d"\n', "Vehicle_ID missing"),
        ('[columns]\nVehicle_ID=1\nFrame_ID=2\nLocal_X=3\nLocal_Y=4\nv_Vel=5\n[units]\nv_Vel="yd"\n', "got 'yd'"),
        ('dataset="highd"\n[columns]\nVehicle_ID=1\nFrame_ID=2\nLocal_X=3\nLocal_Y=4\nv_Vel=5\n', "no mapping"),
    ],
)
def test_a_mapping_that_cannot_be_is_refused(tmp_path, text, reason):
    path = tmp_path / "mapping.toml"
    path.write_text(text)
    with pytest.raises(SourceError, match=f"no column mapping .*{reason}.*docs/data.md"):
        load_mapping(path)
    with pytest.raises(SourceError, match="No such file"):
        load_mapping(tmp_path / "absent.toml")


@pytest.mark.usefixtures("plain_flows")
def test_the_command(command, tmp_path):
    write(tmp_path / "raw" / "drive.csv", drive().write_csv().encode())
    (example,) = re.findall(r"```toml\n# mapping\.toml\n(.*?)```", DOCS.read_text(), flags=re.DOTALL)
    write(tmp_path / "mapping.toml", example.encode())
    arguments = ("ingest", tmp_path / "raw", "--lake", tmp_path / "lake", "--columns", tmp_path / "mapping.toml")
    assert command.here(*arguments).code == 0
    assert "nothing to do" in command.here(*arguments).out
    query = "SELECT dataset, subset, entries FROM subsets"
    assert "custom,my-road-drive,150" in command.here("sql", query, "--lake", tmp_path / "lake", "--format", "csv").out
    assert command.here(*arguments, "--recording", "monday").code == 0
    listed = command.here(
        "sql", "SELECT subset FROM subsets ORDER BY 1", "--lake", tmp_path / "lake", "--format", "csv"
    )
    assert listed.out.split()[1:] == ["my-road-drive", "my-road-monday"]
