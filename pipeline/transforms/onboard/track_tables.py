"""What the tracker logs at each tick, and the tables that are made of it, smoothed values among them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.onboard.ego import STEP_S, EgoTrack
from tracklake.pipeline.transforms.onboard.kalman import (
    ACCELERATION,
    ODOMETRY_M,
    ODOMETRY_RAD,
    POSITION,
    VELOCITY,
    compute_smoother_gains,
    make_noise,
    make_transition,
    smooth,
)
from tracklake.pipeline.transforms.onboard.tracks import SLOW_MPS, TENTATIVE, Tracks, make_no_tracks, turn
from tracklake.schemas import ASSOCIATION, LIDAR_CLUSTERS, SURROUNDING, Table
from tracklake.schemas.arrays import Floats, Integers
from tracklake.schemas.drives import TICK_RATE_HZ
from tracklake.schemas.perception import SIDES

USUAL_SIZE_M = (4.6, 1.9, 1.5)
"""Length, width and height of a vehicle of which they are not known, in m."""
SLICE_ROWS = 20_000
"""Rows whose smoother gains are computed at once."""
KEY = ("tick", "chain")
"""Columns that name a row of the log."""


@dataclass
class TickLog:
    """The vehicles of one tick, and the clusters and camera boxes assigned to them, by number of the chain."""

    tick: int
    tracks: Tracks = field(default_factory=make_no_tracks)
    clusters: dict[str, Any] = field(default_factory=dict)
    boxes: dict[str, Any] = field(default_factory=dict)

    def note_clusters(self, chain: Integers, association: Mapping[str, Any]) -> None:
        """Note the clusters assigned to chains, with the columns of ASSOCIATION."""
        sides = np.asarray(SIDES)[association["side"]]
        self.clusters = {"chain": chain, **association, "side": sides}

    def note_boxes(self, chain: Integers, detection: Integers) -> None:
        """Note the camera boxes assigned to chains."""
        self.boxes = {"chain": chain, "detection": detection}

    def finish(self, tracks: Tracks) -> None:
        """Note the tick's final tracks, those that are confirmed."""
        self.tracks = tracks.select(np.flatnonzero(tracks.vehicle_id != TENTATIVE))
        self.tracks.covariance = self.tracks.covariance.astype(np.float32)


def write_tables(
    logs: Sequence[TickLog], clusters: Sequence[tuple[int, Mapping[str, Any]]], ego: EgoTrack
) -> dict[Table, pl.DataFrame]:
    """Make LIDAR_CLUSTERS, ASSOCIATION and SURROUNDING of the log, without the columns of the place."""
    written = [(log.tick, log.tracks) for log in logs if len(log.tracks.chain)]
    tick = np.repeat([tick for tick, _ in written], [len(tracks.chain) for _, tracks in written]).astype(np.int64)
    tracks = Tracks.concatenate([tracks for _, tracks in written]) if written else make_no_tracks()
    keys = pl.DataFrame({"tick": tick, "chain": tracks.chain, "vehicle_id": tracks.vehicle_id})
    given = (
        keys.join(_gather([(log.tick, log.clusters) for log in logs], CLUSTER_COLUMNS), on=KEY, how="left")
        .join(_gather([(log.tick, log.boxes) for log in logs], BOX_COLUMNS), on=KEY, how="left")
        .sort(KEY)
    )
    association = given.filter(pl.any_horizontal(pl.col("cluster", "detection").is_not_null()))
    association = association.with_columns(
        pl.col("candidates").fill_null(0), pl.col("distance_m", "gate").fill_nan(None)
    )
    values = describe_tracks(tracks, tick, ego) | {
        "from_lidar": given["cluster"].is_not_null(),
        "from_camera": given["detection"].is_not_null(),
    }
    surrounding = pl.DataFrame(values, nan_to_null=True)
    seen = _gather(
        list(clusters), {name: one for name, one in LIDAR_CLUSTERS.dtypes.items() if name not in PLACE_AND_TICK}
    )
    return {
        LIDAR_CLUSTERS: _conform(LIDAR_CLUSTERS, seen),
        ASSOCIATION: _conform(ASSOCIATION, association),
        SURROUNDING: _conform(SURROUNDING, surrounding),
    }


PLACE_AND_TICK = ("dataset", "subset", "tick")
"""Columns of LIDAR_CLUSTERS that a scan's clusters do not have."""
BOX_COLUMNS: dict[str, Any] = {"chain": pl.Int64, "detection": pl.Int32}
"""Columns of the boxes in the log."""
CLUSTER_COLUMNS: dict[str, Any] = {
    "chain": pl.Int64,
    **{name: ASSOCIATION.dtypes[name] for name in ("cluster", "side", "distance_m", "gate", "candidates")},
}
"""Columns of the assigned clusters in the log."""


