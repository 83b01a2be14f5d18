"""highD by hand: both carriageways, lanes, gaps, and every way in which three files can disagree."""

import gzip

import polars as pl
import pytest
from highd_files import TRACKS, VEHICLES, meta_row, track_row, vehicle_row, write_recording
from raw_texts import check_accounts, raw_file, read_highd, tracks_of, write

from tracklake.pipeline.sources.highd import HIGHD
from tracklake.pipeline.sources.source import Part, SourceError
from tracklake.schemas import SUBSETS
from tracklake.schemas import TRACKS as TRACKS_TABLE
from tracklake.schemas import VEHICLES as VEHICLES_TABLE

TRACKS_FILE = ["01_tracks.csv"]


def close(value):
    return pytest.approx(value, abs=1e-5)


def by_name(canonical):
    for subset in canonical.subsets:
        TRACKS_TABLE.validate(subset.tracks, where=subset.name)
        VEHICLES_TABLE.validate(subset.vehicles, where=subset.name)
        SUBSETS.validate(subset.facts, where=subset.name)
    return {subset.name: subset for subset in canonical.subsets}


@pytest.mark.parametrize(("week_day", "origin"), [("Tue", "recorded"), ("", "recorded"), ("synthetic", "synthetic")])
def test_the_origin_of_a_recording_is_its_week_day(tmp_path, week_day, origin):
    canonical = read_highd(write_recording(tmp_path, meta=meta_row().replace("Tue", week_day)))
    assert [subset.facts["origin"][0] for subset in by_name(canonical).values()] == [origin, origin]


def test_golden_numbers_of_the_upper_carriageway(tmp_path):
    canonical = read_highd(write_recording(tmp_path))
    subset = by_name(canonical)["01-upper"]
    tracks = subset.tracks
    assert tracks.select("vehicle_id", "frame").rows() == [(1, 1), (1, 2), (2, 1), (2, 2)]
    # Fronts are the left sides 100, 99, 60, 59, measured from the rightmost.
    assert tracks["x_m"].to_list() == close([0, 1, 40, 41])
    # The carriageway's left edge is its lowest marking, 16; middles are at 14, 14, 14, 10. Vehicle 1 moves 0.1 m/s to
    # the left on average: its front is 4 / 2 * 0.1 / 25 = 0.008 m left of its middle.
    assert tracks["y_m"].to_list() == [1.992, 1.992, 2, 6]
    assert tracks["heading_rad"].to_list() == close([-0.004, -0.004, 0, 0])
    assert tracks["lane"].to_list() == [1, 1, 1, 2]
    assert tracks["speed_mps"].to_list() == close([25, 25, 25, -1])
    assert tracks["accel_mps2"].to_list() == close([-0.5, 0, 0, 0])
    assert tracks["lateral_speed_mps"].to_list() == close([-0.2, 0, 0, 0])
    assert tracks["leader_id"].to_list() == [2, 2, None, None]
    assert tracks["follower_id"].to_list() == [None, None, 1, 1]
    assert tracks["gap_m"].to_list() == [35, 35, None, None]
    assert tracks["headway_recorded_m"].to_list() == [35, 35, None, None]
    assert tracks["time_s"].to_list() == close([0, 0.04, 0, 0.04])
    assert tracks["speed_cd_mps"].null_count() == tracks["speed_10hz_mps"].null_count() == 4
    facts = subset.facts.row(0, named=True)
    assert facts["lane_markings_m"] == close([0, 4, 8])
    assert facts["seconds"] == close(901.56)
    assert facts["vehicles_per_lane_s"] == close(2 / 2 / 901.56)
    # 25 + 25 + 25 - 1 m/s for 1/25 s each, on 41 m of two lanes.
    assert facts["flow_vphpl"] == pytest.approx(3600 * 74 / 25 / (41 * 2 * 901.56), rel=1e-5)
    assert (facts["lanes"], facts["site"], facts["direction"], facts["frame_rate_hz"], facts["first_frame"]) == (
        2, "location-3", "upper", 25, 1)  # fmt: skip
    assert subset.vehicles["length_m"].to_list() == [4, 5]
    check_accounts(canonical, entries_from=TRACKS_FILE)


def test_sizes_that_vary_within_a_track_are_known(tmp_path):
    files = write_recording(tmp_path)
    tracks = tmp_path / "01_tracks.csv"
    rows = pl.read_csv(tracks)
    first = (pl.col("id") == 1) & (pl.col("frame") == 2)
    rows.with_columns(
        width=pl.when(first).then(pl.col("width") + 0.25).otherwise("width"),
        height=pl.when(first).then(pl.col("height") - 0.1).otherwise("height"),
    ).write_csv(tracks)
    vehicles = by_name(read_highd(files))["01-upper"].vehicles
    assert vehicles["length_range_m"].to_list() == close([0.25, 0])
    assert vehicles["width_range_m"].to_list() == close([0.1, 0])
    assert vehicles["length_m"].to_list() == close([4, vehicles["length_m"][1]])


