"""Subsets of a few entries for the table macros, and how each macro is called on one."""

from dataclasses import replace
from pathlib import Path

import polars as pl
from known_drive import make_drive
from small_lake import put

from tracklake.pipeline.lake import open_for_writing
from tracklake.pipeline.lake.catalog import ADDED
from tracklake.schemas import BSM, SUBSETS, SURROUNDING, SURROUNDING_TRUTH, TRACKS, VEHICLES, Table

CALLS = {
    "around_ego": "{subset}, 2.55",
    "clean_tracks": "{subset}",
    "detector_counts": "{subset}, 20, 1",
    "drive_errors": "{subset}",
    "edie_cells": "{subset}, 20, 1",
    "flow_density": "{subset}, 2",
    "lane_changes": "{subset}",
    "leader_follower": "{subset}",
    "message_gaps": "{subset}, 0.15",
    "near": "{subset}, 3, 50, 2, 60",
    "scene": "{subset}, 3",
    "track": "{subset}, 1",
}
EMPTY = {"heading_rad": None, "leader_id": None, "follower_id": None, "gap_m": None, "headway_recorded_m": None}
CLASSES = {1: "car", 2: "truck", 3: "car", 4: "motorcycle"}
LENGTHS = {1: 4.0, 2: 12.0, 3: 5.0, 4: 2.0}


def call(name: str, subset: str = "'a'") -> str:
    return f"{name}({CALLS[name].format(subset=subset)})"


def entry(vehicle: int, frame: int, x: float, lane: int | None, speed: float, **more: object) -> dict[str, object]:
    """At 2 Hz, frames counted from 1."""
    named = {"vehicle_id": vehicle, "frame": frame, "time_s": (frame - 1) / 2, "x_m": x, "lane": lane}
    return {**named, "y_m": 2.0, "speed_mps": speed, **EMPTY, **more}


def put_subset(
    root: Path, entries: list[dict[str, object]], subset: str = "a", dataset: str = "highd", seconds: float = 5.0
) -> None:
    """One subset of 2 Hz with its entries, its vehicles and itself, and a drive of the same name."""
    values = {"dataset": dataset, "subset": subset}

    def fill(table: Table, rows: list[dict[str, object]]) -> pl.DataFrame:
        given = [{name: row.get(name) for name in table.dtypes} | values for row in rows]
        return pl.DataFrame(given, schema=table.dtypes)

    tracks = fill(TRACKS, entries).sort("vehicle_id", "frame")
    vehicles = [
        {
            "vehicle_id": vehicle, "source_vehicle_id": vehicle, "class": CLASSES.get(vehicle, "car"),
            "length_m": LENGTHS.get(vehicle, 4.0), "width_m": 2.0, "first_frame": own["frame"].min(),
            "last_frame": own["frame"].max(), "entries": own.height, "start_x_m": own["x_m"][0],
            "end_x_m": own["x_m"][-1], "start_lane": own["lane"][0], "mean_speed_mps": own["speed_mps"].mean(),
        }
        for (vehicle,), own in tracks.group_by("vehicle_id", maintain_order=True)
    ]  # fmt: skip
    facts = {
        "recording": subset, "site": "1", "origin": "recorded", "direction": "upper",
        "freeway": True, "frame_rate_hz": 2.0, "lanes": 2,
        "seconds": seconds, "first_frame": 1, "last_frame": tracks["frame"].max(), "vehicles": len(vehicles),
        "entries": tracks.height, "ids_split": 0, "on_ramp_lanes": [], "columns_missing": [],
        "source_files": [{"file": "a.csv", "sha256": "00"}],
    }  # fmt: skip
    drive = make_drive(subset, dataset)
    frames = {TRACKS: tracks, VEHICLES: fill(VEHICLES, vehicles), SUBSETS: fill(SUBSETS, [facts])}
    frames |= {table: drive[table] for table in (BSM, SURROUNDING, SURROUNDING_TRUTH)}
    with open_for_writing(root) as writer:
        for table, frame in frames.items():
            commit = put(root, f"{table.name}/{dataset}/{subset}", 1, frame, table, **values)
            writer.commit(replace(commit, info={ADDED: sorted(table.added)}))


PAIRS = [
    # A truck ahead of a faster car, which closes in, is as fast at frame 2, and overlaps it at frame 3.
    entry(2, 1, 62.0, 1, 10.0),
    entry(1, 1, 20.0, 1, 20.0, leader_id=2, gap_m=30.0),
    entry(2, 2, 67.0, 1, 10.0),
    entry(1, 2, 30.0, 1, 10.0, leader_id=2, gap_m=25.0),
    entry(2, 3, 72.0, 1, 10.0),
    entry(1, 3, 61.0, 1, 20.0, leader_id=2, gap_m=-1.0),
    # Its leader has no entry at this frame.
    entry(1, 4, 71.0, 1, 20.0, leader_id=2, gap_m=5.0),
    # Stands, then rolls back, behind the car.
    entry(3, 1, 10.0, 1, 0.0, leader_id=1, gap_m=6.0),
    entry(3, 2, 9.0, 1, -2.0, leader_id=1, gap_m=17.0),
]


CHANGES = [entry(4, 6, 100.0, 1, 9.0), entry(4, 7, 104.5, 2, 9.0)]
