"""A file with some of the columns beside the full file of the same recording: each entry once."""

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_texts import EXPORT_NAMES, TEXT_NAMES, as_csv, as_text, check_accounts, ngsim_row, read_ngsim, tracks_of, write

from tracklake.pipeline.sources.accounting import DUPLICATE, FILE
from tracklake.pipeline.sources.derived import IN_FULLER_FILE, split_derived

FEW = ["Vehicle_ID", "Frame_ID", "Global_Time", "Local_X", "Local_Y", "v_Vel"]
ROWS = [ngsim_row(vehicle, frame, Local_Y=100 * vehicle + 5 * frame) for vehicle in (1, 2, 3) for frame in (1, 2, 3, 4)]


def plain(rows):
    return [{name: str(value) for name, value in row.items()} for row in rows]


def both(folder, full, derived, *, order=1):
    """The recording in two files, full.csv and derived.csv."""
    paths = [write(folder / "full.csv", full), write(folder / "derived.csv", derived)]
    found, _ = read_ngsim(folder, *paths[::order])
    (canonical,) = found.values()
    check_accounts(canonical, entries_from=["full.csv", "derived.csv"])
    return canonical


@pytest.mark.parametrize("order", [1, -1])
def test_the_full_files_rows_are_kept(tmp_path, order):
    canonical = both(tmp_path, as_csv(ROWS), as_csv(plain(ROWS), FEW), order=order)
    (subset,) = canonical.subsets
    assert (subset.tracks.height, subset.vehicles.height) == (12, 3)
    assert subset.tracks["lane"].to_list() == [2] * 12
    assert subset.facts["columns_missing"].to_list() == [[]]
    assert subset.facts["ids_split"].item() == 0
    assert canonical.rejects.select("file", "reason").unique().rows() == [("derived.csv", IN_FULLER_FILE)]
    log = {row["file"]: row for row in canonical.log.iter_rows(named=True)}
    assert [log["full.csv"][name] for name in ("rows_read", "rows_kept", "rows_dropped")] == [12, 12, 0]
    assert [log["derived.csv"][name] for name in ("rows_read", "rows_kept", "rows_dropped")] == [12, 0, 12]
    assert log["derived.csv"]["dropped_by_reason"] == [{"reason": IN_FULLER_FILE, "rows": 12}]


def test_entries_that_only_the_derived_file_has_are_kept(tmp_path):
    """Vehicle 3 goes on where the full file is cut, and stays the vehicle that it is there."""
    canonical = both(tmp_path, as_csv(ROWS[:-2]), as_csv(plain(ROWS), FEW))
    (subset,) = canonical.subsets
    assert (subset.tracks.height, subset.vehicles.height) == (12, 3)
    assert subset.facts["ids_split"].item() == 0
    assert subset.tracks["lane"].to_list() == [2] * 10 + [None] * 2
    vehicle = subset.vehicles.row(2, named=True)
    assert (vehicle["vehicle_id"], vehicle["entries"], vehicle["class"]) == (3, 4, "car")
    assert vehicle["length_m"] == pytest.approx(4.572)
    assert canonical.rejects.height == 10


def test_other_values_are_another_entry(tmp_path):
    """A second vehicle in frame 1, and a place that is off by a thousandth of a foot: both are kept."""
    derived = [ngsim_row(1, 1, Local_Y=900), ngsim_row(2, 1, Local_Y="205.001"), *ROWS[1:4]]
    canonical = both(tmp_path, as_csv(ROWS), as_csv(plain(derived), FEW))
    assert tracks_of(canonical).height == 14
    assert canonical.rejects.height == 3


def test_the_only_lanes_are_taken_over_from_the_file_with_fewer_columns(tmp_path):
    """full.csv has no lanes; derived.csv has fewer columns, but lanes 1, 2 and 3, and an entry of its own."""
    rows = [row | {"Lane_ID": row["Vehicle_ID"]} for row in ROWS]
    fuller = [name for name in TEXT_NAMES if name != "Lane_ID"]
    lanes = as_csv(plain([*rows, ngsim_row(9, 1, Lane_ID=5)]), [*FEW, "Lane_ID"])
    canonical = both(tmp_path, as_csv(plain(rows[:-1]), fuller), lanes)
    (subset,) = canonical.subsets
    assert subset.tracks["lane"].to_list() == [1] * 4 + [2] * 4 + [3] * 4 + [5]
    assert subset.facts["columns_missing"].to_list() == [[]]
    assert (subset.facts["ids_split"].item(), subset.vehicles.height) == (0, 4)
    # What only the fuller file says is still there: 15 ft for all but vehicle 9, and no leader.
    assert subset.vehicles["length_m"].to_list() == pytest.approx([4.572] * 3 + [None])
    assert dict(canonical.log.select("file", "rows_kept").rows()) == {"full.csv": 11, "derived.csv": 2}
    assert not [note for note in canonical.notes if "the files have no" in note]


