"""Is everything there: metadata, rows and publishers announce; what was kept is counted by hand or by a slow loop."""

import tempfile
from collections import Counter
from pathlib import Path

import polars as pl
import pytest
from highd_files import TRACKS, VEHICLES, meta_row, track_row, vehicle_row, write_recording
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_texts import TEXT_NAMES, as_csv, ngsim, ngsim_row, read_highd, read_ngsim, write

from tracklake.pipeline.sources.completeness import Announced, compare_counts
from tracklake.pipeline.sources.ngsim_dialects import RECORDINGS
from tracklake.pipeline.sources.source import Subset
from tracklake.schemas import COMPLETENESS, INGEST_LOG, SUBSETS
from tracklake.schemas import TRACKS as TRACKS_TABLE
from tracklake.schemas import VEHICLES as VEHICLES_TABLE
from tracklake.schemas.completeness import MEASURES, PUBLISHED_TOTALS

INT32_MAX = 2**31 - 1


def figures(canonical):
    """{(authority, measure): (expected, found, agrees)} of a table that is what its schema says."""
    table = COMPLETENESS.validate(canonical.completeness, where="test")
    for expected, found, agrees in table.select("expected", "found", "agrees").rows():
        assert agrees is (None if expected is None or found is None else expected == found)
    beside_entries = table.filter(pl.col("rows_dropped").is_not_null())["measure"]
    assert set(beside_entries) <= {"entries"}
    return {
        (authority, measure): (expected, found)
        for authority, measure, expected, found in table.select("authority", "measure", "expected", "found").rows()
    }


def dropped(canonical):
    """Rows that could be some of those missing."""
    return set(canonical.completeness.filter(pl.col("measure") == "entries")["rows_dropped"])


COMPLETE = {
    # Two cars of two rows on the upper carriageway; a car of two and a truck of one on the lower.
    ("recordingMeta", "vehicles"): (4, 4),
    ("recordingMeta", "cars"): (3, 3),
    ("recordingMeta", "trucks"): (1, 1),
    ("tracksMeta", "entries"): (7, 7),
    ("tracksMeta", "vehicles_without_rows"): (0, 0),
    ("tracksMeta", "vehicles_incomplete"): (0, 0),
    ("tracksMeta", "first_frames_differ"): (0, 0),
    ("tracksMeta", "last_frames_differ"): (0, 0),
}


def changed(**found):
    """COMPLETE with other findings, by measure."""
    return {key: (expected, found.get(key[1], as_before)) for key, (expected, as_before) in COMPLETE.items()}


def test_a_complete_recording(tmp_path):
    canonical = read_highd(write_recording(tmp_path))
    assert figures(canonical) == COMPLETE
    assert {measure for _, measure in COMPLETE} == set(MEASURES)
    assert canonical.notes == ()
    assert dropped(canonical) == {0}


@pytest.mark.parametrize(
    ("left_out", "found", "note"),
    [
        # Frame 2 of vehicle 1
        ([1], {"entries": 6, "vehicles_incomplete": 1, "last_frames_differ": 1},
         "01: tracksMeta announces 7 rows of 4 vehicles, the tracks have 6; 1 vehicle has other than announced (for "
         "example 1: 1 of 2 rows), 1 vehicle ends elsewhere than announced (for example 1: frame 1 instead of 2)"),
        # Frame 1 of vehicles 2 and 3
        ([2, 4], {"entries": 5, "vehicles_incomplete": 2, "first_frames_differ": 2},
         "01: tracksMeta announces 7 rows of 4 vehicles, the tracks have 5; 2 vehicles have other than announced (for "
         "example 2: 1 of 2 rows), 2 vehicles begin elsewhere than announced (for example 2: frame 2 instead of 1)"),
    ],
)  # fmt: skip
def test_vehicles_short_of_rows(tmp_path, left_out, found, note):
    tracks = [row for place, row in enumerate(TRACKS) if place not in left_out]
    canonical = read_highd(write_recording(tmp_path, tracks=tracks))
    assert figures(canonical) == changed(**found)
    assert canonical.notes == (note,)


