"""Whose returns each vehicle gets, and how exact its place then is: swaps and errors in four scenarios.

A vehicle ahead of the ego accelerates or brakes, and keeps its lane or changes it (Choi et al., 2021), among others in
three lanes. Messages, LiDAR and camera are those of virtual instruments; the truth is known.

python benchmarks/onboard_association.py [--seeds 20] [--first 0] [--gnss plain] [--penetration 1.0]
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.onboard.sensing import InstrumentConfig, SensedDrive, sense_drive
from tracklake.pipeline.transforms.onboard.association import measure_by_lidar
from tracklake.pipeline.transforms.onboard.camera import match_boxes
from tracklake.pipeline.transforms.onboard.measurements import Camera, Scanner
from tracklake.pipeline.transforms.onboard.surrounding import Sensors, fuse_drive
from tracklake.schemas import ASSOCIATION, BSM, DETECTIONS, EGO_STATES, LIDAR_CLUSTERS, SURROUNDING
from tracklake.schemas.arrays import Floats
from tracklake.schemas.drives import TICK_RATE_HZ
from tracklake.schemas.perception import FIRST_LIDAR_ID

SCENARIOS = {
    (rate, change): f"{'accelerates' if rate > 0 else 'brakes'}, {'changes' if change else 'keeps'} its lane"
    for rate in (0.8, -0.8)
    for change in (False, True)
}
"""Names by acceleration of the vehicle ahead, in m/s2, and whether it changes its lane."""
TICKS, LANE_M = 100, 3.6
"""Length of a drive, in ticks, and width of a lane, in m."""
EGO, AHEAD = 0, 1
"""vehicle_id of the ego and of the vehicle ahead."""
BANDS_M = ((0, 20), (20, 40), (40, 60), (60, 90))
"""Bands of distance whose errors are given, in m."""
SETTLED_TICK = 20
"""First tick of the errors: by then the tracks have begun."""
LASTING_TICKS = 5
"""Time for which a vehicle_id follows another vehicle until its identity counts as changed, in ticks: 0.5 s."""


def drive_vehicles(random: np.random.Generator, rate_mps2: float, changes: bool) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return `tracks` and `vehicles` of a scenario: ego in the middle of three lanes, one ahead, and others."""
    time_s = np.arange(TICKS) / TICK_RATE_HZ
    lane_mps = 25 + np.array([2.0, 0.0, -1.0]) + random.normal(0, 0.5, 3)
    start_m, speed_mps = random.uniform(22, 35), lane_mps[1]
    active = np.clip(time_s - 2, 0, 4)
    way = start_m + speed_mps * time_s + rate_mps2 * (active**2 / 2 + active * np.maximum(time_s - 6, 0))
    share = (1 - np.cos(np.pi * np.clip((time_s - 2) / 5, 0, 1))) / 2 if changes else np.zeros(TICKS)
    own = [
        (EGO, 4.5, 1.8, lane_mps[1] * time_s, np.full(TICKS, 1.5 * LANE_M)),
        (AHEAD, 4.6, 1.85, way, (1.5 + share) * LANE_M),
    ]
    for lane in range(3):
        x_m = -90.0 + random.uniform(0, 20)
        while x_m < 110:
            truck = random.random() < 0.2
            length, width = (
                (random.uniform(10, 16), 2.5) if truck else (random.uniform(4, 5), random.uniform(1.7, 1.95))
            )
            along = x_m + lane_mps[lane] * time_s
            wander = (lane + 0.5) * LANE_M + random.normal(0, 0.2)
            away = [np.abs(along - other[3]) < 10 + length for other in own[:2]]
            if not ((away[0] | away[1]).any() if lane == 1 else lane == 2 and changes and away[1].any()):
                own.append((len(own), length, width, along, np.full(TICKS, wander)))
            x_m += length + random.uniform(6, 30)
    frames = []
    for number, length, _, along, across in own:
        speed = np.gradient(along, time_s)
        columns = {
            "vehicle_id": [number] * TICKS,
            "frame": np.arange(TICKS),
            "time_s": time_s,
            "x_m": along + length / 2,
            "y_m": across,
            "speed_mps": speed,
            "accel_mps2": np.gradient(speed, time_s),
            "lane": (across // LANE_M).astype(np.int16) + 1,
        }
        frames.append(pl.DataFrame(columns))
    facts = [
        {"vehicle_id": number, "length_m": length, "width_m": width, "class": "truck" if length > 8 else "car"}
        for number, length, width, _, _ in own
    ]
    return pl.concat(frames), pl.DataFrame(facts)


def fuse(sensed: SensedDrive, config: InstrumentConfig) -> pl.DataFrame:
    """Return `surrounding` of a drive, with the recording's ids for vehicles that send messages."""
    since = (pl.col("utc_us") - sensed.start_us) / 1e6
    messages = sensed.messages.with_columns(
        vehicle_id=pl.col("sender").cast(pl.Int32),
        time_s=since,
        received_s=(pl.col("received_us") - sensed.start_us) / 1e6,
        lost_before=0,
        clock_step_s=pl.lit(None, pl.Float32),
    ).unique(["vehicle_id", "time_s"])
    ego = messages.filter("own").with_columns(source=pl.lit("bsm"))
    where = ("dataset", "subset")
    bsm = messages.select(name for name in BSM.dtypes if name not in where).sort("vehicle_id", "time_s")
    states = ego.select(name for name in EGO_STATES.dtypes if name not in where).sort("time_s")
    sensors = Sensors()
    if config.lidar is not None:
        mount = Scanner(config.lidar.x_m, config.lidar.y_m, config.lidar.z_m)
        place = np.array([mount.x_m, mount.y_m, mount.z_m])
        sensors.scans = ((tick / TICK_RATE_HZ, scan.points_m + place) for tick, scan in enumerate(sensed.scans))
        sensors.measure = partial(measure_by_lidar, scanner=mount)
    if config.camera is not None:
        lens = config.camera
        sensors.camera = Camera(lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, lens.x_m, lens.y_m, lens.z_m)
        sensors.match_boxes = match_boxes
        sensors.detections = list_detections(sensed)
    tables = fuse_drive(bsm, states, len(sensed.motion.time_s), sensors).tables
    nearest = tables[LIDAR_CLUSTERS].select("tick", "cluster", "nearest_x_m", "nearest_y_m")
    assigned = tables[ASSOCIATION].join(nearest, on=("tick", "cluster"))
    return tables[SURROUNDING].join(assigned, on=("vehicle_id", "tick"), how="left")


def list_detections(sensed: SensedDrive) -> pl.DataFrame:
    """Return the boxes of all images as rows of `detections`."""
    rows = [
        (tick / TICK_RATE_HZ, number, *box)
        for tick, image in enumerate(sensed.images)
        for number, box in enumerate(image.boxes_px.tolist())
    ]
    names = ["time_s", "detection", "left_px", "top_px", "width_px", "height_px"]
    kept = {name: dtype for name, dtype in DETECTIONS.dtypes.items() if name in names}
    return pl.DataFrame(rows, schema=kept, orient="row")


def judge(surrounding: pl.DataFrame, config: InstrumentConfig, sensed: SensedDrive) -> pl.DataFrame:
    """Add to vehicles that send: whose returns they were given, the error of their place, and their true distance."""
    ahead, aside, _ = sensed.motion.place_relative()
    ids = sensed.motion.vehicle_id
    frame = surrounding.sort("vehicle_id", "tick")
    tick, vehicle = frame["tick"].to_numpy(), frame["vehicle_id"].to_numpy()
    sends = vehicle < FIRST_LIDAR_ID
    column = np.where(sends, np.searchsorted(ids, vehicle).clip(0, ids.size - 1), 0)
    place = frame.select("rel_x_m", "rel_y_m").to_numpy()
    owner = np.full(len(tick), -1)
    if config.lidar is not None:
        mount = np.array([config.lidar.x_m, config.lidar.y_m])
        returns = frame.select("nearest_x_m", "nearest_y_m").cast(pl.Float64).fill_null(np.nan).to_numpy()
        for row in np.flatnonzero(~np.isnan(returns[:, 0])):
            scan = sensed.scans[tick[row]]
            point = int(np.square(scan.points_m[:, :2] + mount - returns[row]).sum(1).argmin())
            owner[row] = ids[sensed.seen[tick[row]][scan.box[point]]]
    return frame.with_columns(
        owner=owner,
        sends=sends,
        error_m=np.where(sends, np.hypot(place[:, 0] - ahead[tick, column], place[:, 1] - aside[tick, column]), np.nan),
        distance_m=np.where(sends, np.hypot(ahead[tick, column], aside[tick, column]), np.nan),
    )


def count_swaps(judged: pl.DataFrame) -> tuple[int, int, int]:
    """Return how often returns were assigned, how often to a vehicle that they are not of, and changes of identity.

    A vehicle that sends nothing has the returns of another one where the one before was of another. An identity
    changes where a vehicle_id has returns of one vehicle, and then of another one for over LASTING_TICKS.
    """
    rows = judged.filter(pl.col("owner") >= 0)
    before = pl.col("owner").shift(1).over("vehicle_id").fill_null(pl.col("owner"))
    own = pl.when("sends").then("vehicle_id").otherwise(before)
    run = rows.with_columns(run=pl.col("owner").rle_id().over("vehicle_id")).group_by(
        "vehicle_id", "run", maintain_order=True
    )
    lasting = run.agg(pl.first("owner", "sends"), ticks=pl.col("tick").last() - pl.col("tick").first()).filter(
        pl.col("ticks") > LASTING_TICKS
    )
    first = pl.when("sends").then("vehicle_id").otherwise("owner")
    changed = pl.col("owner") != pl.col("owner").shift(1).over("vehicle_id").fill_null(first)
    return rows.height, rows.filter(pl.col("owner") != own).height, lasting.filter(changed).height


def bound(values: list[float | None], random: np.random.Generator) -> str:
    """Return the median of per-drive values with its 95 % interval by the bootstrap."""
    known: Floats = np.array([value for value in values if value is not None])
    if not known.size:
        return "-"
    drawn = np.median(random.choice(known, (2000, known.size)), axis=1)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return f"{np.median(known):.2f} ({low:.2f} to {high:.2f})"


def run(arguments: argparse.Namespace) -> Iterator[str]:
    """Yield lines of the report."""
    base = InstrumentConfig(receiver=arguments.gnss, penetration=arguments.penetration)
    variants = {
        "messages": replace(base, lidar=None, camera=None),
        "messages, LiDAR": replace(base, camera=None),
        "messages, LiDAR, camera": base,
    }
    errors: dict[tuple[str, int], list[float | None]] = {}
    heads = "the vehicle ahead", "rows with LiDAR", "swaps", "with camera", "identities changed", "with camera"
    yield "| " + " | ".join(heads) + " |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for number, ((rate, change), name) in enumerate(SCENARIOS.items()):
        counts = {variant: np.zeros(3, np.int64) for variant in variants}
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            tracks, vehicles = drive_vehicles(np.random.default_rng([number, seed]), rate, change)
            facts = {"dataset": "highd", "subset": "scenario"}
            sensed = sense_drive(tracks, vehicles, facts, EGO, replace(base, seed=1000 * number + seed))
            for variant, config in variants.items():
                judged = judge(fuse(sensed, config), config, sensed)
                counts[variant] += count_swaps(judged)
                late = judged.filter((pl.col("tick") >= SETTLED_TICK) & "sends")
                if config.lidar is not None:
                    late = late.filter("from_lidar")
                for band, (low, high) in enumerate(BANDS_M):
                    near = late.filter(pl.col("distance_m").is_between(low, high, closed="left"))
                    middle: list[float | None] = near.select(pl.median("error_m")).to_series().to_list()
                    errors.setdefault((variant, band), []).extend(middle)
        lidar, camera = (counts[variant] for variant in list(variants)[1:])
        yield f"| {name} | {lidar[0]:,} | {lidar[1]:,} | {camera[1]:,} | {lidar[2]:,} | {camera[2]:,} |"
    random = np.random.default_rng(0)
    yield (
        "\n| error in m | "
        + " | ".join(f"{low} to {high} m" for low, high in BANDS_M)
        + " |\n| --- | --- | --- | --- | --- |"
    )
    for variant in variants:
        cells = (bound(errors[variant, band], random) for band in range(len(BANDS_M)))
        yield f"| {variant} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="drives for each scenario")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--gnss", default="plain", choices=("plain", "dgps"))
    parser.add_argument("--penetration", type=float, default=1.0)
    for line in run(parser.parse_args()):
        print(line, flush=True)
