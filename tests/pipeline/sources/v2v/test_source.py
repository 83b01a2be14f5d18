"""Drives in the lake: what is recognised, what is one drive, its clock and tables, and the account of every line."""

import json

import polars as pl
import pytest

from tracklake import open as open_lake
from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import Digests, discover
from tracklake.pipeline.lake import open_for_writing
from tracklake.pipeline.sources import SourceError

PLACE = "40.0,-83.0,200"


def write_line(receiver=1, sender=1, gentime_us=0, count=0, place=PLACE):
    """One message of BsmP1, eastward at 9 m/s."""
    return f"{receiver},7,{sender},{gentime_us},0,{count},0,{place},9.0,90.0,0,0,0,0,0,0,0\n"


@pytest.fixture
def put(tmp_path):
    """Put a file of lines into the source; name and lines."""

    def write(name, *lines):
        path = tmp_path / "source" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(lines))
        return path

    return write


def find(tmp_path, name="source"):
    return discover(tmp_path / name, digest=Digests(tmp_path / "lake"))


def read(tmp_path, name="source"):
    """The lake of what was put, without Prefect."""
    with open_for_writing(tmp_path / "lake") as writer:
        for job in ingest.plan(find(tmp_path, name), writer.manifest):
            writer.commit(ingest.build(tmp_path / "lake", job))
    return open_lake(tmp_path / "lake")


def test_the_logs_of_a_folder_are_one_drive_on_one_clock(tmp_path, put):
    put("trip/b.csv", write_line(gentime_us=1_500_000, count=1), write_line(sender=2, gentime_us=1_600_000))
    put("trip/a.csv", write_line(gentime_us=1_000_000), write_line(gentime_us=1_400_000, place="0,0,0"))
    lake = read(tmp_path)
    drive = lake.table("drives").collect().row(0, named=True)
    assert {name: drive[name] for name in ("subset", "recording", "origin", "seconds", "stations", "messages")} == {
        **dict.fromkeys(("subset", "recording"), "trip"),
        **{"origin": "recorded", "seconds": 0.6, "stations": 2, "messages": 3},
    }
    assert str(drive["start_utc"]) == "2004-01-01 00:00:01"
    stations = lake.table("stations").filter("own").collect()
    assert stations["vehicle_id"].to_list() == [drive["ego_id"]]
    assert lake.table("ego_states").select("time_s", "source").collect().rows() == [(0.0, "bsm"), (0.5, "bsm")]
    assert lake.table("bsm").select("time_s", "own").sort("time_s").collect().rows() == [
        (0.0, True),
        (0.5, True),
        (0.6, False),
    ]
    log = lake.table("ingest_log").select("file", "rows_read", "rows_kept", "rows_dropped").collect()
    assert log.rows() == [("trip/a.csv", 2, 1, 1), ("trip/b.csv", 2, 2, 0)]
    (refused,) = lake.table("rejects").collect().rows(named=True)
    assert (refused["file"], refused["line"], refused["reason"]) == ("trip/a.csv", 2, "position (0, 0)")
    assert refused["text"] == write_line(gentime_us=1_400_000, place="0,0,0").strip()
    assert lake.sql("SELECT count(*) FROM bsm WHERE subset = 'trip'").fetchall() == [(3,)]


def test_every_receiver_of_a_log_has_a_drive_of_its_own(tmp_path, put):
    put("trip/a.csv", write_line(receiver=12, sender=3), write_line(receiver=4, sender=4, gentime_us=200_000))
    drives = read(tmp_path).table("drives").sort("subset").collect()
    assert drives.select("subset", "recording", "stations").rows() == [
        ("trip-rx12", "trip", 1),
        ("trip-rx4", "trip", 1),
    ]
    assert drives["ego_id"].is_null().to_list() == [True, False], "12 logged no message of its own"


def test_drives_of_the_same_name_in_different_places_stay_apart(tmp_path, put):
    for name in ("one/trip/a.csv", "two/trip/a.csv", "three/Trip/a.csv", "other/a.csv", "a.csv"):
        put(name, write_line())
    names = [unit.recording for _, unit in find(tmp_path).units]
    assert sorted(names) == ["one-trip", "other", "source", "three-Trip", "two-trip"]
    assert [unit.recording for _, unit in find(tmp_path, "source/a.csv").units] == ["a"]


def test_what_is_no_log_of_a_drive_is_skipped_or_named(tmp_path, put):
    put("trip/a.csv", write_line())
    put("trip/notes.json", '{"name": "my drive"}')
    put("trip/other.csv", "a,b,c\n1,2,3\n")
    found = find(tmp_path)
    assert found.skipped == ("trip/notes.json",)
    (refusal,) = found.refusals
    assert "trip/other.csv, line 1: not a known trajectory file" in refusal
    assert "BsmP1" in refusal


def test_logs_of_which_nothing_is_usable_are_refused(tmp_path, put):
    put("trip/a.csv", write_line(place="0,0,0"), write_line(place="91,0,0"))
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"recording trip: no message is usable.* first trip/a\.csv, line 1"):
        ingest.build(tmp_path / "lake", job)