def test_a_vehicle_without_rows(tmp_path):
    canonical = read_highd(write_recording(tmp_path, tracks=TRACKS[:-1]))
    assert figures(canonical) == changed(vehicles=3, trucks=0, entries=6, vehicles_without_rows=1)
    assert canonical.notes == (
        "01: recordingMeta announces 4 vehicles, 1 truck, the tracks have 3, 0",
        "01: tracksMeta announces 7 rows of 4 vehicles, the tracks have 6; 1 vehicle has no row (for example 4)",
    )


def test_a_whole_carriageway_without_rows(tmp_path):
    canonical = read_highd(write_recording(tmp_path, tracks=TRACKS[4:]))
    assert [subset.name for subset in canonical.subsets] == ["01-lower"]
    assert figures(canonical) == changed(vehicles=2, cars=1, entries=3, vehicles_without_rows=2)
    assert canonical.notes[1].endswith("2 vehicles have no row (for example 1)")


def test_totals_of_the_recording_that_are_wrong(tmp_path):
    """5 vehicles announced, of them 2 cars; nothing is missing of any vehicle."""
    canonical = read_highd(write_recording(tmp_path, meta=meta_row(vehicles=5).replace(",5,3,1,", ",5,2,1,")))
    assert figures(canonical) == COMPLETE | {
        ("recordingMeta", "vehicles"): (5, 4),
        ("recordingMeta", "cars"): (2, 3),
    }
    assert canonical.notes == ("01: recordingMeta announces 5 vehicles, 2 cars, the tracks have 4, 3",)


def test_a_row_too_many_does_not_make_up_for_a_row_too_few(tmp_path):
    """Vehicle 1 announces 3 rows and has 2; the truck announces 1 and has 2."""
    vehicles = [vehicle_row(1, 4, 2, 3, 1), *VEHICLES[1:]]
    tracks = [*TRACKS, track_row(2, 4, (51, 25, 12, 2.5), ("20.00", "0.00"), 6)]
    canonical = read_highd(write_recording(tmp_path, vehicles=vehicles, tracks=tracks))
    assert figures(canonical) == COMPLETE | {
        ("tracksMeta", "entries"): (8, 8),
        ("tracksMeta", "vehicles_incomplete"): (0, 2),
        ("tracksMeta", "last_frames_differ"): (0, 2),
    }
    assert "2 vehicles have other than announced (for example 1: 2 of 3 rows)" in canonical.notes[0]


def test_frames_that_were_numbered_anew(tmp_path):
    """Vehicle 1 announces frames 11 and 12 and stands in 1 and 2: as many rows as there should be."""
    moved = VEHICLES[0].replace(",1,2,2,Car", ",11,12,2,Car")
    canonical = read_highd(write_recording(tmp_path, vehicles=[moved, *VEHICLES[1:]]))
    assert figures(canonical) == changed(first_frames_differ=1, last_frames_differ=1)
    assert canonical.notes[0].endswith(
        "1 vehicle begins elsewhere than announced (for example 1: frame 1 instead of 11), "
        "1 vehicle ends elsewhere than announced (for example 1: frame 2 instead of 12)"
    )


def test_counts_that_metadata_leave_empty_are_not_compared(tmp_path):
    vehicles = [row.replace(",1,", ",,", 1) if place else row for place, row in enumerate(VEHICLES)]
    paths = write_recording(tmp_path, meta=meta_row().replace(",4,3,1,", ",4,,,"), vehicles=vehicles)
    canonical = read_highd(paths)
    assert [row.split(",")[3] for row in vehicles] == ["1", "", "", ""]
    assert figures(canonical) == COMPLETE | {
        ("recordingMeta", "cars"): (None, 3),
        ("recordingMeta", "trucks"): (None, 1),
    }
    nothing = [row.replace(",1,", ",,", 1) for row in VEHICLES]
    canonical = read_highd(write_recording(tmp_path, vehicles=nothing))
    assert figures(canonical) == COMPLETE | {("tracksMeta", "first_frames_differ"): (0, None)}
    assert canonical.notes == ()


