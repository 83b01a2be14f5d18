"""Writes small raw files by hand and reads them as the pipeline does."""

import csv
import io
from dataclasses import replace
from pathlib import Path

import polars as pl

from tracklake.pipeline.sources.csv import read_head
from tracklake.pipeline.sources.highd import HIGHD
from tracklake.pipeline.sources.ngsim import NGSIM
from tracklake.pipeline.sources.source import Part, RawFile

US_101_0750 = 1118846978900
TEXT_NAMES = (
    *("Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y", "Global_X", "Global_Y"),
    *("v_length", "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID"),
    *("Preceding", "Following", "Space_Headway", "Time_Headway"),
)
EXPORT_NAMES = (
    *("Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y", "Global_X", "Global_Y"),
    *("v_length", "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID"),
    *("O_Zone", "D_Zone", "Int_ID", "Section_ID", "Direction", "Movement"),
    *("Preceding", "Following", "Space_Headway", "Time_Headway", "Location"),
)
FIRST_RELEASE_NAMES = (
    *("Vehicle_ID", "Frame_ID", "Tot_Frames", "Epoch_ms", "Local_X", "Local_Y", "Global_X", "Global_Y"),
    *("Veh_Len", "Veh_Wid", "Veh_Class", "Veh_Velocity", "Vehicle_Acc", "Lane_ID"),
    *("Org_Zone", "Dest_Zone", "Intersection", "Section", "Direction", "Movement"),
    *("Preceding_Veh", "Following_Veh", "Spacing", "Headway"),
)
"""The export's names but for Location, as the arterials' first release has them."""


def ngsim_row(vehicle, frame, *, key=US_101_0750, **values):
    """The 25 values of one row as written, by the export's names."""
    row = dict.fromkeys(EXPORT_NAMES, "") | {
        "Vehicle_ID": vehicle,
        "Frame_ID": frame,
        "Total_Frames": 100,
        "Global_Time": key + 100 * frame,
        "Local_X": "20.5",
        "Local_Y": 100 + 5 * frame,
        "Global_X": "6451137.641",
        "Global_Y": "1873344.962",
        "v_length": 15,
        "v_Width": "6.5",
        "v_Class": 2,
        "v_Vel": "50",
        "v_Acc": "0",
        "Lane_ID": 2,
        "Preceding": 0,
        "Following": 0,
        "Space_Headway": 0,
        "Time_Headway": 0,
        "Location": "us-101",
    }
    unknown = values.keys() - row.keys()
    assert not unknown, unknown
    return row | values


def as_text(rows):
    """Whitespace-delimited, with runs of blanks, a tab and blanks at both ends, as in the original files."""
    lines = []
    for row in rows:
        values = [str(row[name]) for name in TEXT_NAMES]
        lines.append("  " + "   ".join(values[:9]) + "\t" + "  ".join(values[9:]) + "  \n")
    return "".join(lines).encode()


def as_csv(rows, names=EXPORT_NAMES, *, header=None, bom=False, end="\n"):
    """Comma-separated; `header` None = the names, () = none; values with a comma are quoted."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator=end)
    head = names if header is None else header
    if head:
        writer.writerow(head)
    writer.writerows([row[name] for name in names] for row in rows)
    return (b"\xef\xbb\xbf" if bom else b"") + out.getvalue().encode()


def write(path, data):
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def raw_file(path, source=NGSIM):
    """A recognised RawFile (its sha256 is not what is tested here)."""
    file = RawFile(path, path.name)
    dialect = source.detect(read_head(file), path.name)
    assert dialect is not None, f"{path.name} is not recognised"
    return replace(file, dialect=dialect, sha256=f"sha256-of-{path.name}")


def read_ngsim(folder, *paths):
    """{recording: Canonical} and [Spilled] of some files, by the two functions that ingestion calls."""
    spills = []
    parts = {}
    for number, path in enumerate(paths):
        file = raw_file(path)
        target = Path(folder) / f"spilled-{number}"
        spilled = NGSIM.spill(file, target)
        spills.append(spilled)
        for recording in spilled.recordings:
            rejects = spilled.rejects if len(spilled.recordings) == 1 else None
            rows = pl.scan_ipc(target / recording / "*.arrow")
            parts.setdefault(recording, []).append(Part(file, rows, rejects))
    return {recording: NGSIM.to_canonical(shares, recording) for recording, shares in parts.items()}, spills


def ngsim(folder, data, name="trajectories.csv"):
    """The only recording in some bytes."""
    found, _ = read_ngsim(folder, write(Path(folder) / name, data))
    assert len(found) == 1, sorted(found)
    return next(iter(found.values()))


def read_highd(paths, recording="01"):
    """Canonical of a recording's three files (recordingMeta, tracksMeta, tracks)."""
    return HIGHD.to_canonical([Part(raw_file(path, HIGHD)) for path in paths], recording)


def tracks_of(canonical):
    return pl.concat([subset.tracks for subset in canonical.subsets])


def check_accounts(canonical, *, entries_from):
    """Nothing lost: per file read = kept + dropped, rejects = dropped, and the entries are the rows kept.

    Args:
        canonical: of a recording.
        entries_from: names of the files whose kept rows are entries.
    """
    for row in canonical.log.iter_rows(named=True):
        assert row["rows_read"] == row["rows_kept"] + row["rows_dropped"], row
        mine = canonical.rejects.filter(pl.col("file") == row["file"])
        assert mine.height == row["rows_dropped"] == sum(count["rows"] for count in row["dropped_by_reason"])
    kept = canonical.log.filter(pl.col("file").is_in(entries_from))["rows_kept"].sum()
    assert sum(subset.tracks.height for subset in canonical.subsets) == kept
    assert sum(subset.vehicles["entries"].sum() for subset in canonical.subsets) == kept
    assert canonical.rejects.filter(pl.struct("file", "line").is_duplicated()).is_empty()


def physical_lines(data):
    """Line number -> text, the obvious way: split at newlines, one trailing carriage return cut, no BOM."""
    lines = data.removeprefix(b"\xef\xbb\xbf").split(b"\n")
    if lines[-1] == b"":
        lines.pop()
    return {
        number: line.removesuffix(b"\r").decode("utf-8", errors="replace") for number, line in enumerate(lines, start=1)
    }
