"""Writes recordings of exiD, inD and rounD by hand, with their headers, and reads them as the pipeline does."""

from dataclasses import replace

from raw_texts import raw_file, write

from tracklake.pipeline.sources.exid import EXID
from tracklake.pipeline.sources.levelx_recognition import group
from tracklake.pipeline.sources.source import Part
from tracklake.pipeline.sources.urban import IND, ROUND
from tracklake.schemas.raw_levelx import (
    RAW_EXID_TRACKS_FIELDS,
    RAW_LEVELX_RECORDING_FIELDS,
    RAW_LEVELX_VEHICLES_FIELDS,
    RAW_URBAN_TRACKS_FIELDS,
)

SOURCES = {"exid": EXID, "ind": IND, "round": ROUND}


def join_values(fields, values):
    return ",".join(str(values.get(name, 0)) for name in fields)


def meta_row(number=0, **values):
    return join_values(
        RAW_LEVELX_RECORDING_FIELDS,
        {"recordingId": number, "locationId": 3, "frameRate": 25.0, "weekday": "tuesday", "duration": 900.5,
         "latLocation": 50.9, "lonLocation": 6.9, "xUtmOrigin": 350000.0, "yUtmOrigin": 5640000.0} | values,
    )  # fmt: skip


def vehicle_row(track, frames, kind="car", **values):
    known = {"trackId": track, "finalFrame": frames - 1, "numFrames": frames, "width": 2.0, "length": 4.0}
    return join_values(RAW_LEVELX_VEHICLES_FIELDS, known | {"class": kind} | values)


def track_row(track, frame, place, velocity, heading, *, fields=RAW_EXID_TRACKS_FIELDS, **values):
    """`place` and `velocity` are x and y in the plane."""
    known = {
        "trackId": track, "frame": frame, "trackLifetime": frame, "xCenter": place[0], "yCenter": place[1],
        "xVelocity": velocity[0], "yVelocity": velocity[1], "heading": heading, "width": 2.0, "length": 4.0,
        "leadId": -1, "rearId": -1, "leadDHW": -1, "laneletId": 11, "latLaneCenterOffset": 0, "laneWidth": 3.5,
    }  # fmt: skip
    return join_values(fields, known | values)


def drive(track, start, velocity, heading, frames=50, **values):
    """Rows of a vehicle at constant velocity."""
    return [
        track_row(
            track,
            frame,
            (round(start[0] + velocity[0] * frame / 25, 4), round(start[1] + velocity[1] * frame / 25, 4)),
            velocity,
            heading,
            **values,
        )
        for frame in range(frames)
    ]


def write_recording(folder, vehicles, tracks, *, number="00", meta=None, fields=RAW_EXID_TRACKS_FIELDS):
    """The paths of a recording's three files."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        write(folder / f"{number}_{kind}.csv", ("\n".join([",".join(header), *rows]) + "\n").encode())
        for kind, header, rows in (
            ("recordingMeta", RAW_LEVELX_RECORDING_FIELDS, [meta or meta_row(int(number))]),
            ("tracksMeta", RAW_LEVELX_VEHICLES_FIELDS, vehicles),
            ("tracks", fields, tracks),
        )
    ]


def write_urban(folder, vehicles, tracks, **values):
    return write_recording(folder, vehicles, tracks, fields=RAW_URBAN_TRACKS_FIELDS, **values)


def recognise(paths):
    """Raw files with the dialect that the family of formats recognises."""
    files = (raw_file(path, EXID) for path in paths)
    return [replace(file, is_source=False) for file in files]


def read(paths):
    """The dataset and the canonical form of one recording's files, maps among them."""
    grouping = group(recognise(paths))
    assert not grouping.refusals
    (unit,) = grouping.units
    source = SOURCES[unit.dataset]
    return unit.dataset, source.to_canonical([Part(file) for file in unit.files], unit.recording)