def test_dropped_rows_are_named_as_far_as_they_may_be_the_missing_ones(tmp_path):
    """Three rows of seven are missing, one of them malformed; a row is repeated; the blank line was no row."""
    tracks = ["2,1,99", *TRACKS[2:4], TRACKS[4], TRACKS[4], "", TRACKS[-1]]
    canonical = read_highd(write_recording(tmp_path, vehicles=VEHICLES, tracks=tracks))
    assert figures(canonical)["tracksMeta", "entries"] == (7, 4)
    assert dropped(canonical) == {2}
    assert canonical.notes[1].endswith(
        "; dropped rows (3 fields instead of 25: 1, duplicate row: 1) may be 2 of the 3 missing"
    )


def test_dropped_rows_are_not_mentioned_where_nothing_is_missing(tmp_path):
    canonical = read_highd(write_recording(tmp_path, tracks=[*TRACKS, TRACKS[0], "1,2,3"]))
    assert figures(canonical) == COMPLETE
    assert dropped(canonical) == {2}
    assert canonical.notes == ()


@st.composite
def recordings(draw):
    """Vehicles as id -> (direction, first frame, rows), and which of their rows go missing."""
    ids = draw(st.lists(st.sampled_from([1, 2, 3, 7, 20, INT32_MAX]), min_size=1, max_size=5, unique=True))
    vehicles = {
        vehicle: (draw(st.integers(1, 2)), draw(st.integers(1, 30)), draw(st.integers(1, 6))) for vehicle in ids
    }
    rows = [(vehicle, first + step) for vehicle, (_, first, count) in vehicles.items() for step in range(count)]
    order = draw(st.permutations(rows))
    lost = draw(st.sets(st.sampled_from(rows), max_size=len(rows) - 1))
    return vehicles, order, lost


@settings(max_examples=15, deadline=None)
@given(recordings(), st.integers(0, 3))
def test_found_and_missing_rows_add_up_to_the_announced_ones(recording, repeated):
    vehicles, order, lost = recording
    kept = [row for row in order if row not in lost]
    lane = {1: 2, 2: 5}
    lines = [track_row(frame, vehicle, (100, 9, 4, 2), (25, 0), lane[vehicles[vehicle][0]]) for vehicle, frame in kept]
    meta = [
        f"{vehicle},4,2,{first},{first + count - 1},{count},Car,{direction},1,25,25,25,-1,-1,-1,0"
        for vehicle, (direction, first, count) in vehicles.items()
    ]
    total = meta_row(vehicles=len(vehicles)).replace(f",{len(vehicles)},3,1,", f",{len(vehicles)},{len(vehicles)},0,")
    with tempfile.TemporaryDirectory() as folder:
        # Repetitions of rows that were kept are dropped and change nothing but their own count.
        paths = write_recording(Path(folder), meta=total, vehicles=meta, tracks=lines + lines[:repeated])
        canonical = read_highd(paths)
    found = figures(canonical)
    rows_of = Counter(vehicle for vehicle, _ in kept)
    frames_of = {vehicle: sorted(frame for other, frame in kept if other == vehicle) for vehicle in rows_of}
    expected, entries = found["tracksMeta", "entries"]
    assert expected == len(order)
    assert entries == len(kept) == expected - len(lost)
    assert found["recordingMeta", "vehicles"] == found["recordingMeta", "cars"] == (len(vehicles), len(rows_of))
    assert found["recordingMeta", "trucks"] == (0, 0)
    assert found["tracksMeta", "vehicles_without_rows"] == (0, len(vehicles) - len(rows_of))
    short = [vehicle for vehicle, rows in rows_of.items() if rows != vehicles[vehicle][2]]
    assert found["tracksMeta", "vehicles_incomplete"] == (0, len(short))
    late = [vehicle for vehicle, frames in frames_of.items() if frames[0] != vehicles[vehicle][1]]
    assert found["tracksMeta", "first_frames_differ"] == (0, len(late))
    early = [vehicle for vehicle, frames in frames_of.items() if frames[-1] != sum(vehicles[vehicle][1:]) - 1]
    assert found["tracksMeta", "last_frames_differ"] == (0, len(early))
    assert dropped(canonical) == {min(repeated, len(kept))}
    assert bool(canonical.notes) == bool(lost)


