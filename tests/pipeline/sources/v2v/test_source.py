"""Drives in the lake: what is recognised, what is one drive, its clock and tables, and the account of every line."""

import json
from zipfile import ZipFile

import drive_bags
import polars as pl
import pytest
from message_logs import REAL, needs_real_messages

from tracklake import open as open_lake
from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import Digests, discover
from tracklake.pipeline.lake import open_for_writing
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.v2v import logs

PLACE = "40.0,-83.0,200"
EPOCH_US = 1_072_915_200_000_000
"""Microseconds from 1970 to the moment from which BsmP1 counts."""
CORE = {
    **{"msgCnt": 95, "id": "31325431", "secMark": 20_050, "speed": 0.1, "heading": 250.9125},
    "position": {"latitude": 40.5, "longitude": -105.0, "elevation": 1472.8},
}
"""A decoded message, generated 20.05 s after a full minute."""


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
    put("trip/copy.bag")
    found = find(tmp_path)
    assert found.skipped == ("trip/notes.json",)
    empty, unknown = found.refusals
    assert "trip/copy.bag: empty file" in empty
    assert "trip/other.csv, line 1: not a known trajectory file" in unknown
    assert "BsmP1" in unknown


def test_a_message_of_another_year_is_rejected_and_the_drive_keeps_its_clock(tmp_path, put):
    lines = [write_line(gentime_us=tick * 100_000, count=tick) for tick in range(12)]
    lines[3] = write_line(gentime_us=31_536_000_000_000, count=3)
    lines[5] = write_line(gentime_us=630_720_000_000_000, count=5)
    put("trip/a.csv", *lines)
    lake = read(tmp_path)
    assert lake.table("drives").select("seconds", "messages").collect().rows() == [(pytest.approx(1.1), 10)]
    refused = lake.table("rejects").select("line", "reason").sort("line").collect()
    assert refused.rows() == [(line, "a day or more from the other messages of the drive") for line in (4, 6)]


def test_a_name_of_the_users_is_for_one_drive(tmp_path, put):
    put("trip/a.csv", write_line())
    given = {"digest": Digests(tmp_path / "lake"), "recording": "monday"}
    assert [unit.recording for _, unit in discover(tmp_path / "source", **given).units] == ["monday"]
    put("other/a.csv", write_line())
    found = discover(tmp_path / "source", **given)
    assert found.units == ()
    assert found.refusals == (
        "--recording monday: names one drive, and SOURCE holds 2: other, trip. Give the folder of one of them.",
    )


def test_logs_of_which_nothing_is_usable_are_refused(tmp_path, put):
    put("trip/a.csv", write_line(place="0,0,0"), write_line(place="91,0,0"))
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(
        SourceError, match=r"recording trip: no message, position or scan is usable.* first trip/a\.csv, line 1"
    ):
        ingest.build(tmp_path / "lake", job)


def test_more_messages_than_fit_into_the_memory_are_refused(tmp_path, put, monkeypatch):
    monkeypatch.setattr(logs, "MAX_TEXT_BYTES", 50)
    put("trip/a.csv", write_line())
    put("trip/b.csv", write_line())
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"trip/a\.csv: with the logs beside it .* GB of messages.*Split the log"):
        ingest.build(tmp_path / "lake", job)


def _open_new(root):
    with open_for_writing(root) as writer:
        return writer.manifest


