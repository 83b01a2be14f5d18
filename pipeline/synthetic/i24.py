"""A JSON list of trajectories in the format of I-24 MOTION.

Lane 1 lies between 12 and 24 ft, as in the publishers' tools. Trajectories begin at any fraction of a frame. Every
other one has arrays of sizes.
"""

import json
import math
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.scenarios import CLEAN, I24, Job, Road, Traffic
from tracklake.pipeline.synthetic.truth import FileCount
from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.raw_i24 import MILE_FT

ROAD = Road(lanes=4, lane_width_m=12 * FOOT_M, window_m=800.0, rate_hz=25.0, limit_mps=31.0)
TRAFFIC = Traffic(0.25, trucks=0.15, plan=CLEAN)
FILE = "i24-inception.json"
START_S = 1_669_118_400
"""Time of frame 0: 22 November 2022, 06:00 in Nashville, in s since 1970."""
RECORDING = "i-24-20221122-0600"
ENTRANCE_FT = {"east": 59 * MILE_FT, "west": 62 * MILE_FT}
"""Places where the window begins, in the direction of travel."""
SIGNS = {"east": 1, "west": -1}
LANE_1_FT = 12.0
SYNTHETIC_ID = "73796e746865746963"
"""Beginning of _id: `synthetic` in hex."""
CLASSES = {1: 6, 2: 0, 3: 4}
"""Coarse classes by the generator's: motorcycle, sedan, semi."""
HEIGHT_FT = 5.0


def list_jobs(minutes: float) -> list[Job]:
    """List the carriageways to simulate."""
    frames = max(1, round(minutes * 60 * ROAD.rate_hz))
    return [
        Job(I24, RECORDING, f"{RECORDING}-{side}", FILE, 210 + number, ROAD, TRAFFIC, frames)
        for number, side in enumerate(SIGNS)
    ]


def write_files(folder: Path, tracks: dict[str, pl.DataFrame]) -> list[FileCount]:
    """Write the list, eastbound first, from noisy tracks by subset, and count its documents."""
    documents: list[dict[str, object]] = []
    for side in SIGNS:
        for (_,), own in (
            tracks[f"{RECORDING}-{side}"].sort("vehicle", "frame").group_by("vehicle", maintain_order=True)
        ):
            documents.append(build_document(own, side, number=len(documents) + 1))
    lines = ",\n".join(json.dumps(document, separators=(",", ":")) for document in documents)
    (folder / FILE).write_text(f"[{lines}]\n", encoding="utf-8")
    return [FileCount(FILE, I24, None, read=len(documents), kept=len(documents))]


def build_document(track: pl.DataFrame, side: str, number: int) -> dict[str, object]:
    """Build the document of one vehicle's track; its frames may be any fraction of a frame late, by its number."""
    sign, late = SIGNS[side], (number % 4) / 4
    x, y, speed, length, width, lateral = (
        track[name].to_numpy() for name in ("x", "y", "speed", "length", "width", "lateral_speed")
    )
    turn = np.where(speed > 2, np.arctan2(lateral, np.maximum(speed, 2)), 0.0)
    times = START_S + (track["frame"].to_numpy() + late) / ROAD.rate_hz
    ahead = x + late / ROAD.rate_hz * speed
    along = ENTRANCE_FT[side] + sign * (ahead - length / 2 - length / 2 * np.cos(turn)) / FOOT_M
    across = LANE_1_FT + (y - length / 2 * np.sin(turn)) / FOOT_M
    sizes = {"length": length[0] / FOOT_M, "width": width[0] / FOOT_M, "height": HEIGHT_FT}
    several = {name: [value - 0.25, value, value + 0.5] for name, value in sizes.items()}
    oid = f"{SYNTHETIC_ID}{number:06x}"
    return {
        "_id": {"$oid": oid},
        "timestamp": [round(value, 7) for value in times.tolist()],
        "x_position": [round(value, 4) for value in along.tolist()],
        "y_position": [round(value, 4) for value in across.tolist()],
        "road_segment_ids": [-1],
        "flags": ["Lost"],
        **(several if number % 2 else sizes),
        "merged_ids": [[{"$oid": oid}]],
        "fragment_ids": [{"$oid": oid}],
        "coarse_vehicle_class": CLASSES[int(track["v_class"][0])],
        "fine_vehicle_class": -1,
        "direction": sign,
        "compute_node_id": "videonode1",
        "local_fragment_id": [[number]],
        "starting_x": round(float(along[0]), 4),
        "first_timestamp": round(float(times[0]), 7),
        "configuration_id": -1,
        "ending_x": round(float(along[-1]), 4),
        "last_timestamp": round(float(times[-1]), 7),
        "x_score": math.nan if number % 50 == 0 else 1.0,
        "y_score": 0.5,
    }