UNKNOWN = 1118853000000 - 100
"""A key that no published recording has."""


def vehicle_rows(vehicle, frames, announced, **values):
    return [ngsim_row(vehicle, frame, key=UNKNOWN, Total_Frames=announced, **values) for frame in frames]


def test_total_frames_that_are_kept_and_others(tmp_path):
    """Vehicle 3 has its 2 rows, 7 has 2 of 1,156, and 9 has 2 where it announces 1."""
    rows = [*vehicle_rows(3, (1, 2), 2), *vehicle_rows(7, (5, 6), "1,156"), *vehicle_rows(9, (1, 2), 1)]
    canonical = ngsim(tmp_path, as_csv(rows))
    assert figures(canonical) == {
        ("Total_Frames", "entries"): (2 + 1156 + 1, 6),
        ("Total_Frames", "vehicles_incomplete"): (0, 2),
    }
    assert canonical.notes == (
        "us-101-20050615-093000: Total_Frames announces 1,159 rows of 3 vehicles, the tracks have 6; 2 vehicles have "
        "other than announced (for example 7: 2 of 1,156 rows)",
    )
    # What SQL can list per vehicle, as the table's description says.
    (subset,) = canonical.subsets
    differing = subset.vehicles.filter(pl.col("entries") != pl.col("entries_announced"))
    assert differing["vehicle_id"].to_list() == [7, 9]
    complete = ngsim(tmp_path / "complete", as_csv(vehicle_rows(3, (1, 2), 2)))
    assert figures(complete) == {("Total_Frames", "entries"): (2, 2), ("Total_Frames", "vehicles_incomplete"): (0, 0)}
    assert complete.notes == ()


def test_files_without_total_frames_are_not_compared_by_it(tmp_path):
    names = [name for name in TEXT_NAMES if name != "Total_Frames"]
    canonical = ngsim(tmp_path, as_csv(vehicle_rows(3, (1, 2), 2), names))
    assert figures(canonical) == {
        ("Total_Frames", "entries"): (None, None),
        ("Total_Frames", "vehicles_incomplete"): (0, None),
    }
    assert canonical.notes == ()


def test_vehicles_that_announce_nothing_are_left_out_of_the_sum(tmp_path):
    """Two files of one recording, one without the column."""
    names = [name for name in TEXT_NAMES if name != "Total_Frames"]
    said = write(tmp_path / "a.csv", as_csv(vehicle_rows(3, (1, 2), 3), TEXT_NAMES))
    unsaid = write(tmp_path / "b.csv", as_csv(vehicle_rows(4, (1, 2), 9), names))
    (canonical,) = read_ngsim(tmp_path, said, unsaid)[0].values()
    assert figures(canonical)["Total_Frames", "entries"] == (3, 2)
    assert figures(canonical)["Total_Frames", "vehicles_incomplete"] == (0, 1)


