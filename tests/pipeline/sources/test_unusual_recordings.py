"""Recordings as damage and reused ids make them: what is announced of split ids, and clocks that tell nothing apart."""

import pytest
from raw_texts import TEXT_NAMES, US_101_0750, as_csv, ngsim, ngsim_row, raw_file, read_ngsim, write

from tracklake.pipeline.sources.ngsim import NGSIM
from tracklake.pipeline.sources.source import SourceError

PEACHTREE = 1163030300


def total_frames(canonical):
    """{measure: (expected, found)} of what Total_Frames announces."""
    rows = canonical.completeness.select("authority", "measure", "expected", "found").rows()
    return {measure: (expected, found) for authority, measure, expected, found in rows if authority == "Total_Frames"}


def test_vehicles_of_one_id_that_announce_the_same_are_announced_each(tmp_path):
    # Two vehicles of id 5 in the same three frames, 200 m apart, each of three frames as it says.
    rows = [
        ngsim_row(5, frame, Total_Frames=3, Local_Y=start + 5 * frame) for frame in (1, 2, 3) for start in (100, 756)
    ]
    canonical = ngsim(tmp_path, as_csv(rows))
    assert canonical.subsets[0].facts["vehicles"].item() == 2
    assert total_frames(canonical) == {"entries": (6, 6), "vehicles_incomplete": (0, 0)}
    assert not any("Total_Frames" in note for note in canonical.notes)
    short = ngsim(tmp_path / "short", as_csv(rows[:-1]))
    assert total_frames(short) == {"entries": (6, 5), "vehicles_incomplete": (0, 1)}
    assert any("announces 6 rows of 2 vehicles, the tracks have 5; 1 vehicle has" in note for note in short.notes)


def test_of_a_split_id_that_turns_all_rows_count_together(tmp_path):
    # Two vehicles of id 5 northbound, of which one turns east after frame 2: announced are 3 + 3 rows.
    values = {"key": PEACHTREE, "Location": "peachtree", "Total_Frames": 3}
    north = [ngsim_row(5, frame, Direction=2, Local_Y=100 + 5 * frame, **values) for frame in (1, 2, 3)]
    turns = [ngsim_row(5, frame, Direction=2, Local_Y=756 + 5 * frame, **values) for frame in (1, 2)]
    turned = [ngsim_row(5, 3, Direction=1, Local_Y=771, **values)]
    canonical = ngsim(tmp_path, as_csv(north + turns + turned))
    assert total_frames(canonical) == {"entries": (6, 6), "vehicles_incomplete": (0, 0)}


def test_times_that_tell_no_recordings_apart_are_refused(tmp_path):
    """Times behind the first rows, which are judged, differ from row to row."""
    rows = [ngsim_row(frame, frame, Global_Time=US_101_0750 + 7 * frame) for frame in range(1, 451)]
    file = raw_file(write(tmp_path / "rounded.csv", as_csv(rows, TEXT_NAMES)))
    with pytest.raises(SourceError, match=r"rounded\.csv: 450 recordings by Global_Time - 100 \* Frame_ID"):
        NGSIM.spill(file, tmp_path / "spilled")


def test_damaged_times_of_some_rows_are_no_reason_to_refuse_a_file(tmp_path):
    rows = [ngsim_row(vehicle, frame) for vehicle in (1, 2, 3) for frame in range(1, 73)]
    for row in rows[:60]:
        row["Global_Time"] = US_101_0750 + 7 * row["Frame_ID"]
    found, _ = read_ngsim(tmp_path, write(tmp_path / "some.csv", as_csv(rows, TEXT_NAMES)))
    assert len(found) == 61
    assert found["us-101-0750"].log["rows_kept"].sum() == 156
