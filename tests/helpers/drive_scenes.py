"""Drives made by hand: vehicles on a road of constant curvature, GPS with slow and random errors, a simple LiDAR."""

from dataclasses import dataclass, field

import numpy as np
import polars as pl
import pymap3d

from tracklake.pipeline.lake import Commit, open_for_writing, write_table
from tracklake.pipeline.transforms.onboard.measurements import LidarMeasurement, Measured
from tracklake.schemas import BSM, DRIVES, EGO_STATES

ORIGIN = (42.28, -83.74, 250.0)
LIDAR_M = 0.1


@dataclass
class Scene:
    """Truth at (T,) ticks of V vehicles, the ego first: places in the plane of ORIGIN and headings from north."""

    east_m: np.ndarray
    north_m: np.ndarray
    heading_rad: np.ndarray
    speed_mps: np.ndarray
    rng: np.random.Generator
    gps_m: float = 1.5
    gps_time_s: float = 60.0
    random_m: float = 0.3
    heading_error_deg: float = 1.0
    hidden: dict[int, slice] = field(default_factory=dict)
    """Ticks at which LiDAR does not see a vehicle."""

    @property
    def ticks(self):
        return self.east_m.shape[1]

    def place(self):
        """True (V, T, 2) places in the ego's frame."""
        east, north = self.east_m - self.east_m[0], self.north_m - self.north_m[0]
        sine, cosine = np.sin(self.heading_rad[0]), np.cos(self.heading_rad[0])
        return np.stack((east * sine + north * cosine, east * cosine - north * sine), -1)

    def draw_gps(self):
        """Gauss-Markov errors of all receivers, (V, T, 2)."""
        keep = np.exp(-0.1 / self.gps_time_s)
        error = np.empty((len(self.east_m), self.ticks, 2))
        error[:, 0] = self.rng.normal(0, self.gps_m, error[:, 0].shape)
        shocks = self.rng.normal(0, self.gps_m * np.sqrt(1 - keep**2), error.shape)
        for tick in range(1, self.ticks):
            error[:, tick] = keep * error[:, tick - 1] + shocks[:, tick]
        return error + self.rng.normal(0, self.random_m, error.shape)

    def make_messages(self, *, latency_s=0.0, loss=0.0, sent_heading=True):
        """BSM and EGO_STATES; the ego's heading is off by `heading_error_deg`, others' by as much as a deviation."""
        vehicles, ticks = self.east_m.shape
        gps = self.draw_gps()
        lat, lon, _ = pymap3d.enu2geodetic(self.east_m + gps[..., 0], self.north_m + gps[..., 1], 0.0, *ORIGIN)
        off = np.radians(self.heading_error_deg) * np.append(1.0, self.rng.normal(0, 1, vehicles - 1))
        heading = np.degrees(self.heading_rad + off[:, None]) + self.rng.normal(0, 0.2, self.heading_rad.shape)
        yaw = np.degrees(np.gradient(self.heading_rad, 0.1, axis=1)) + self.rng.normal(0, 0.2, heading.shape)
        accel = np.gradient(self.speed_mps, 0.1, axis=1) + self.rng.normal(0, 0.2, heading.shape)
        time_s = np.broadcast_to(np.arange(ticks) / 10, heading.shape)
        frame = pl.DataFrame(
            {
                "vehicle_id": np.repeat(np.arange(vehicles), ticks),
                "time_s": time_s.ravel(),
                "received_s": time_s.ravel() + latency_s,
                "lat_deg": lat.ravel(),
                "lon_deg": lon.ravel(),
                "speed_mps": np.abs(self.speed_mps + self.rng.normal(0, 0.1, heading.shape)).ravel(),
                "heading_deg": np.mod(heading, 360).ravel() if sent_heading else None,
                "accel_mps2": accel.ravel(),
                "yaw_rate_degps": yaw.ravel(),
                "length_m": 4.8,
                "width_m": 1.8,
                "lost": self.rng.random(heading.size) < loss,
            }
        )
        ego = conform(EGO_STATES, frame.filter(pl.col("vehicle_id") == 0).with_columns(source=pl.lit("bsm")))
        others = frame.filter((pl.col("vehicle_id") > 0) & ~pl.col("lost"))
        constants = {"own": False, "temporary_id": "00", "lost_before": 0}
        return conform(BSM, others.with_columns(**{name: pl.lit(value) for name, value in constants.items()})), ego

    def scan(self, reach_m=100.0):
        """Yield a scan per tick: noisy centres of the vehicles in sight, in place of returns."""
        places = self.place()
        for tick in range(self.ticks):
            seen = [
                number
                for number in range(1, len(places))
                if np.hypot(*places[number, tick]) < reach_m
                and not (number in self.hidden and tick in range(*self.hidden[number].indices(self.ticks)))
            ]
            centre = places[seen, tick] + self.rng.normal(0, LIDAR_M, (len(seen), 2))
            yield tick / 10, np.column_stack((centre, np.zeros(len(seen))))


def conform(table, frame):
    dtypes = {name: dtype for name, dtype in table.dtypes.items() if name not in ("dataset", "subset")}
    missing = [pl.lit(None).alias(name) for name in dtypes if name not in frame.columns]
    filled = frame.with_columns(missing).select(pl.col(name).cast(dtype) for name, dtype in dtypes.items())
    return filled.sort([name for name in table.key if name in dtypes] or "seconds")