def test_what_a_second_file_repeats_is_no_loss(tmp_path):
    rows = vehicle_rows(3, (1, 2), 3)
    one, two = (write(tmp_path / name, as_csv(rows) + b"\n") for name in ("a.csv", "b.csv"))
    (canonical,) = read_ngsim(tmp_path, one, two)[0].values()
    assert sorted(canonical.rejects["reason"]) == ["blank line"] * 2 + ["duplicate row"] * 2
    assert dropped(canonical) == {0}
    assert "dropped" not in canonical.notes[0]
    alone = ngsim(tmp_path / "alone", as_csv([*rows, rows[0]]))
    assert dropped(alone) == {1}
    assert alone.notes[0].endswith("; dropped rows (duplicate row: 1) may be 1 of the 1 missing")


def test_a_vehicle_that_turns_is_one_vehicle(tmp_path):
    """On an arterial it drives north in two frames and east in the third: two subsets, and nothing is missing."""
    peachtree = {"key": 1163030300, "Location": "peachtree", "Total_Frames": 3}
    rows = [ngsim_row(5, frame, Direction=2 if frame < 3 else 1, **peachtree) for frame in (1, 2, 3)]
    canonical = ngsim(tmp_path, as_csv(rows))
    assert {subset.name: subset.tracks.height for subset in canonical.subsets} == {
        "peachtree-1600-east": 1,
        "peachtree-1600-north": 2,
    }
    assert figures(canonical) == {("Total_Frames", "entries"): (3, 3), ("Total_Frames", "vehicles_incomplete"): (0, 0)}


def test_an_excerpt_of_a_published_recording(tmp_path):
    """A complete vehicle of 2 rows and a line that cannot be read, of the 2,169 vehicles of US-101 07:50."""
    rows = [ngsim_row(5, frame, Total_Frames=2) for frame in (1, 2)]
    canonical = ngsim(tmp_path, as_csv([*rows, ngsim_row(6, 1, v_Vel="fast")]))
    assert figures(canonical) == {
        ("published", "entries"): (1_180_598, 2),
        ("published", "vehicles"): (2_169, 1),
        ("Total_Frames", "entries"): (2, 2),
        ("Total_Frames", "vehicles_incomplete"): (0, 0),
    }
    assert canonical.notes == (
        "us-101-0750: 2 of 1,180,598 published rows (< 0.1 %) and 1 of 2,169 vehicles: an excerpt, or incomplete; "
        "dropped rows (not a number: v_Vel: 1) may be 1 of the 1,180,596 missing",
    )


def published(entries, vehicles):
    """`compare` of made-up vehicles of US-101 07:50: all but the first have one row."""
    frame = pl.DataFrame(
        {
            "dataset": "ngsim", "subset": "us-101-0750", "vehicle_id": range(1, vehicles + 1),
            "source_vehicle_id": range(1, vehicles + 1), "class": None, "length_m": None, "width_m": None,
            "length_range_m": None, "width_range_m": None, "automated": None,
            "first_frame": 1, "last_frame": 1, "entries": [entries - vehicles + 1] + [1] * (vehicles - 1),
            "entries_announced": None, "start_x_m": 0.0, "end_x_m": 0.0, "start_lane": None, "mean_speed_mps": 0.0,
            "lane_changes": None,
        },
        schema=VEHICLES_TABLE.dtypes,
    )  # fmt: skip
    subset = Subset("us-101-0750", TRACKS_TABLE.empty(), frame, SUBSETS.empty())
    announced = Announced(PUBLISHED_TOTALS["us-101-0750"], "published", None, "Total_Frames")
    return compare_counts("ngsim", "us-101-0750", [subset], announced, INGEST_LOG.empty())