def _gather(noted: Sequence[tuple[int, Mapping[str, Any]]], columns: Mapping[str, Any]) -> pl.DataFrame:
    """Return what was noted at each tick in one frame, with the tick before the columns."""
    schema = {"tick": pl.Int64, **columns}
    full = [(tick, values) for tick, values in noted if values and len(values[next(iter(columns))])]
    if not full:
        return pl.DataFrame(schema=schema)
    ticks = np.repeat([tick for tick, _ in full], [len(values[next(iter(columns))]) for _, values in full])
    parts = {name: np.concatenate([np.asarray(values[name]) for _, values in full]) for name in columns}
    return pl.DataFrame({"tick": ticks, **parts}).select(pl.col(name).cast(dtype) for name, dtype in schema.items())


def _conform(table: Table, frame: pl.DataFrame) -> pl.DataFrame:
    """Return a frame with the table's dtypes and order, but for the columns of the place."""
    dtypes = {name: dtype for name, dtype in table.dtypes.items() if name not in PLACE_AND_TICK[:2]}
    return frame.select(pl.col(name).cast(dtype) for name, dtype in dtypes.items()).sort(table.key)


def describe_tracks(tracks: Tracks, tick: Integers, ego: EgoTrack) -> dict[str, Any]:
    """Return columns of SURROUNDING for the tracks of all ticks, sorted by tick and chain."""
    yaw, ego_m = ego.odometry_rad[tick], ego.odometry_m[tick]
    later = smooth_tracks(tracks, tick, ego)
    place_m = turn(tracks.state[:, POSITION] - ego_m, -yaw)
    smoothed_m = turn(later[:, POSITION] - ego_m, -yaw)
    relative = turn(tracks.state[:, VELOCITY], -yaw) - np.stack((ego.speed_mps[tick], np.zeros(len(tick))), 1)
    along = np.stack((np.cos(tracks.heading_rad), np.sin(tracks.heading_rad)), 1)
    speed, smoothed_speed = np.hypot(*tracks.state[:, VELOCITY].T), np.hypot(*later[:, VELOCITY].T)
    moves = (smoothed_speed >= SLOW_MPS)[:, None]
    smoothed_along = np.where(moves, later[:, VELOCITY] / np.maximum(smoothed_speed, SLOW_MPS)[:, None], along)
    heading = np.degrees(np.mod(tracks.heading_rad - yaw + np.pi, 2 * np.pi) - np.pi)
    sine, cosine = np.sin(-yaw), np.cos(-yaw)
    matrix = np.stack((np.stack((cosine, -sine), -1), np.stack((sine, cosine), -1)), -2)
    covariance = matrix @ tracks.covariance[:, POSITION, POSITION] @ np.swapaxes(matrix, 1, 2)
    length_m, width_m, height_m = np.where(np.isnan(tracks.size_m), USUAL_SIZE_M, tracks.size_m).T
    return {
        "vehicle_id": tracks.vehicle_id,
        "tick": tick,
        "rel_x_m": place_m[:, 0],
        "rel_y_m": place_m[:, 1],
        "rel_speed_x_mps": relative[:, 0],
        "rel_speed_y_mps": relative[:, 1],
        "speed_mps": speed,
        "accel_mps2": np.einsum("vi,vi->v", tracks.state[:, ACCELERATION], along),
        "rel_heading_deg": heading,
        "steering_angle_deg": tracks.steering_angle_deg,
        "box_x_m": place_m[:, 0],
        "box_y_m": place_m[:, 1],
        "box_z_m": height_m / 2,
        "box_length_m": length_m,
        "box_width_m": width_m,
        "box_height_m": height_m,
        "from_v2v": tracks.heard == tick,
        "since_message_s": np.maximum(tick / TICK_RATE_HZ - tracks.message_s, 0.0),
        "cov_xx_m2": np.maximum(covariance[:, 0, 0], 0.0),
        "cov_xy_m2": covariance[:, 0, 1],
        "cov_yy_m2": np.maximum(covariance[:, 1, 1], 0.0),
        "smoothed_x_m": smoothed_m[:, 0],
        "smoothed_y_m": smoothed_m[:, 1],
        "smoothed_speed_mps": smoothed_speed,
        "smoothed_accel_mps2": np.einsum("vi,vi->v", later[:, ACCELERATION], smoothed_along),
    }


def smooth_tracks(tracks: Tracks, tick: Integers, ego: EgoTrack) -> Floats:
    """Return the smoothed states of the tracks of all ticks."""
    transition = make_transition(STEP_S)
    after = np.minimum(tick + 1, len(ego.known) - 1)
    range_m = np.hypot(*(tracks.state[:, POSITION] - ego.odometry_m[after]).T)
    odometry_m = np.hypot(ODOMETRY_M, ODOMETRY_RAD * range_m)
    gains = np.empty_like(tracks.covariance)
    for first in range(0, len(tick), SLICE_ROWS):
        part = slice(first, first + SLICE_ROWS)
        noise = make_noise(STEP_S, tracks.offset_m[part], odometry_m[part])
        gains[part] = compute_smoother_gains(tracks.covariance[part].astype(np.float64), transition, noise)
    return smooth(tracks.state, gains, transition, tick, tracks.chain)