def test_a_bag_in_a_folder_of_its_own_is_part_of_the_drive_beside_it(tmp_path, put):
    """A bag of two scans and one message, on the clock of the messages that were logged beside it."""
    start = drive_bags.START_US - 200_000
    gentime = start - EPOCH_US
    put("trip/a.csv", write_line(gentime_us=gentime), write_line(gentime_us=gentime + 200_000, count=1))
    sent = json.dumps(
        {"metadata": {"recordGeneratedAt": "2023-11-14T22:13:20Z"}, "payload": {"data": {"coreData": CORE}}}
    )
    received_us = drive_bags.START_US + 60_000
    drive_bags.write_small_bag(tmp_path / "source" / "trip" / "bag", 2, messages=[(received_us, sent)])
    lake = read(tmp_path)
    drive = lake.table("drives").collect().row(0, named=True)
    assert {name: drive[name] for name in ("subset", "origin", "scans", "images", "messages", "stations")} == {
        **{"subset": "trip", "origin": "synthetic"},
        **{"scans": 2, "images": 2, "messages": 3, "stations": 2},
    }
    assert (drive["camera_fx_px"], drive["camera_y_m"], drive["lidar_z_m"]) == (1000.0, -0.2, 1.9)
    assert drive["seconds"] == pytest.approx(0.4)
    # At 0.2 s both the receiver and a message state the ego's position: the receiver's counts.
    assert lake.table("ego_states").select(pl.col("time_s").round(6), "source").collect().rows() == [
        (0.0, "bsm"),
        *((time_s, "gnss") for time_s in (0.2, 0.3, 0.4)),
    ]
    returns = lake.table("lidar_returns").select(
        "scan", "point", pl.col("time_s", "x_m", "y_m", "z_m").cast(pl.Float64).round(3)
    )
    assert returns.collect().rows() == [(0, 0, 0.21, 10.5, 2.1, 0.9), (0, 1, 0.21, 5.5, -2.9, 2.4)]
    assert lake.table("detections").select(pl.col("time_s").round(6), "detection").collect().rows() == [
        (0.25, 0),
        (0.25, 1),
    ]
    heard = lake.table("bsm").filter(~pl.col("own")).select("temporary_id", pl.col("received_s").round(6)).collect()
    assert heard.rows() == [("31325431", 0.26)]
    log = lake.table("ingest_log").select("file", "dialect", "rows_read", "rows_kept").collect()
    assert log.rows() == [
        ("trip/a.csv", "bsmp1", 2, 2),
        ("trip/bag/bag.db3", "ros2-storage", 17, 17),
        ("trip/bag/metadata.yaml", "ros2-bag", 0, 0),
    ]
    alone = discover(tmp_path / "source" / "trip" / "bag", digest=Digests(tmp_path / "other"))
    assert [unit.recording for _, unit in alone.units] == ["bag"]


def test_a_message_of_a_bag_that_no_drive_takes_is_rejected_with_its_text(tmp_path):
    sent = [json.dumps({"payload": {"data": {"coreData": CORE | change}}}) for change in ({}, {"position": {}})]
    moments = [drive_bags.START_US + 60_000, drive_bags.START_US + 160_000]
    drive_bags.write_small_bag(tmp_path / "a.bag", messages=zip(moments, sent, strict=True))
    lake = read(tmp_path, "a.bag")
    assert lake.table("drives").select("subset", "messages").collect().rows() == [("a", 1)]
    (refused,) = lake.table("rejects").select("reason", "text").collect().rows()
    assert refused == ("no position", sent[1])


def test_bags_in_archives_and_without_their_files_are_refused(tmp_path, put):
    drive_bags.write_small_bag(tmp_path / "a.bag")
    (tmp_path / "source").mkdir()
    with ZipFile(tmp_path / "source" / "bags.zip", "w") as archive:
        archive.write(tmp_path / "a.bag", "a.bag")
    assert find(tmp_path).refusals == ("bags.zip/a.bag: a bag in an archive, which is not read. Unpack bags.zip.",)
    put("bag/metadata.yaml", "rosbag2_bagfile_information:\n  relative_file_paths:\n    - x_0.db3\n")
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"bag/metadata\.yaml: lists 'x_0\.db3', which is not beside it"):
        ingest.build(tmp_path / "lake", job)


