"""One recording built from its raw files: why none could be, and what is suspicious about the number of rows."""

import re

import pytest
from highd_files import TRACKS, VEHICLES, track_row, vehicle_row, write_recording
from raw_texts import as_csv, ngsim_row, write

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.lake import open_for_writing
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.csv import hash_raw
from tracklake.pipeline.sources.highd_rows import LANE, SPEED


def build(source, lake):
    """The entry of the only recording in a folder."""
    with open_for_writing(lake) as writer:
        found = discover(source, digest=hash_raw)
        for dataset, file in ingest.find_unread_files(found, writer.manifest):
            writer.remember_sources({file.sha256: ingest.read_file(lake, dataset.name, file)})
        (job,) = ingest.plan(found, writer.manifest)
        return ingest.build(lake, job)


def test_a_recording_without_one_good_row_is_refused_with_the_commonest_reasons(tmp_path):
    """Rows 2-5 of vehicle 1 in lane 40; 6 as fast as nothing is; 7 no number; 8 cut."""
    box = (100, 13, 4, 2)
    rows = [track_row(frame, 1, box, ("-25.00", "0.00"), 40) for frame in (1, 2, 3, 4)]
    rows += [track_row(5, 1, box, ("99.00", "0.00"), 2), track_row(6, 1, box, ("x", "0.00"), 2), "7,1"]
    write_recording(tmp_path / "raw", vehicles=[vehicle_row(1, 4, 2, 7, 1)], tracks=rows)
    with pytest.raises(SourceError) as refused:
        build(tmp_path / "raw", tmp_path / "lake")
    assert str(refused.value) == (
        "recording 01: no carriageway has entries. Expected rows that can be used, got dropped ones only: "
        f"4 rows ({LANE}; first 01_tracks.csv, line 2: {rows[0][:60]!r}), "
        "1 row (2 fields instead of 25; first 01_tracks.csv, line 8: '7,1'), "
        f"1 row (not a number: xVelocity; first 01_tracks.csv, line 7: {rows[5][:60]!r}), 1 for other reasons. "
        "Restore the original files, or repair these lines."
    )
    assert SPEED > "not a number", "it is the fourth, by name"


def write_text(folder, rows):
    write(folder / "raw.csv", as_csv([ngsim_row(1, frame) for frame in range(1, rows + 1)]))


def write_tracks(folder, rows):
    write_recording(folder, vehicles=VEHICLES, tracks=TRACKS[:rows])


@pytest.mark.parametrize(("write_rows", "name"), [(write_text, "raw.csv"), (write_tracks, "01_tracks.csv")])
@pytest.mark.parametrize(("rows", "is_suspicious"), [(4, False), (5, True), (6, False)])
def test_as_many_rows_as_a_spreadsheet_holds_are_suspicious(
    tmp_path, monkeypatch, write_rows, name, rows, is_suspicious
):
    assert ingest.SPREADSHEET_ROWS == 2**20 - 1, "of its 1,048,576 one is the header"
    monkeypatch.setattr(ingest, "SPREADSHEET_ROWS", 5)
    write_rows(tmp_path / "raw", rows)
    entry = build(tmp_path / "raw", tmp_path / "lake")
    warnings = [note for note in entry.info["notes"] if re.search("(?i)truncated", note)]
    assert warnings == is_suspicious * [
        f"{name}: exactly 5 rows, a spreadsheet's limit: probably TRUNCATED. Compare with the publisher's count and "
        "download the file again."
    ]
