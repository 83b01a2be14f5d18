"""Small highD recordings that go through the whole pipeline in a second or two, and what is counted in them."""

import shutil
from pathlib import Path

from highd_files import META_HEADER, TRACKS_HEADER, VEHICLES_HEADER, meta_row, track_row
from manifests import edit_manifest

from tracklake.pipeline.lake.session_end import record_end

VEHICLES = 8
"""Vehicles on each of the two carriageways."""
FRAMES = 150
"""Frames of each vehicle: 6 s, from one end of the road."""
ENTRIES = 2 * VEHICLES * FRAMES
KINDS = ("recordingMeta", "tracksMeta", "tracks")


def write_highd(folder: Path, number: str, *, speed_mps: float = 30.0) -> list[Path]:
    """The three files of one recording: no one late, no one near anybody, no one changing lanes."""
    vehicles, tracks = [], []
    for vehicle in range(1, 2 * VEHICLES + 1):
        upper = vehicle <= VEHICLES
        first = 1 + 40 * ((vehicle - 1) % VEHICLES)
        last, direction = first + FRAMES - 1, 1 if upper else 2
        vehicles.append(f"{vehicle},4,2,{first},{last},{FRAMES},Car,{direction},180.00,30,30,30,-1.00,-1.00,-1.00,0")
        for frame in range(first, last + 1):
            driven = speed_mps * (frame - first) / 25
            x, y, lane, velocity = (400 - driven, 9, 2, -speed_mps) if upper else (driven, 25, 6, speed_mps)
            tracks.append(track_row(frame, vehicle, (f"{x:.2f}", y, 4, 2), (f"{velocity:.2f}", "0.00"), lane))
    folder.mkdir(parents=True, exist_ok=True)
    meta = meta_row(int(number), duration="20.00", vehicles=2 * VEHICLES).replace(",3,1,", f",{2 * VEHICLES},0,")
    paths = []
    headers = (META_HEADER, VEHICLES_HEADER, TRACKS_HEADER)
    for kind, header, rows in zip(KINDS, headers, ([meta], vehicles, tracks), strict=True):
        paths.append(folder / f"{number}_{kind}.csv")
        paths[-1].write_text("\n".join([header, *rows]) + "\n")
    return paths


def copy_lake(made: Path, folder: Path, name: str) -> tuple[Path, Path]:
    """Copy raw/ and the lake made of it into another folder, as if the lake had been made there."""
    raw = shutil.copytree(made / "raw", folder / "raw")
    root = shutil.copytree(made / name, folder / name)
    edit_manifest(root, lambda text: text.replace(str(made / "raw"), str(raw)))
    record_end(root)
    return raw, root