def test_golden_numbers_of_the_lower_carriageway(tmp_path):
    subset = by_name(read_highd(write_recording(tmp_path, end="\r\n")))["01-lower"]
    tracks = subset.tracks
    assert tracks.select("vehicle_id", "frame").rows() == [(3, 1), (3, 2), (4, 1)]
    # Fronts are the right sides; the left edge is the uppermost marking, 20.
    assert tracks["x_m"].to_list() == close([14, 15, 62])
    assert tracks["y_m"].to_list() == close([2, 2, 6.25])
    assert tracks["lane"].to_list() == [1, 1, 2]
    assert tracks["speed_mps"].to_list() == close([25, 25, 20])
    assert tracks["accel_mps2"].to_list() == close([-0.5, 0, 0])
    assert tracks["lateral_speed_mps"].to_list() == close([0.2, -0.2, 0])
    # 62 - 12 - 14 in frame 1; the leader has no entry in frame 2, where no headway stands in for it.
    assert tracks["gap_m"].to_list() == [36, None, None]
    assert tracks["leader_id"].to_list() == [4, 4, None]
    vehicles = subset.vehicles
    assert vehicles["class"].to_list() == ["car", "truck"]
    assert vehicles["width_m"].to_list() == [2, 2.5]
    assert vehicles["entries_announced"].to_list() == [2, 1]
    assert subset.facts["lane_markings_m"].to_list() == [close([0, 4, 8])]


def test_lanes_count_from_the_drivers_left_over_three_and_three(tmp_path):
    upper = [track_row(1, i, (100, 8 + 4 * (i - 1) + 1, 4, 2), (-25, 0), i + 1) for i in (1, 2, 3)]
    lower = [track_row(1, i, (100, 24 + 4 * (i - 4) + 1, 4, 2), (25, 0), i + 2) for i in (4, 5, 6)]
    vehicles = [vehicle_row(i, 4, 2, 1, 1 if i < 4 else 2) for i in range(1, 7)]
    paths = write_recording(
        tmp_path, meta=meta_row(upper="8;12;16;20", lower="24;28;32;36"), vehicles=vehicles, tracks=upper + lower
    )
    subsets = by_name(read_highd(paths))
    assert subsets["01-upper"].tracks.select("lane", "y_m").rows() == [(3, 10), (2, 6), (1, 2)]
    assert subsets["01-lower"].tracks.select("lane", "y_m").rows() == [(1, 2), (2, 6), (3, 10)]


def test_one_vehicle_with_one_row_is_a_recording_with_one_subset(tmp_path):
    canonical = read_highd(write_recording(tmp_path, tracks=TRACKS[-1:]))
    assert list(by_name(canonical)) == ["01-lower"]
    assert canonical.notes[0] == "01: recordingMeta announces 4 vehicles, 3 cars, the tracks have 1, 0"
    check_accounts(canonical, entries_from=TRACKS_FILE)


def test_classes_may_be_written_in_any_case(tmp_path):
    vehicles = [vehicle_row(1, 4, 2, 1, 1, "CAR"), vehicle_row(4, 4, 2, 1, 2, "truck")]
    canonical = read_highd(write_recording(tmp_path, vehicles=vehicles, tracks=[TRACKS[0], TRACKS[-1]]))
    assert [subset.vehicles["class"].to_list() for subset in canonical.subsets] == [["car"], ["truck"]]


def test_repeated_and_conflicting_rows_are_dropped_with_a_reason(tmp_path):
    other = track_row(1, 1, (90, 13, 4, 2), (-25, 0), 3)
    canonical = read_highd(write_recording(tmp_path, tracks=[*TRACKS, TRACKS[0], other, "1,2,3", other]))
    assert canonical.rejects.select("line", "reason", "text").rows() == [
        (9, "duplicate row", TRACKS[0]),
        (10, "another row has the same vehicle and frame", other),
        (11, "3 fields instead of 25", "1,2,3"),
        (12, "duplicate row", other),
    ]
    # The row that stands first in the file is the one that is kept.
    assert tracks_of(canonical).filter(pl.col("vehicle_id") == 1)["x_m"].to_list() == close([0, 1])
    check_accounts(canonical, entries_from=TRACKS_FILE)


def test_a_repeated_vehicle_multiplies_no_entries(tmp_path):
    canonical = read_highd(write_recording(tmp_path, vehicles=[*VEHICLES, VEHICLES[1]]))
    assert by_name(canonical)["01-upper"].tracks.height == 4
    assert canonical.rejects.select("file", "line", "reason").rows() == [("01_tracksMeta.csv", 6, "duplicate row")]
    check_accounts(canonical, entries_from=TRACKS_FILE)