@needs_real_messages
def test_real_logs_become_drives(tmp_path):
    for name in ("bsmp1_knoxville.csv", "ode_bsm_log.json", "ode_hex_decoded.json", "cvdp_hex_decoded.json"):
        folder = tmp_path / "source" / name.partition(".")[0]
        folder.mkdir(parents=True)
        (folder / name).symlink_to(REAL / name)
    lake = read(tmp_path)
    drives = lake.table("drives").select("recording", "messages").sort("recording").collect()
    log = lake.table("ingest_log").sort("recording").collect()
    assert (log["rows_read"] == log["rows_kept"] + log["rows_dropped"]).all()
    assert drives.group_by("recording").agg(pl.col("messages").sum()).sort("recording")["messages"].to_list() == (
        log["rows_kept"].to_list()
    )
    assert set(drives["recording"]) == {"bsmp1_knoxville", "ode_bsm_log", "ode_hex_decoded", "cvdp_hex_decoded"}


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
    far = rows[0].replace("30,0,", "30,2147483647,")
    put("trip/truth.csv", "# tracklake drive truth, start_us=1072915200100000\n", header, *rows, rows[0], "31,x\n", far)
    lake = read(tmp_path)
    assert lake.table("drives").collect()["origin"].to_list() == ["synthetic"]
    other = lake.table("stations").filter(~pl.col("own")).collect()["vehicle_id"].item()
    truth = lake.table("surrounding_truth").select("truth_id", "tick", "vehicle_id", "connected").collect()
    # The file's tick 0 lies one tick after the drive's start.
    assert truth.rows() == [(30, 1, other, True), (30, 2, other, True), (31, 2, None, False)]
    refused = lake.table("rejects").select("line", "reason").collect()
    assert refused.rows() == [(6, "duplicate row"), (7, "2 fields instead of 20"), (8, "out of range: tick")]
    put("trip/b.csv", write_line(receiver=2))
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"truth\.csv is the truth of one drive, .* 2 receivers"):
        ingest.build(tmp_path / "lake", job)
    (tmp_path / "source" / "trip" / "b.csv").unlink()
    second = put("trip/truth2.csv", "# tracklake drive truth, start_us=1072915200100000\n", header, *rows)
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"truth\.csv and trip/truth2\.csv are truths of one drive"):
        ingest.build(tmp_path / "lake", job)
    for path in (second, second.with_name("a.csv")):
        path.unlink()
    put("trip/truth.csv", "# tracklake drive truth, start_us=999999999999999999\n", header, *rows)
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"truth\.csv, line 1: start_us=9{18}\. Expected .* between 2004 and 2100"):
        ingest.build(tmp_path / "lake", job)
    put("trip/truth.csv", "# tracklake drive truth\n", header, *rows)
    (job,) = ingest.plan(find(tmp_path), _open_new(tmp_path / "lake"))
    with pytest.raises(SourceError, match=r"got none \(trip/truth\.csv\)\. Give all files of the recording"):
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
    assert "drives  1 drive: no messages of other vehicles, 3 of the ego\n" in done.out
    assert "rows    3 read, 0 rejected\nreport" in done.out
    assert 'sql "FROM drives"' in done.out
    again = command.here("run", tmp_path / "source" / "one" / "trip", *lake)
    assert "nothing to do" in again.out
    shown = command.here("info", *lake).out
    assert [line.split() for line in shown.splitlines() if line.startswith("trip")] == [
        ["trip", "recorded", "0", "0", "0", "0", "0.2"]
    ], "the ego and its messages are not of a vehicle around it"
    other = command.here("ingest", tmp_path / "source" / "two" / "trip", *lake)
    assert other.code == 3
    assert "recording trip: another drive of this name is in the lake" in other.err
    assert command.here("ingest", tmp_path / "source" / "two" / "trip", *lake, "--recording", "later").code == 0
    assert json.loads(command.here("info", *lake, "--json").out)["drives"][0]["subset"] == "later"
    assert "1 messages" in command.here("remove", "v2v/later", *lake).out
    assert command.here("check", *lake).code == 0
    assert command.here("ingest", tmp_path / "source" / "notes", *lake).code == 1
    put("one/other/a.csv", write_line(gentime_us=7))
    assert command.here("ingest", tmp_path / "source" / "one", *lake).code == 0
    (tmp_path / "source" / "one" / "trip" / "a.csv").unlink()
    pruned = command.here("ingest", tmp_path / "source" / "one", *lake, "--prune")
    assert "recording trip: no longer in SOURCE, and removed from the lake (3 messages)" in pruned.out