def measure_centres(points, predicted):
    """A LiDAR that knows the centres: each is assigned to the predicted vehicle that is likeliest, within a gate."""
    from scipy.optimize import linear_sum_assignment

    count = len(points)
    row = np.full(count, -1)
    distance = np.full(count, np.nan)
    candidates = np.zeros(count, int)
    if count and len(predicted.vehicle_id):
        away = points[:, None, :2] - predicted.centre_m
        total = predicted.covariance_m2 + np.eye(2) * LIDAR_M**2
        squared = np.einsum("pvi,vij,pvj->pv", away, np.linalg.inv(total), away)
        near = (squared < 13.8).sum(0)
        cost = np.where(squared < 13.8, squared + np.log(np.linalg.det(total)), 1e6)
        first, second = linear_sum_assignment(cost)
        good = cost[first, second] < 1e6
        row[first[good]] = second[good]
        candidates[first[good]] = near[second[good]]
        distance[first[good]] = squared[first[good], second[good]]
    order = np.arange(count)
    size = np.tile([4.8, 1.8], (count, 1))
    covariance = np.tile(np.eye(2) * LIDAR_M**2, (count, 1, 1))
    clusters = {
        "cluster": order,
        "returns": np.ones(count, int),
        **{
            name: points[:, 0 if "x" in name else 1]
            for name in ("x_m", "y_m", "nearest_x_m", "nearest_y_m", "least_x_m", "most_x_m", "least_y_m", "most_y_m")
        },
        "height_m": np.full(count, 1.6),
    }
    association = {
        "cluster": order,
        "side": np.zeros(count, int),
        "distance_m": np.sqrt(distance),
        "gate": distance,
        "candidates": candidates,
    }
    return LidarMeasurement(
        Measured(row, points[:, :2], covariance, order, np.zeros(count), size), clusters, association
    )


def drive(ahead_m, right_m, speed_mps, *, seconds=30.0, curvature=0.0, heading_deg=30.0, seed=0, **options):
    """Vehicles at (V,) places along and across a road at first, the ego first, and their (V,) or (V, T) speeds."""
    ticks = round(seconds * 10)
    speed = np.broadcast_to(np.asarray(speed_mps, float).reshape(len(ahead_m), -1), (len(ahead_m), ticks))
    along = np.asarray(ahead_m, float)[:, None] + np.cumsum(speed, 1) * 0.1 - speed * 0.1
    across = np.broadcast_to(np.asarray(right_m, float).reshape(len(ahead_m), -1), along.shape)
    drift = np.gradient(across, 0.1, axis=1)
    heading = np.radians(heading_deg) + curvature * along
    if curvature:
        radius = 1 / curvature
        turned = np.radians(heading_deg) + curvature * along
        start = np.radians(heading_deg)
        # the centre of the circle lies to the right; a vehicle `across` to the right is nearer to it
        centre = radius * np.array([np.cos(start), -np.sin(start)])
        east = centre[0] - (radius - across) * np.cos(turned)
        north = centre[1] + (radius - across) * np.sin(turned)
        true_speed = np.hypot(speed * (1 - across * curvature), drift)
    else:
        start = np.radians(heading_deg)
        east = along * np.sin(start) + across * np.cos(start)
        north = along * np.cos(start) - across * np.sin(start)
        true_speed = np.hypot(speed, drift)
    heading = heading + np.arctan2(drift, np.maximum(speed, 1e-9)) * (drift != 0)
    return Scene(east, north, heading, true_speed, np.random.default_rng(seed), **options)


def compare(scene, surrounding, columns=("rel_x_m", "rel_y_m")):
    """Rows of SURROUNDING with the error of their position against the vehicle of that number, m."""
    places = scene.place()
    rows = surrounding.filter(pl.col("vehicle_id") < len(places))
    truth = places[rows["vehicle_id"].to_numpy(), rows["tick"].to_numpy()]
    return rows.with_columns(error_m=np.hypot(*(rows.select(columns).to_numpy() - truth).T))


def put_scene(root, scene, changes=None):
    """Write a scene's drive `trip` into a lake as ingestion does; `changes` are functions of a table's frame."""
    place = {"dataset": "v2v", "subset": "trip"}
    bsm, states = scene.make_messages()
    counts = {"stations": bsm["vehicle_id"].n_unique(), "messages": bsm.height, "scans": 0, "images": 0}
    moment = pl.lit(0).cast(pl.Datetime("us"))
    facts = pl.DataFrame({"recording": ["trip"], "origin": "recorded", "seconds": (scene.ticks - 1) / 10, **counts})
    drives = conform(
        DRIVES, facts.with_columns(start_utc=moment, source_files=pl.lit([], DRIVES.dtypes["source_files"]))
    )
    with open_for_writing(root) as writer:
        files = {}
        tables = {DRIVES: drives, BSM: bsm, EGO_STATES: states}
        for table in tables | (changes or {}):
            frame = tables.get(table)
            changed = (changes or {}).get(table, lambda rows: rows)(frame)
            full = changed.with_columns(**place_of(place)).select(list(table.dtypes))
            files[table.name] = write_table(root, table, full, place, "0" * 16, where="trip")
        info = {"dataset": "v2v", "subsets": [], "drives": ["trip"], "notes": []}
        writer.commit(Commit("ingest/v2v/trip", "0" * 16, files, info=info))


def place_of(place):
    return {name: pl.lit(value) for name, value in place.items()}
