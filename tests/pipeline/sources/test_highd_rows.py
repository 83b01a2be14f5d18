"""Rows that can be read but not be true beside the others are dropped one by one; the recording stays."""

import pytest
from highd_files import TRACKS, VEHICLES, track_row, vehicle_row, write_recording
from raw_texts import read_highd

from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.highd_rows import LANE, SPEED
from tracklake.pipeline.sources.levelx import UNKNOWN_VEHICLE

BOX = (100, 13, 4, 2)


def reasons(canonical):
    log = canonical.log.filter(dialect="highd-tracks").row(0, named=True)
    assert log["rows_read"] == log["rows_kept"] + log["rows_dropped"]
    assert log["rows_dropped"] == canonical.rejects.height
    assert log["rows_kept"] == sum(subset.tracks.height for subset in canonical.subsets)
    return canonical.rejects.select("line", "reason").rows()


# Two lanes each way: 1 shoulder, 2 and 3 upper, 4 median, 5 and 6 lower, 7 shoulder.
@pytest.mark.parametrize(
    ("vehicle", "lane", "kept_as"),
    [(1, 1, 3), (1, 2, 2), (1, 3, 1), (1, 4, 0), (3, 4, 0), (3, 5, 1), (3, 6, 2), (3, 7, 3)],
)
def test_lanes_of_the_carriageway_and_the_strips_beside_them_are_kept(tmp_path, vehicle, lane, kept_as):
    vehicles = [vehicle_row(1, 4, 2, 1, 1), vehicle_row(3, 4, 2, 1, 2)]
    tracks = [track_row(1, vehicle, BOX, ("0.00", "0.00"), lane)]
    canonical = read_highd(write_recording(tmp_path, vehicles=vehicles, tracks=tracks))
    assert reasons(canonical) == []
    assert canonical.subsets[0].tracks["lane"].to_list() == [kept_as]


@pytest.mark.parametrize(
    ("vehicle", "lane", "velocity", "reason"),
    [
        (1, 0, "-25.00", LANE),
        (1, 5, "-25.00", LANE),
        (1, 50, "-25.00", LANE),
        (3, 0, "25.00", LANE),
        (3, 3, "25.00", LANE),
        (3, 8, "25.00", LANE),
        (1, 2, "40.01", SPEED),
        (3, 5, "-40.01", SPEED),
        (1, 0, "99.00", LANE),
    ],
)
def test_a_row_that_cannot_be_on_its_carriageway_is_dropped_alone(tmp_path, vehicle, lane, velocity, reason):
    tracks = [*TRACKS, track_row(9, vehicle, BOX, (velocity, "0.00"), lane)]
    canonical = read_highd(write_recording(tmp_path, tracks=tracks))
    assert reasons(canonical) == [(9, reason)]
    whole = read_highd(write_recording(tmp_path / "whole"))
    assert all(one.tracks.equals(other.tracks) for one, other in zip(canonical.subsets, whole.subsets, strict=True))


def test_a_few_damaged_ids_are_dropped_and_many_are_refused(tmp_path):
    """One of a hundred rows may name a vehicle that is not there, two may not."""
    vehicles = [vehicle_row(1, 4, 2, 99, 1)]
    tracks = [track_row(frame, 1, BOX, ("-25.00", "0.00"), 2) for frame in range(1, 100)]
    stranger = track_row(100, 77, BOX, ("-25.00", "0.00"), 2)
    canonical = read_highd(write_recording(tmp_path, vehicles=vehicles, tracks=[*tracks, stranger]))
    assert reasons(canonical) == [(101, UNKNOWN_VEHICLE)]
    again = track_row(101, 77, BOX, ("-25.00", "0.00"), 2)
    files = write_recording(tmp_path / "many", vehicles=vehicles, tracks=[*tracks, stranger, again])
    with pytest.raises(SourceError, match=r"01_tracks\.csv, line 101: vehicle 77 has no row in 01_tracksMeta\.csv"):
        read_highd(files)


def test_the_vehicles_of_the_examples_are_on_the_carriageways_meant():
    assert [row.split(",")[7] for row in VEHICLES] == ["1", "1", "2", "2"]