def _open_new(root):
    with open_for_writing(root) as writer:
        return writer.manifest


def test_parts_of_bags_and_bags_in_archives_are_refused(tmp_path, put):
    put("bag/metadata.yaml", "rosbag2_bagfile_information:\n  version: 5\n")
    (refusal,) = find(tmp_path).refusals
    assert "bag/metadata.yaml: the metadata of a ROS 2 bag without its messages" in refusal
    (tmp_path / "source" / "bag" / "metadata.yaml").unlink()
    (tmp_path / "source" / "bag" / "x_0.mcap").write_bytes(b"\x89MCAP0\r\n")
    (refusal,) = find(tmp_path).refusals
    assert "bag/x_0.mcap: part of a ROS 2 bag without its metadata" in refusal


def test_the_truth_of_a_drive_names_vehicles_by_their_messages(tmp_path, put):
    put(
        "trip/a.csv",
        *(write_line(gentime_us=tick * 100_000, count=tick) for tick in range(3)),
        *(write_line(sender=9, gentime_us=tick * 100_000, count=tick) for tick in range(3)),
    )
    header = (
        "truth_id,tick,truth_dataset,truth_subset,connected,rel_x_m,rel_y_m,rel_heading_deg,speed_mps,accel_mps2,"
        "ego_speed_mps,ego_yaw_deg,ego_x_m,ego_y_m,lane,ego_lane,length_m,width_m,visible,temporary_id\n"
    )
    rows = [
        f"{vehicle},{tick},highd,01-upper,{connected},5,-3.5,0,20,,21,0,100,4,1,2,4.5,1.8,,{sent}\n"
        for vehicle, tick, connected, sent in ((30, 0, "true", "9"), (30, 1, "true", "9"), (31, 1, "false", ""))
    ]
    put("trip/truth.csv", "# tracklake drive truth, start_us=1072915200100000\n", header, *rows, rows[0], "31,x\n")
    lake = read(tmp_path)
    assert lake.table("drives").collect()["origin"].to_list() == ["synthetic"]
    other = lake.table("stations").filter(~pl.col("own")).collect()["vehicle_id"].item()
    truth = lake.table("surrounding_truth").select("truth_id", "tick", "vehicle_id", "connected").collect()
    # The file's tick 0 lies one tick after the drive's start.
    assert truth.rows() == [(30, 1, other, True), (30, 2, other, True), (31, 2, None, False)]
    refused = lake.table("rejects").select("line", "reason").collect()
    assert refused.rows() == [(6, "duplicate row"), (7, "2 fields instead of 20")]
    put("trip/b.csv", write_line(receiver=2))
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"truth\.csv is the truth of one drive, .* 2 receivers"):
        ingest.build(tmp_path / "lake", job)


def test_commands_show_drives_keep_them_apart_and_remove_them(tmp_path, put, command, plain_flows):
    del plain_flows
    put(
        "one/trip/a.csv", write_line(), write_line(gentime_us=100_000, count=1), write_line(gentime_us=200_000, count=2)
    )
    put("two/trip/a.csv", write_line(gentime_us=9))
    put("notes/readme.txt", "no log\n")
    lake = ("--lake", tmp_path / "lake")
    done = command.here("run", tmp_path / "source" / "one" / "trip", *lake, "--dataset", "v2v")
    assert done.code == 0, done.err
    assert "drives  1 drives: 1 senders, 3 messages\nrows    3 read, 0 rejected\nreport" in done.out
    assert 'sql "FROM drives"' in done.out
    again = command.here("run", tmp_path / "source" / "one" / "trip", *lake)
    assert "nothing to do" in again.out
    shown = command.here("info", *lake).out
    assert [line.split() for line in shown.splitlines() if line.startswith("trip")] == [
        ["trip", "recorded", "1", "3", "0", "0", "0.2"]
    ]
    other = command.here("ingest", tmp_path / "source" / "two" / "trip", *lake)
    assert other.code == 3
    assert "recording trip: another drive of this name is in the lake" in other.err
    assert command.here("ingest", tmp_path / "source" / "two" / "trip", *lake, "--recording", "later").code == 0
    assert json.loads(command.here("info", *lake, "--json").out)["drives"][0]["subset"] == "later"
    assert "1 messages" in command.here("remove", "v2v/later", *lake).out
    assert command.here("check", *lake).code == 0
    assert command.here("ingest", tmp_path / "source" / "notes", *lake).code == 1
    put("one/other/a.csv", write_line(gentime_us=7))
    assert command.here("run", tmp_path / "source" / "one", *lake).code == 0
    (tmp_path / "source" / "one" / "trip" / "a.csv").unlink()
    pruned = command.here("run", tmp_path / "source" / "one", *lake, "--prune")
    assert "recording trip: no longer in SOURCE, and removed from the lake (3 messages)" in pruned.out