@pytest.mark.parametrize(
    ("entries", "vehicles", "notes"),
    [
        (1_180_598, 2_169, ()),
        (1_180_597, 2_169, ("us-101-0750: 1,180,597 of 1,180,598 published rows (99.9 %) and 2,169 of 2,169 vehicles: "
                            "an excerpt, or incomplete",)),
        (1_180_599, 2_169, ("us-101-0750: 1,180,599 of 1,180,598 published rows (100.0 %) and 2,169 of 2,169 vehicles: "
                            "other than published",)),
        (1_180_598, 2_168, ("us-101-0750: 1,180,598 of 1,180,598 published rows (100.0 %) and 2,168 of 2,169 vehicles: "
                            "other than published",)),
        (10_000, 31, ("us-101-0750: 10,000 of 1,180,598 published rows (0.8 %) and 31 of 2,169 vehicles: an excerpt, "
                      "or incomplete",)),
    ],
)  # fmt: skip
def test_a_published_recording_that_is_whole_and_others(entries, vehicles, notes):
    table, found = published(entries, vehicles)
    assert found == notes
    agrees = table.filter(pl.col("authority") == "published").select("measure", "agrees").rows()
    assert agrees == [("entries", entries == 1_180_598), ("vehicles", vehicles == 2_169)]


def test_published_totals_are_the_freeways():
    freeways = {name for name in RECORDINGS.values() if name.startswith(("us-101", "i-80"))}
    assert set(PUBLISHED_TOTALS) == freeways
    assert sum(totals["vehicles"] for totals in PUBLISHED_TOTALS.values()) == 11_779
    assert sum(totals["entries"] for totals in PUBLISHED_TOTALS.values()) == 8_665_320


def test_published_vehicles_are_ids(tmp_path):
    """One id stands for two vehicles, distinguished by what they announce; each has all of its rows."""
    rows = [ngsim_row(5, 1, Total_Frames=1), *(ngsim_row(5, frame, Total_Frames=2, v_Class=3) for frame in (7, 8))]
    canonical = ngsim(tmp_path, as_csv(rows))
    assert canonical.subsets[0].vehicles.height == 2
    assert figures(canonical) == {
        ("published", "entries"): (1_180_598, 3),
        ("published", "vehicles"): (2_169, 1),
        ("Total_Frames", "entries"): (3, 3),
        ("Total_Frames", "vehicles_incomplete"): (0, 0),
    }


def test_more_dropped_rows_than_missing_ones(tmp_path):
    """One row of vehicle 3 is missing, two lines are malformed; one row of vehicle 4 is too many."""
    bad = vehicle_rows(3, (3, 4), 3, v_Vel="fast")
    missing = ngsim(tmp_path / "missing", as_csv([*vehicle_rows(3, (1, 2), 3), *bad]))
    assert missing.notes[0].endswith("; dropped rows (not a number: v_Vel: 2) may be 1 of the 1 missing")
    assert dropped(missing) == {2}
    surplus = ngsim(tmp_path / "surplus", as_csv([*vehicle_rows(4, (1, 2), 1), *bad]))
    assert surplus.notes == (
        "us-101-20050615-093000: Total_Frames announces 1 row of 1 vehicle, the tracks have 2; 1 vehicle has other "
        "than announced (for example 4: 2 of 1 rows)",
    )


def test_many_short_vehicles_are_one_note_about_the_first(tmp_path):
    rows = [row for vehicle in range(60, 0, -1) for row in vehicle_rows(vehicle, (1, 2), 10)]
    canonical = ngsim(tmp_path, as_csv(rows))
    assert canonical.notes == (
        "us-101-20050615-093000: Total_Frames announces 600 rows of 60 vehicles, the tracks have 120; 60 vehicles have "
        "other than announced (for example 1: 2 of 10 rows)",
    )


def test_what_a_fuller_file_has_too_is_no_loss(tmp_path):
    """The second file lacks the lane; its two rows are those of the first."""
    rows = vehicle_rows(3, (1, 2), 3)
    full = write(tmp_path / "a.csv", as_csv(rows, TEXT_NAMES))
    derived = write(tmp_path / "b.csv", as_csv(rows, [name for name in TEXT_NAMES if name != "Lane_ID"]))
    (canonical,) = read_ngsim(tmp_path, full, derived)[0].values()
    assert canonical.rejects.height == 2
    assert figures(canonical)["Total_Frames", "entries"] == (3, 2)
    assert dropped(canonical) == {0}
