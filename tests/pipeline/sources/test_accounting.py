"""Every row of a damaged source is kept or counted among the dropped ones."""

import polars as pl
import pytest
from highd_files import TRACKS, write_recording
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_texts import (
    TEXT_NAMES,
    as_csv,
    as_text,
    check_accounts,
    ngsim_row,
    physical_lines,
    raw_file,
    read_highd,
    read_ngsim,
    write,
)

from tracklake.pipeline.sources.accounting import DUPLICATE, split_duplicates
from tracklake.pipeline.sources.ngsim import NGSIM
from tracklake.pipeline.sources.source import SourceError
from tracklake.schemas import StructureError

KEYS = (1118846978900, 1163030300)
ROWS = [
    ngsim_row(
        vehicle,
        frame,
        key=key,
        Preceding=vehicle - 1,
        Following=vehicle + 1,
        Space_Headway="30.5",
        Direction="" if key == KEYS[0] else vehicle,
        Location="us-101" if key == KEYS[0] else "peachtree",
    )
    for key in KEYS
    for vehicle in (1, 2, 3)
    for frame in (1, 2, 4)
]
NGSIM_FILES = {
    "export": as_csv(ROWS, bom=True, end="\r\n"),
    "plain": as_csv(ROWS, TEXT_NAMES),
    "no header": as_csv(ROWS, TEXT_NAMES, header=()),
    "text": as_text(ROWS),
    "lower case": as_csv(ROWS, header=[name.lower() for name in ROWS[0]]),
}
DIGITS = [bytes([byte]) for byte in b"0123456789"]
SPICE = [b'"', b",", b"\n", b"\r", b"\0", b"\xff", b" ", b"-", b".", b"e9", b'""', b"\xef\xbb\xbf", b"1,156"]


def edits():
    what = st.sampled_from(["replace", "insert", "cut", "copy", "move", "swap", "end"])
    extra = st.sampled_from(DIGITS + SPICE)
    return st.lists(st.tuples(st.integers(0, 10_000), what, extra), max_size=5)


def damage(data, edits, *, header):
    """Edit what stands after the header: bytes replaced, put in or cut, lines copied, moved, their fields swapped."""
    cut = data.find(b"\n") + 1 if header else 0
    head, data = data[:cut], data[cut:]
    for where, what, extra in edits:
        at = where % (len(data) + 1)
        lines = data.split(b"\n")
        line, other = where % len(lines), (where // 7) % len(lines)
        match what:
            case "replace":
                data = data[:at] + extra + data[at + len(extra) :]
            case "insert":
                data = data[:at] + extra + data[at:]
            case "cut":
                data = data[:at] + data[at + where % 40 :]
            case "end":
                data = data[: len(data) - where % 60]
            case "swap":
                fields = lines[line].split(b",")
                first, second = where % len(fields), other % len(fields)
                fields[first], fields[second] = fields[second], fields[first]
                lines[line] = b",".join(fields)
                data = b"\n".join(lines)
            case _:
                lines.insert(other, lines[line] if what == "copy" else lines.pop(line))
                data = b"\n".join(lines)
    return head + data


@given(name=st.sampled_from(sorted(NGSIM_FILES)), edits=edits())
@settings(max_examples=20, deadline=None)
def test_no_damage_to_an_ngsim_file_crashes_or_loses_a_row(tmp_path_factory, name, edits):
    header = name not in ("no header", "text")
    data = damage(NGSIM_FILES[name], edits, header=header)
    folder = tmp_path_factory.mktemp("fuzz")
    path = write(folder / "file", data)
    if NGSIM.detect(data, path.name) is None:
        return
    lines = physical_lines(data)
    if header:
        del lines[1]
    file = raw_file(path)
    spilled = NGSIM.spill(file, folder / "spilled")
    assert spilled.rows_read == len(lines) == sum(spilled.recordings.values()) + spilled.rejects.height
    assert all(lines[line] == text for line, _, text in spilled.rejects.rows())
    for recording, rows in spilled.recordings.items():
        found = pl.scan_ipc(folder / "spilled" / recording / "*.arrow").collect()
        assert found.height == rows
        assert set(found["line"]) <= lines.keys()
    try:
        found, _ = read_ngsim(folder, path)
    except (SourceError, StructureError):
        return
    assert sum(canonical.log["rows_kept"].sum() for canonical in found.values()) <= sum(spilled.recordings.values())
    for canonical in found.values():
        check_accounts(canonical, entries_from=["file"])
        assert all(lines[line] == text for line, text in canonical.rejects.select("line", "text").rows())


@given(kind=st.sampled_from([0, 1, 2, 2, 2]), edits=edits())
@settings(max_examples=20, deadline=None)
def test_no_damage_to_a_highd_file_crashes_or_loses_a_row(tmp_path_factory, kind, edits):
    folder = tmp_path_factory.mktemp("fuzz")
    paths = write_recording(folder, tracks=TRACKS * 2)
    data = damage(paths[kind].read_bytes(), edits, header=True)
    write(paths[kind], data)
    try:
        canonical = read_highd(paths)
    except (SourceError, StructureError):
        return
    check_accounts(canonical, entries_from=["01_tracks.csv"])
    for path in paths:
        lines = physical_lines(path.read_bytes())
        row = canonical.log.filter(pl.col("file") == path.name)
        assert row["rows_read"].item() == len(lines) - 1
        rejects = canonical.rejects.filter(pl.col("file") == path.name)
        assert all(lines[line] == text for line, text in rejects.select("line", "text").rows())


@pytest.mark.parametrize("order", [1, -1])
def test_one_recording_in_two_files_is_one_recording(tmp_path, order):
    """Rows 0-5 and 3-8 of one recording: three rows stand in both files, in two dialects."""
    rows = ROWS[:9]
    paths = [write(tmp_path / "a.csv", as_csv(rows[:6])), write(tmp_path / "b.txt", as_text(rows[3:]))]
    found, _ = read_ngsim(tmp_path, *paths[::order])
    (canonical,) = found.values()
    check_accounts(canonical, entries_from=["a.csv", "b.txt"])
    assert canonical.log["rows_kept"].sum() == 9
    assert canonical.log["rows_read"].sum() == 12
    assert canonical.rejects["reason"].to_list() == [DUPLICATE] * 3
    assert canonical.rejects["file"].unique().to_list() == ["b.txt" if order == 1 else "a.csv"]


values = st.integers(0, 2) | st.none()
rows = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1), values, values), min_size=1, max_size=12)


@given(rows=rows)
@settings(max_examples=35, deadline=None)
def test_repetitions_against_a_loop(rows):
    frame = pl.DataFrame(
        [(*row, 0, line) for line, row in enumerate(rows, start=1)],
        schema={**dict.fromkeys("abcd", pl.Int32), "file_index": pl.Int64, "line": pl.Int64},
        orient="row",
    )
    first, again = split_duplicates(frame, ["a", "b"])
    seen = {}
    for line, row in enumerate(rows, start=1):
        seen.setdefault(row, line)
    assert sorted(first["line"]) == sorted(seen.values())
    assert sorted(again["line"]) == sorted(set(range(1, len(rows) + 1)) - set(seen.values()))
    assert first.select("a", "b").rows() == sorted(first.select("a", "b").rows())
