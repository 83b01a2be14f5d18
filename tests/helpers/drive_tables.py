"""Tables of drives on a straight road: an ego at constant speed, and vehicles that accelerate and change lanes."""

import numpy as np
import polars as pl

from tracklake.schemas.drives import DRIVES
from tracklake.schemas.perception import FIRST_LIDAR_ID, SURROUNDING, SURROUNDING_TRUTH

LANE_M = 3.6576
EGO_MPS = 25.0


def move(ticks, *, speed=25.0, accel=0.0, x_m=30.0, lane=2, to=None, at_s=3.0):
    """Relative x and y, speed, relative heading and lane of a vehicle, each (ticks,); a lane change takes 4 s."""
    time_s = np.arange(ticks) / 10
    to = lane if to is None else to
    share = np.clip((time_s - at_s) / 4, 0, 1)
    side = LANE_M * (lane - 2 + (to - lane) * (share - np.sin(2 * np.pi * share) / (2 * np.pi)))
    drift = np.gradient(side, 0.1)
    v = speed + accel * time_s
    return {
        "rel_x_m": x_m + (speed - EGO_MPS) * time_s + accel / 2 * time_s**2,
        "rel_y_m": side,
        "speed_mps": v,
        "rel_heading_deg": np.degrees(np.arcsin(np.clip(drift / v, -1, 1))),
        "lane": np.where(share < 0.5, lane, to),
    }


def make_drive(vehicles, *, subset="drive", ticks=120, noise_m=0.0, seed=0, with_truth=True, ids=None, truth_ids=None):
    """The frames `surrounding`, `surrounding_truth` and `drives` of one drive; `vehicles` are keywords of `move`.

    `ids` are the vehicles' ids in the drive (from FIRST_LIDAR_ID on: without messages), `truth_ids` those overhead.
    """
    random = np.random.default_rng(seed)
    perceived, truth = [], []
    for number, keywords in enumerate(vehicles):
        vehicle_id = number if ids is None else ids[number]
        truth_id = 100 + number if truth_ids is None else truth_ids[number]
        own = pl.DataFrame(move(ticks, **keywords)).with_columns(tick=pl.int_range(ticks, dtype=pl.Int32))
        place = {"dataset": pl.lit("v2v"), "subset": pl.lit(subset)}
        accel = float(keywords.get("accel", 0.0))
        seen = own.with_columns(
            pl.col("rel_x_m") + random.normal(0, 1, ticks) * noise_m,
            pl.col("rel_y_m") + random.normal(0, 1, ticks) * noise_m,
        )
        perceived.append(
            seen.with_columns(
                **place,
                vehicle_id=pl.lit(vehicle_id),
                rel_speed_x_mps=pl.col("speed_mps") * pl.col("rel_heading_deg").radians().cos() - EGO_MPS,
                rel_speed_y_mps=pl.col("speed_mps") * pl.col("rel_heading_deg").radians().sin(),
                accel_mps2=pl.lit(accel),
                steering_angle_deg=None,
                box_x_m="rel_x_m",
                box_y_m="rel_y_m",
                box_z_m=pl.lit(0.75),
                box_length_m=pl.lit(4.6),
                box_width_m=pl.lit(1.8),
                box_height_m=pl.lit(1.5),
                from_v2v=pl.lit(True),
                from_lidar=pl.lit(True),
                from_camera=pl.lit(False),
                since_message_s=pl.lit(0.1),
                cov_xx_m2=pl.lit(0.1),
                cov_xy_m2=pl.lit(0.0),
                cov_yy_m2=pl.lit(0.1),
                smoothed_x_m=own["rel_x_m"],
                smoothed_y_m=own["rel_y_m"],
                smoothed_speed_mps="speed_mps",
                smoothed_accel_mps2=pl.lit(accel),
            )
        )
        truth.append(
            own.with_columns(
                **place,
                truth_id=pl.lit(truth_id),
                truth_dataset=pl.lit("highd"),
                truth_subset=pl.lit("01-lower"),
                vehicle_id=pl.lit(None if vehicle_id >= FIRST_LIDAR_ID else vehicle_id, pl.Int32),
                connected=pl.lit(vehicle_id < FIRST_LIDAR_ID),
                accel_mps2=pl.lit(accel),
                ego_speed_mps=pl.lit(EGO_MPS),
                ego_yaw_deg=pl.lit(0.0),
                ego_x_m=EGO_MPS * pl.col("tick") / 10,
                ego_y_m=pl.lit(1.5 * LANE_M),
                ego_lane=pl.lit(2),
                length_m=pl.lit(4.6),
                width_m=pl.lit(1.8),
                visible=None,
            )
        )
    facts = {"dataset": "v2v", "subset": subset, "origin": "synthetic", "ego_length_m": 4.4, "ego_width_m": 1.8}
    drives = pl.DataFrame([facts | {name: None for name in DRIVES.dtypes if name not in facts}], schema=DRIVES.dtypes)
    frames = (to_table(SURROUNDING, perceived), to_table(SURROUNDING_TRUTH, truth if with_truth else []))
    return *frames, drives


def to_table(table, frames):
    if not frames:
        return table.empty()
    return pl.concat(frames).select(pl.col(name).cast(dtype) for name, dtype in table.dtypes.items()).sort(table.key)


def make_traffic(count, *, seed=0, **options):
    """A drive among so many vehicles: a third changes lanes, half of them accelerates."""
    random = np.random.default_rng(seed)
    vehicles = [
        {
            "speed": float(random.uniform(20, 30)),
            "accel": float(random.uniform(0.2, 0.8) * random.choice([-1, 1])),
            "x_m": float(random.uniform(-60, 60)),
            "lane": 2,
            "to": int(random.choice([1, 2, 2, 2, 3])),
            "at_s": float(random.uniform(2, 6)),
        }
        for _ in range(count)
    ]
    return make_drive(vehicles, seed=seed, **options)