def test_values_taken_over_go_on_to_a_fuller_file_still():
    """c, d and e stand in one file each: what the first file's row gets from the second, that has from the third."""
    schema = {**dict.fromkeys("abcdefgh", pl.Int32), FILE: pl.Int64, "line": pl.Int64}
    shares = [
        pl.DataFrame([{**values, FILE: file, "line": 1}], schema=schema)
        for file, values in enumerate(
            [dict.fromkeys("acfgh", 1), dict.fromkeys("abdf", 1) | {"d": 2}, {"a": 1, "b": 1, "e": 3}]
        )
    ]
    kept, dropped = split_derived(pl.concat(shares), shares, ["a"])
    # e reaches the first row by the second and by itself; b comes from both.
    assert kept.rows() == [(1, 1, 1, 2, 3, 1, 1, 1, 0, 1)]
    assert dropped.rows() == pl.concat(shares[1:]).rows(), "as they were"


def test_a_value_that_differs_in_any_column_of_both_is_another_entry(tmp_path):
    derived = [ROWS[0] | {"v_Vel": "51"}, *ROWS[1:]]
    assert tracks_of(both(tmp_path, as_csv(ROWS), as_csv(plain(derived), FEW))).height == 13


def test_a_derived_file_of_an_arterial_has_no_directions(tmp_path):
    rows = [
        ngsim_row(5, frame, key=1163030300, Direction=2, Local_Y=10 * frame, Location="peachtree") for frame in (1, 2)
    ]
    canonical = both(tmp_path, as_csv(rows), as_csv(plain(rows), TEXT_NAMES))
    assert [subset.name for subset in canonical.subsets] == ["peachtree-1600-north"]
    assert canonical.rejects.height == 2


def test_repetitions_in_the_derived_file(tmp_path):
    """Row 1 twice, a row of its own twice: three of the four are repetitions of something."""
    own = ngsim_row(9, 1, Local_Y=1)
    canonical = both(tmp_path, as_csv(ROWS), as_csv(plain([ROWS[0], own, ROWS[0], own]), FEW))
    assert tracks_of(canonical).height == 13
    assert canonical.rejects.select("line", "reason").sort("line").rows() == [
        (2, IN_FULLER_FILE), (4, IN_FULLER_FILE), (5, DUPLICATE)]  # fmt: skip


def test_three_files_each_with_fewer_columns(tmp_path):
    paths = [
        write(tmp_path / "few.csv", as_csv(plain(ROWS), FEW)),
        write(tmp_path / "export.csv", as_csv(ROWS[:4], EXPORT_NAMES)),
        write(tmp_path / "some.csv", as_csv(plain(ROWS[:8]), [*FEW, "Lane_ID"])),
    ]
    (canonical,) = read_ngsim(tmp_path, *paths)[0].values()
    check_accounts(canonical, entries_from=[path.name for path in paths])
    assert dict(canonical.log.select("file", "rows_kept").rows()) == {"export.csv": 4, "few.csv": 4, "some.csv": 4}


def test_the_same_columns_in_two_dialects_are_repetitions_as_ever(tmp_path):
    canonical = both(tmp_path, as_text(plain(ROWS)), as_csv(ROWS))
    assert set(canonical.rejects["reason"]) == {DUPLICATE}
    assert tracks_of(canonical).height == 12


values = st.sampled_from([None, 1, 2])
entries = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 1), values, values), max_size=6)
KEY = ["a", "b"]


@given(files=st.lists(st.tuples(entries, st.sets(st.sampled_from("cd"))), min_size=1, max_size=3))
@settings(max_examples=50, deadline=None)
def test_against_a_loop(files):
    schema = {**dict.fromkeys("abcd", pl.Int32), FILE: pl.Int64, "line": pl.Int64}
    blank = [
        [(a, b, None if "c" in gone else c, None if "d" in gone else d) for a, b, c, d in rows] for rows, gone in files
    ]
    shares = [
        pl.DataFrame([(*row, file, line) for line, row in enumerate(rows, start=1)], schema=schema, orient="row")
        for file, rows in enumerate(blank)
    ]
    columns = [[place for place in range(4) if any(row[place] is not None for row in rows)] for rows in blank]
    expected = set()
    for file, rows in enumerate(blank):
        for line, row in enumerate(rows, start=1):
            for other, others in enumerate(blank):
                fuller = (-len(columns[other]), columns[other]) < (-len(columns[file]), columns[file])
                common = set(columns[file]) & set(columns[other])
                if fuller and any(all(row[place] == twin[place] for place in common) for twin in others):
                    expected.add((file, line))
    # The only columns that may be lacking in the fuller of two files: d, where that has c and the other has d.
    taken_over = {}
    for file, rows in reversed(list(enumerate(blank))):
        for row in reversed(rows if columns[file] == [0, 1, 3] else []):
            taken_over[row[:2]] = row[3]
    kept, dropped = split_derived(pl.concat(shares), shares, KEY)
    assert kept.select("a", "b", "c", "d").rows() == [
        (*row[:3], taken_over.get(row[:2])) if columns[file] == [0, 1, 2] else row
        for file, rows in enumerate(blank)
        for line, row in enumerate(rows, start=1)
        if (file, line) not in expected
    ]
    assert set(dropped.select(FILE, "line").rows()) == expected
    every = {(file, line) for file, rows in enumerate(blank) for line in range(1, len(rows) + 1)}
    assert set(kept.select(FILE, "line").rows()) == every - expected
    assert kept.height + dropped.height == len(every)
    assert kept.select(FILE, "line").rows() == sorted(kept.select(FILE, "line").rows())