def test_a_vehicle_in_both_directions_is_refused(tmp_path):
    paths = write_recording(tmp_path, vehicles=[*VEHICLES, vehicle_row(1, 4, 2, 2, 2)])
    with pytest.raises(SourceError, match=r"01_tracksMeta\.csv, line 6: a second, different row of vehicle 1"):
        read_highd(paths)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meta": meta_row(2)}, r"01_recordingMeta\.csv, line 2: expected id 1, .* got 2\. .*restore"),
        ({"meta": []}, r"01_recordingMeta\.csv: expected one readable row under the header, got 0\."),
        ({"meta": [meta_row(), meta_row()]}, r"got 2\. Restore"),
        ({"meta": meta_row(rate="fast")}, r"got 0\. Line 2 cannot be read: not a number: frameRate\. Restore"),
        ({"meta": meta_row(upper="")}, r"got 0\. Line 2 cannot be read: empty: upperLaneMarkings"),
        ({"meta": meta_row(upper="8;x;16")}, r"line 2: expected lane markings as increasing numbers .* got '8;x;16'"),
        ({"meta": meta_row(upper="8;16;12")}, "increasing"),
        ({"meta": meta_row(upper="8;8;12")}, "increasing"),
        ({"meta": meta_row(upper="8")}, "increasing"),
        ({"meta": meta_row(lower="nan;20")}, "increasing"),
        ({"meta": meta_row(lower="20;inf")}, "increasing"),
        ({"vehicles": VEHICLES[:2]}, r"01_tracks\.csv, line 6: vehicle 3 has no row in 01_tracksMeta\.csv \(2 such"),
        ({"vehicles": []}, r"line 2: vehicle 1 has no row .* \(4 such vehicles\)\. .*restore"),
        ({"tracks": []}, r"01_tracks\.csv: no readable row\. Expected frame,id,x,y, .* each\. Restore"),
        ({"tracks": ["1,2"]}, r"no readable row\. .* each\. Line 2 cannot be read: 2 fields instead of 25\. Restore"),
    ],
)
def test_files_that_cannot_be_used_are_refused_with_a_next_step(tmp_path, changes, message):
    with pytest.raises(SourceError, match=message):
        read_highd(write_recording(tmp_path, **changes))


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_file_emptied_after_recognition_is_refused(tmp_path, kind):
    paths = write_recording(tmp_path)
    files = [raw_file(path, HIGHD) for path in paths]
    write(paths[kind], b"")
    with pytest.raises(SourceError, match=rf"{paths[kind].name}: empty\. Expected the header"):
        HIGHD.to_canonical([Part(file) for file in files], "01")


def test_compressed_files_are_read_and_cut_ones_refused(tmp_path):
    expected = tracks_of(read_highd(write_recording(tmp_path)))
    packed = [
        write(tmp_path / f"{path.name}.gz", gzip.compress(path.read_bytes())) for path in write_recording(tmp_path)
    ]
    assert tracks_of(read_highd(packed)).equals(expected)
    whole = packed[2].read_bytes()
    # Cut in the trailer: the header can still be read, the file cannot.
    write(packed[2], whole[:-4])
    with pytest.raises(SourceError, match=r"01_tracks\.csv\.gz: the compressed file is damaged or cut short"):
        read_highd(packed)


def group(*paths):
    return HIGHD.group([raw_file(path, HIGHD) for path in paths])


def test_recordings_are_gathered_by_folder_and_number(tmp_path):
    one, two = write_recording(tmp_path), write_recording(tmp_path, number="02")
    grouping = group(*two[::-1], *one)
    assert [unit.recording for unit in grouping.units] == ["01", "02"]
    assert [[file.path for file in unit.files] for unit in grouping.units] == [one, two]
    assert not grouping.refusals


def test_a_missing_file_is_named_and_the_others_go_through(tmp_path):
    one, two = write_recording(tmp_path), write_recording(tmp_path, number="02")
    grouping = group(*one, *two[1:])
    assert [unit.recording for unit in grouping.units] == ["01"]
    (refusal,) = grouping.refusals
    assert refusal.startswith("recording 02: 02_recordingMeta.csv missing beside 02_tracks")


def test_a_second_file_of_one_kind_is_named_not_passed_over(tmp_path):
    paths = write_recording(tmp_path)
    copy = write(tmp_path / "01_tracks (1).csv", paths[2].read_bytes() + b"\n")
    grouping = group(copy, *paths)
    assert [file.path for file in grouping.units[0].files] == paths
    assert grouping.refusals == (
        "01_tracks (1).csv: a second tracks file of recording 01 beside 01_tracks.csv, which was used. Expected one; "
        "remove one of the two.",
    )


def test_a_second_set_of_files_is_refused(tmp_path):
    grouping = group(*write_recording(tmp_path / "a"), *write_recording(tmp_path / "b"))
    assert len(grouping.units) == 1
    assert "recording 01: a second set of files" in grouping.refusals[0]


def test_a_name_without_a_number_is_refused(tmp_path):
    paths = write_recording(tmp_path)
    renamed = write(tmp_path / "tracks.csv", paths[2].read_bytes())
    grouping = group(*paths, renamed)
    assert "tracks.csv: has the columns of a highD tracks file" in grouping.refusals[0]
    assert len(grouping.units) == 1


@pytest.mark.parametrize("change", [lambda h: h.replace(b"frame,", b"frames,", 1), lambda h: b"x" + h])
def test_other_headers_are_not_recognised(tmp_path, change):
    data = write_recording(tmp_path)[2].read_bytes()
    assert HIGHD.detect(data, "01_tracks.csv") == "highd-tracks"
    assert HIGHD.detect(change(data), "01_tracks.csv") is None
