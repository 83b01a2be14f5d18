import json

import polars as pl
import pytest
from conftest import Command, Lake


@pytest.fixture(scope="module")
def ego(lake: Lake) -> str:
    """A vehicle of the generated sample that was recorded for at least 5 s."""
    vehicles = pl.scan_parquet(lake.root / "vehicles").filter(pl.col("subset") == "02-lower").collect()
    return f"02-lower:{vehicles.filter(pl.col('entries') > 150)['vehicle_id'].min()}"


@pytest.mark.usefixtures("plain_flows")
@pytest.mark.parametrize("formats", ["wyoming", "tampa", "hex", "bsmp1"])
def test_a_drive_is_instrumented_and_read_again(command: Command, lake: Lake, ego: str, tmp_path, formats):
    options = ("--lake", lake.root, "--out", tmp_path / "drives", "--gnss", "dgps")
    options += tuple(word for each in formats.split() for word in ("--format", each))
    done = command.here("instrument", "--ego", ego, *options, "--penetration", "1", "--json")
    assert done.code == 0, done.err
    (drive,) = json.loads(done.out)["drives"]
    assert drive["heard"] > 3
    done = command.here("ingest", tmp_path / "drives", "--lake", tmp_path / "lake")
    assert done.code == 0, done.err
    asked = "SELECT count(*) AS rows, count(vehicle_id) AS known, count(DISTINCT truth_id) AS vehicles FROM "
    asked += "surrounding_truth WHERE connected"
    found = command.here("sql", asked, "--lake", tmp_path / "lake", "--json")
    truth = json.loads(found.out)[0]
    assert truth["vehicles"] == drive["vehicles"]
    assert truth["known"] > 0.9 * truth["rows"]
    origin = command.here("sql", "SELECT origin, stations, messages FROM drives", "--lake", tmp_path / "lake", "--json")
    expected = {"origin": "synthetic", "stations": drive["heard"] + 1, "messages": drive["messages"]}
    assert json.loads(origin.out) == [expected]


def test_a_share_of_all_vehicles(command: Command, lake: Lake, tmp_path):
    options = ("--lake", lake.root, "--format", "bsmp1", "--json")
    first, again = (
        json.loads(command.here("instrument", "--share", "0.01", "--out", tmp_path / name, *options).out)["drives"]
        for name in ("a", "b")
    )
    assert len(first) > 1
    assert [each["ego_id"] for each in first] == [each["ego_id"] for each in again]
    assert all(each["seconds"] >= 4 for each in first)


def test_doubtful_truth_is_named(command: Command, lake: Lake, tmp_path):
    asked = (
        "SELECT subset, vehicle_id FROM findings JOIN vehicles USING (dataset, subset, vehicle_id) "
        "WHERE severity = 'error' AND vehicles.entries > 150 ORDER BY ALL LIMIT 1"
    )
    found = json.loads(command.here("sql", asked, "--lake", lake.root, "--json").out)[0]
    ego = ("--ego", f"{found['subset']}:{found['vehicle_id']}")
    done = command.here("instrument", *ego, "--lake", lake.root, "--out", tmp_path, "--format", "bsmp1")
    assert done.code == 0, done.err
    shown = " ".join(done.err.split())
    assert f"note: {found['subset']}-{found['vehicle_id']}: the ego " in shown
    assert "their truth may be wrong, and so errors against it" in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--ego", "02-lowr:3"), r"no subset '02-lowr'; did you mean 02-lower?"),
        (("--ego", "02-lower:99999"), "02-lower has no vehicle 99999: "),
        (("--ego", "02-lower"), "expected SUBSET:VEHICLE, for instance 02-lower:21"),
        ((), "give either --ego SUBSET:VEHICLE or --share"),
        (("--share", "1.5"), "expected a share above 0, at most 1; got 1.5"),
        (("--share", "0.1", "--gnss", "gps"), "did you mean dgps?"),
        (("--ego", "02-lower:3", "--format", "bsm"), "did you mean bsmp1?"),
    ],
)
def test_what_cannot_be_instrumented_is_refused(command: Command, lake: Lake, tmp_path, arguments, message):
    done = command.here("instrument", *arguments, "--lake", lake.root, "--out", tmp_path / "drives")
    assert done.code == 2
    assert message in " ".join(done.err.replace("│", "").split())
    assert not (tmp_path / "drives").exists()
