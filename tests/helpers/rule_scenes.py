"""Scenes for the rules, made of entries as the slow loop that judges the sample knows them."""

from dataclasses import replace

import polars as pl

from tracklake.pipeline.synthetic.scenery import Entry, Key, Scenery, Surface
from tracklake.quality_reports.rules.evaluate import tracks_needed
from tracklake.quality_reports.rules.rule import Case
from tracklake.quality_reports.rules.scene import VEHICLE_COLUMNS, Scene
from tracklake.schemas import TRACKS, VEHICLES

TRACK_COLUMNS = tracks_needed()


ANY_SURFACE = Surface()


def scene_of(entries: dict[Key, Entry], surface: Surface = ANY_SURFACE) -> Scene:
    """A scene as ingestion would leave it: gaps and 10 Hz speeds computed from positions, one entry at a time."""
    slow = Scenery(entries, surface)
    rows = []
    for vehicle, frame in sorted(entries):
        entry = entries[vehicle, frame]
        rows.append(
            {
                "dataset": "highd",
                "subset": "01-upper",
                "vehicle_id": vehicle,
                "frame": frame,
                "x_m": entry.front,
                "y_m": entry.y,
                "heading_rad": entry.heading,
                "lane": entry.lane,
                "speed_mps": entry.speed,
                "accel_mps2": entry.accel,
                "speed_10hz_mps": speed_10hz(slow, (vehicle, frame)),
                "accel_10hz_mps2": entry.accel,
                "lateral_speed_mps": slow.lateral_speed((vehicle, frame)),
                "leader_id": entry.leader or None,
                "gap_m": slow.gap((vehicle, frame)),
                "headway_recorded_m": entry.headway if entry.leader else None,
            }
        )
    tracks = pl.DataFrame(rows, schema={name: TRACKS.dtypes[name] for name in TRACK_COLUMNS})
    sizes = {vehicle: entry for (vehicle, _), entry in entries.items()}
    vehicles = pl.DataFrame(
        {
            "vehicle_id": list(sizes),
            "length_m": [entry.length for entry in sizes.values()],
            "width_m": [entry.width for entry in sizes.values()],
            "class": [entry.kind for entry in sizes.values()],
            "length_range_m": [slow.size_range(vehicle, 0) for vehicle in sizes],
            "width_range_m": [slow.size_range(vehicle, 1) for vehicle in sizes],
        },
        schema={name: VEHICLES.dtypes[name] for name in ("vehicle_id", *VEHICLE_COLUMNS)},
    ).sort("vehicle_id")
    road = (surface.lanes, surface.ramps, slow.first_frame, slow.last_frame)
    return Scene(tracks, vehicles, surface.rate_hz, surface.markings or None, *road)


def speed_10hz(slow: Scenery, key: Key) -> float | None:
    """Speed from the positions 0.1 s before and after; at 25 Hz those lie midway between two frames."""
    steps = (1,) if slow.surface.rate_hz == 10 else (2, 3)
    if any(slow.near(key, step) is None for step in range(-steps[-1], steps[-1] + 1)):
        return None
    ahead = sum(slow.entries[key[0], key[1] + step].front for step in steps) / len(steps)
    behind = sum(slow.entries[key[0], key[1] - step].front for step in steps) / len(steps)
    return (ahead - behind) / 0.2


def driver(
    vehicle: int, frames: range, *, x: float, speed: float = 20.0, rate: float = 10.0, **other
) -> dict[Key, Entry]:
    """A car 5 m long and 2 m wide, at x in the first of the frames, at constant speed, in the middle of lane 1."""
    usual = {"length": 5.0, "width": 2.0, "accel": 0.5, "leader": 0, "headway": None, "y": 2.0, "lane": 1}
    entry = Entry(front=0.0, speed=speed, **{**usual, **other})
    return {
        (vehicle, frame): replace(entry, front=round(x + speed / rate * step, 3)) for step, frame in enumerate(frames)
    }


def change(entries: dict[Key, Entry], vehicle: int, frames, **values) -> None:
    """Put other values into entries of a vehicle; `ahead` moves it along the road."""
    ahead = values.pop("ahead", 0.0)
    for frame in frames:
        entry = entries[vehicle, frame]
        entries[vehicle, frame] = replace(entry, front=round(entry.front + ahead, 3), **values)


def entries_found(findings: pl.DataFrame) -> dict[str, list[Key]]:
    """Per rule the (vehicle, frame) of its findings' entries, sorted."""
    found: dict[str, list[Key]] = {}
    for rule, vehicle, first, last, entries in findings.select(
        "rule", "vehicle_id", "first_frame", "last_frame", "entries"
    ).iter_rows():
        frames = list(range(first, last + 1))
        assert len(frames) == entries
        found.setdefault(rule, []).extend((vehicle, frame) for frame in frames)
    return {rule: sorted(keys) for rule, keys in found.items()}


def lay_out(case: Case) -> Scene:
    """The subset that a case describes, with what it leaves out."""
    height = len(next(iter(case.entries.values())))
    usual = {
        "dataset": ["highd"] * height, "subset": ["01-upper"] * height, "vehicle_id": list(range(1, height + 1)),
        "frame": [1] * height, "x_m": [0.0] * height, "y_m": [0.0] * height, "lane": [1] * height,
        "speed_mps": [20.0] * height, "accel_mps2": [0.0] * height, "length_m": [4.0] * height,
        "width_m": [2.0] * height, "class": ["car"] * height, "length_range_m": [None] * height,
        "width_range_m": [None] * height,
    }  # fmt: skip
    said = usual | {name: list(values) for name, values in case.entries.items()}
    tracks = {name: said.get(name, [None] * height) for name in tracks_needed()}
    vehicles = {name: said[name] for name in ("vehicle_id", *VEHICLE_COLUMNS)}
    return Scene(
        pl.DataFrame(tracks, schema={name: TRACKS.dtypes[name] for name in tracks}),
        pl.DataFrame(vehicles, schema={name: VEHICLES.dtypes[name] for name in vehicles})
        .unique("vehicle_id")
        .sort("vehicle_id"),
        case.frame_rate_hz,
        case.lane_markings_m,
        case.lanes,
        first_frame=1,
        last_frame=case.last_frame,
    )
