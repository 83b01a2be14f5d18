"""Packs raw files in archives and reads whatever a folder holds, as ingestion does."""

import gzip
import zipfile
from pathlib import Path

import polars as pl
from highd_files import write_recording
from raw_texts import EXPORT_NAMES, FIRST_RELEASE_NAMES, TEXT_NAMES, as_csv, as_text, ngsim_row, write

from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.sources.csv import hash_raw
from tracklake.pipeline.sources.source import Part

KINDS = ("recordingMeta", "tracksMeta", "tracks")
ROWS = [ngsim_row(5, frame) for frame in range(1, 4)] + [ngsim_row(6, 2, Lane_ID=3)]
FIRST_NAMES = dict(zip(FIRST_RELEASE_NAMES, EXPORT_NAMES[:-1], strict=True))
NGSIM_FILES = {
    "text": as_text(ROWS),
    "export": as_csv(ROWS, bom=True, end="\r\n"),
    "bare": as_csv(ROWS, TEXT_NAMES, header=()),
    "named": as_csv(ROWS, TEXT_NAMES),
    "first": as_csv([{name: row[known] for name, known in FIRST_NAMES.items()} for row in ROWS], FIRST_RELEASE_NAMES),
}


def pack(path, members, *, method=zipfile.ZIP_DEFLATED):
    """An archive of {name: bytes}, or of pairs where a name comes twice."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items() if isinstance(members, dict) else members:
            archive.writestr(name, data)
    return path


def find(source):
    return discover(source, dataset=None, digest=hash_raw)


def names(discovery):
    return [[file.name for file in unit.files] for _, unit in discovery.units]


def read(source, folder):
    """{recording: Canonical} of everything that a file or folder holds, and what was discovered."""
    discovery = find(source)
    parts = {}
    for number, (dataset, unit) in enumerate(discovery.units):
        if unit.recording is not None:
            parts[dataset, unit.recording] = [Part(file) for file in unit.files]
            continue
        (file,) = unit.files
        target = Path(folder) / f"spilled-{number}"
        spilled = dataset.spill(file, target)
        for recording in spilled.recordings:
            rows = pl.scan_ipc(target / recording / "*.arrow")
            rejects = spilled.rejects if len(spilled.recordings) == 1 else None
            parts.setdefault((dataset, recording), []).append(Part(file, rows, rejects))
    return {name: dataset.to_canonical(shares, name) for (dataset, name), shares in parts.items()}, discovery


def tables(found):
    """Everything that was made of the rows, as plain values: all but what names the files."""
    return {
        recording: [
            *(
                (subset.name, subset.tracks.rows(), subset.vehicles.rows(), subset.facts.drop("source_files").rows())
                for subset in canonical.subsets
            ),
            canonical.log.drop("file", "sha256").sort("dialect").rows(),
            canonical.rejects.drop("file").rows(),
        ]
        for recording, canonical in found.items()
    }


def highd_bytes(folder, number="01"):
    """{name: bytes} of a recording with a malformed and a repeated row."""
    paths = write_recording(folder / "made", number=number)
    lines = paths[2].read_bytes().splitlines(keepends=True)
    paths[2].write_bytes(b"".join([*lines, lines[1], b"1,2\n"]))
    return {path.name: path.read_bytes() for path in paths}


def spread(folder, packing, files, inner):
    """Put files into a folder in one of several ways."""
    top = dict(files.items())
    packed = {f"{name}.gz": gzip.compress(data) for name, data in files.items()}
    below = {f"{inner}{name}": data for name, data in files.items()}
    if packing == "plain":
        for name, data in top.items():
            write(folder / "data" / name, data)
    elif packing == "gzip":
        for name, data in packed.items():
            write(folder / name, data)
    elif packing == "an archive each":
        for name, data in below.items():
            pack(folder / f"{Path(name).name}.zip", {name: data})
    elif packing == "one archive":
        pack(folder / "all.zip", below)
    elif packing == "stored":
        pack(folder / "sub" / "all.zip", below, method=zipfile.ZIP_STORED)
    elif packing == "gzip in zip":
        pack(folder / "all.zip", {f"{inner}{name}": data for name, data in packed.items()})
    elif packing == "mixed":
        (first, data), *rest = top.items()
        write(folder / f"{first}.gz", gzip.compress(data))
        for name, data in rest[:1]:
            write(folder / name, data)
        pack(folder / "rest.zip", {f"{inner}{name}": data for name, data in rest[1:]})
    return folder
