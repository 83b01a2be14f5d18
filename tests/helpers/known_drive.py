"""A drive of 6 s with numbers that can be worked out by hand, as frames by table, and a lake that holds it.

The ego drives east on the equator at 20 m/s. In its frame (x ahead, y right), with k the tick:

- vehicle 1 keeps 30 m ahead in the same lane; its messages say 1 m too far right, arrive after 0.04 s, and those of
  ticks 20 to 29 are lost. LiDAR sees it from tick 10 on, the camera at every other one of these ticks.
- vehicle 2 is 3.5 m to the left and overtakes from 10 m behind with 5 m/s more; its messages say 1 m too far ahead and
  arrive after 0.05 s, that of tick 10 after 0.25 s. It has another temporary id from tick 40 on.
- vehicle 1,000,000 never sends; LiDAR sees it at ticks 20 to 40, 15 m ahead, 3.5 m to the right.

What the ego knows is the truth 0.2 m too far ahead where LiDAR sees the vehicle, else what the last message said.
"""

from datetime import datetime
from pathlib import Path

import numpy as np
import polars as pl
from drive_rows import USUAL
from small_lake import put

from tracklake.pipeline.lake import Commit, open_for_writing
from tracklake.quality_reports.rules.drive_findings import TICK_COLUMNS, Drive, judge_drive
from tracklake.schemas import (
    BSM,
    DRIVE_CHECKS,
    DRIVE_FINDINGS,
    DRIVES,
    EGO_STATES,
    STATIONS,
    SURROUNDING,
    SURROUNDING_TRUTH,
    Table,
)

M_PER_DEG_EAST, M_PER_DEG_NORTH = 111_319.490_793, 110_574.275_822
"""Metres per degree at latitude 0 and longitude 0, on WGS-84."""
TICKS = 60
WAYS = {1: (30.0, 0.0, 0.0), 2: (-10.0, 0.5, -3.5), 1_000_000: (15.0, 0.0, 3.5)}
"""Ways of the vehicles by id: m ahead of the ego at tick 0, m more per tick, and m to its right."""
SENT_TOO_FAR = {1: (0.0, 1.0), 2: (1.0, 0.0)}
"""Constant errors of the messages by station: m ahead and m to the right."""
LOST = range(20, 30)


def _fill(table: Table, rows: pl.DataFrame | list[dict], place: dict[str, str]) -> pl.DataFrame:
    frame = rows if isinstance(rows, pl.DataFrame) else pl.DataFrame(rows, infer_schema_length=None)
    usual = {**USUAL.get(table.name, {}), **place}
    return frame.select(
        (pl.col(name) if name in frame.columns else pl.lit(usual.get(name))).cast(dtype).alias(name)
        for name, dtype in table.dtypes.items()
    ).sort(table.key)


def _locate(vehicle: int, tick: int) -> tuple[float, float]:
    ahead, more, right = WAYS[vehicle]
    return ahead + more * tick, right


def _send(vehicle: int) -> list[dict]:
    """The messages of a station that were received, or the ego's own."""
    rows = []
    for tick in range(TICKS):
        if vehicle == 1 and tick in LOST:
            continue
        x, y = (0.0, 0.0)
        if vehicle:
            x, y = np.add(_locate(vehicle, tick), SENT_TOO_FAR[vehicle])
        late = {0: None, 1: 0.04, 2: 0.25 if tick == 10 else 0.05}[vehicle]
        rows.append(
            {
                "vehicle_id": vehicle, "own": vehicle == 0, "time_s": tick / 10, "message_count": (tick + 7) % 128,
                "received_s": None if late is None else tick / 10 + late,
                "temporary_id": f"{vehicle + 16 * (vehicle == 2 and tick >= 40):08X}",
                "lost_before": len(LOST) if vehicle == 1 and tick == LOST[-1] + 1 else 0,
                "lat_deg": -y / M_PER_DEG_NORTH, "lon_deg": (x + 2.0 * tick) / M_PER_DEG_EAST,
                "speed_mps": 25.0 if vehicle == 2 else 20.0, "heading_deg": 90.0, "length_m": 4.5, "width_m": 1.8,
            }
        )  # fmt: skip
    return rows


def _see(vehicle: int) -> list[dict]:
    """What the ego knows of a vehicle at each tick."""
    rows = []
    for tick in range(1, TICKS):
        by_lidar = (vehicle == 1 and tick >= 10) or (vehicle > 2 and 20 <= tick <= 40)
        if vehicle > 2 and not by_lidar:
            continue
        x, y = _locate(vehicle, tick)
        error = (0.2, 0.0) if by_lidar else SENT_TOO_FAR[vehicle]
        at = dict(zip(("rel_x_m", "rel_y_m"), (x + error[0], y + error[1]), strict=True))
        heard = vehicle <= 2 and not (vehicle == 1 and tick - 1 in LOST)
        age = None if vehicle > 2 else 0.1 * (1 + (tick - LOST[0] if vehicle == 1 and tick - 1 in LOST else 0))
        rows.append(
            {
                "vehicle_id": vehicle, "tick": tick, **at, "box_x_m": at["rel_x_m"], "box_y_m": at["rel_y_m"],
                "smoothed_x_m": x + error[0] / 2, "smoothed_y_m": y + error[1] / 2, "since_message_s": age,
                "from_v2v": heard, "from_lidar": by_lidar, "from_camera": vehicle == 1 and by_lidar and tick % 2 == 0,
                "speed_mps": 20.0 + 10 * WAYS[vehicle][1], "rel_speed_x_mps": 10 * WAYS[vehicle][1],
                "cov_xx_m2": 0.04 if by_lidar else 1.0, "cov_yy_m2": 0.04 if by_lidar else 1.0,
            }
        )  # fmt: skip
    return rows


def _tell_truth(vehicle: int) -> list[dict]:
    rows = []
    for tick in range(TICKS):
        x, y = _locate(vehicle, tick)
        rows.append(
            {
                "truth_id": min(vehicle, 3) + 10, "tick": tick, "truth_dataset": "highd", "truth_subset": "02-lower",
                "vehicle_id": vehicle if vehicle <= 2 else None, "connected": vehicle <= 2, "rel_x_m": x, "rel_y_m": y,
                "rel_heading_deg": 0.0, "speed_mps": 20.0 + 10 * WAYS[vehicle][1], "accel_mps2": 0.0,
                "ego_speed_mps": 20.0, "ego_yaw_deg": 0.0, "ego_x_m": 100.0 + 2 * tick, "ego_y_m": 5.5,
                "length_m": 4.5, "width_m": 1.8,
            }
        )  # fmt: skip
    return rows


def make_drive(subset: str = "drive-1", dataset: str = "v2v") -> dict[Table, pl.DataFrame]:
    """Return the drive's rows by table."""
    place = {"dataset": dataset, "subset": subset}
    states = [
        {"time_s": tick / 10, "lon_deg": 2.0 * tick / M_PER_DEG_EAST, "speed_mps": 20.0, "heading_deg": 90.0}
        for tick in range(TICKS)
    ]
    usual = {
        **{"length_m": 4.5, "width_m": 1.8, "first_s": 0.0, "last_s": 5.9, "messages": 60, "own": False},
        **dict.fromkeys(("duplicates", "invalid", "clock_steps", "id_changes", "lost"), 0),
    }
    changed = {"temporary_ids": ["00000002", "00000012"], "id_changes": 1, "clock_steps": 1}
    lossy = {"temporary_ids": ["00000001"], "messages": 50, "lost": 10, "duplicates": 3}
    stations = [
        {**usual, "vehicle_id": 0, "own": True, "temporary_ids": ["00000000"]},
        {**usual, "vehicle_id": 1, "latency_median_s": 0.04, **lossy},
        {**usual, "vehicle_id": 2, "latency_median_s": 0.05, **changed},
    ]
    drive = {
        "recording": subset, "origin": "synthetic", "start_utc": datetime(2026, 1, 1, 12), "seconds": 5.9, "ego_id": 0,
        "ego_length_m": 4.5, "ego_width_m": 1.8, "stations": 3, "messages": 170, "scans": 50, "images": 25,
        "source_files": [{"file": f"{subset}.csv", "sha256": "00"}],
    }  # fmt: skip
    tables = {
        DRIVES: _fill(DRIVES, [drive], place),
        STATIONS: _fill(STATIONS, stations, place),
        BSM: _fill(BSM, [row for vehicle in (0, 1, 2) for row in _send(vehicle)], place),
        EGO_STATES: _fill(EGO_STATES, states, place),
        SURROUNDING: _fill(SURROUNDING, [row for vehicle in WAYS for row in _see(vehicle)], place),
        SURROUNDING_TRUTH: _fill(SURROUNDING_TRUTH, [row for vehicle in WAYS for row in _tell_truth(vehicle)], place),
    }
    judged = judge_drive(Drive(tables[BSM], tables[SURROUNDING].select(TICK_COLUMNS), tables[EGO_STATES]))
    return tables | dict(zip((DRIVE_FINDINGS, DRIVE_CHECKS), judged, strict=True))


def put_drive(root: Path, tables: dict[Table, pl.DataFrame]) -> None:
    """Write a drive's tables into a lake, as one commit."""
    place = tables[DRIVES].select("dataset", "subset").row(0, named=True)
    key = f"ingest/{place['dataset']}/{place['subset']}"
    with open_for_writing(root) as writer:
        made = [put(root, key, 1, frame, table, **place) for table, frame in tables.items()]
        files = {name: own for commit in made for name, own in commit.files.items()}
        writer.commit(
            Commit(key, made[0].fingerprint, files, info={**place, "subsets": [], "drives": [place["subset"]]})
        )
