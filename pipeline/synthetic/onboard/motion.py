"""Vehicles of an overhead recording on the clock of a drive: centres, headings and steering at 10 Hz.

Positions are those of the vehicles' centres, along the road (x) and to the right (y). Arrays are (T, V): T ticks, V
vehicles; NaN where a vehicle is not recorded.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.drives import TICK_RATE_HZ
from tracklake.schemas.errors import UsageError
from tracklake.schemas.text import suggest_name

USUAL_SIZES_M = {"car": (4.5, 1.8, 1.5), "truck": (12.0, 2.5, 3.5), "motorcycle": (2.2, 0.8, 1.5)}
"""Length, width and height by class, in m; recordings state no heights, and some no lengths and widths."""
LEAST_TICKS = 40
"""Ticks from the first to the last of the shortest drive: 4 s."""
SMOOTHING_TICKS = 5
"""Headings follow the mean velocity over this many ticks before and after."""
LEAST_SPEED_MPS = 2.0
"""Speed below which motion does not show a heading and the last one holds, in m/s."""
STEERING_RATIO = 16.0
"""Turn of the steering wheel per turn of the front wheels, usual for passenger cars."""
WHEELBASE_SHARE = 0.6
"""Distance between the axles as a share of the vehicle's length."""
MAX_STEERING_DEG = 189.0
"""Largest steering wheel angle that a message can state, in degrees."""
TIME_TOLERANCE_S = 1e-6
"""Times closer than this are the same, in s."""


@dataclass(frozen=True)
class Motion:
    """All vehicles during the drive of one of them, the ego."""

    time_s: Floats
    """(T,) ticks, on the recording's clock."""
    vehicle_id: Integers
    """(V,) ids in the recording."""
    size_m: Floats
    """(V, 3) length, width and height."""
    kind: tuple[str, ...]
    """V classes: car, truck or motorcycle."""
    ego: int
    """Index of the ego."""
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    """Heading from the road's axis, clockwise."""
    speed_mps: Floats
    accel_mps2: Floats
    yaw_rate_radps: Floats
    steering_deg: Floats
    """Angle of the steering wheel, positive to the right."""
    lane: Floats
    """Lane, NaN where unknown."""
    usual_sizes: int
    """Vehicles without a recorded length or width."""

    def place_relative(self) -> tuple[Floats, Floats, Floats]:
        """Return where vehicles are in the ego's frame: ahead, to the right, and heading clockwise; (T, V) each."""
        dx_m, dy_m = (values - values[:, [self.ego]] for values in (self.x_m, self.y_m))
        yaw_rad = self.yaw_rad[:, [self.ego]]
        cosine, sine = np.cos(yaw_rad), np.sin(yaw_rad)
        return dx_m * cosine + dy_m * sine, dy_m * cosine - dx_m * sine, self.yaw_rad - yaw_rad


def compute_motion(tracks: pl.DataFrame, vehicles: pl.DataFrame, ego_id: int, subset: str) -> Motion:
    """Resample a subset's tracks to the ticks at which its vehicle `ego_id` is recorded without a gap.

    Args:
        tracks: rows of the table `tracks`.
        vehicles: rows of the table `vehicles`.
        ego_id: vehicle_id of the ego.
        subset: name of the subset, for messages.

    Raises:
        UsageError: there is no such vehicle, or it was recorded for less than LEAST_TICKS without a gap.
    """
    own = tracks.filter(pl.col("vehicle_id") == ego_id)
    if own.is_empty():
        known = map(str, tracks["vehicle_id"].unique().sort().to_list())
        raise UsageError(f"{subset} has no vehicle {ego_id}: {suggest_name(str(ego_id), known)}")
    _, first_tick, last_tick = find_drives(own).row(0)
    if last_tick - first_tick < LEAST_TICKS:
        seconds = (last_tick - first_tick) / TICK_RATE_HZ
        raise UsageError(
            f"{subset}: vehicle {ego_id} is recorded for {seconds:g} s without a gap; a drive "
            f"takes at least {LEAST_TICKS / TICK_RATE_HZ:g} s. Name another vehicle."
        )
    time_s = np.arange(first_tick, last_tick + 1) / TICK_RATE_HZ
    rows = tracks.filter(pl.col("time_s").is_between(time_s[0] - 1, time_s[-1] + 1)).sort("vehicle_id", "frame")
    return _resample(rows, vehicles, ego_id, time_s)


def find_drives(tracks: pl.DataFrame) -> pl.DataFrame:
    """Return `vehicle_id`, and the first and last tick of each vehicle's longest run of frames without a gap."""
    time_s, run = pl.col("time_s"), pl.col("frame") - pl.int_range(pl.len()).over("vehicle_id")
    return (
        tracks.select("vehicle_id", "frame", "time_s")
        .sort("vehicle_id", "frame")
        .group_by("vehicle_id", run.alias("run"))
        .agg(
            ((time_s.min() - TIME_TOLERANCE_S) * TICK_RATE_HZ).ceil().cast(pl.Int64).alias("first_tick"),
            ((time_s.max() + TIME_TOLERANCE_S) * TICK_RATE_HZ).floor().cast(pl.Int64).alias("last_tick"),
        )
        .sort("vehicle_id", pl.col("first_tick") - pl.col("last_tick"), "first_tick")
        .group_by("vehicle_id", maintain_order=True)
        .first()
        .select("vehicle_id", "first_tick", "last_tick")
    )


def _resample(rows: pl.DataFrame, vehicles: pl.DataFrame, ego_id: int, time_s: Floats) -> Motion:
    ids, number = np.unique(rows["vehicle_id"].to_numpy().astype(np.int64), return_inverse=True)
    kind, size_m, usual = _find_sizes(vehicles, ids)
    before, weight, known = _find_entries(rows, number, len(ids), time_s)
    after = np.minimum(before + 1, rows.height - 1)

    def interpolate(name: str) -> Floats:
        values = rows[name].cast(pl.Float64).fill_null(np.nan).to_numpy()
        return np.where(
            known, values[before] + np.where(weight > 0, weight * (values[after] - values[before]), 0), np.nan
        )

    front_x_m, front_y_m, speed_mps = (interpolate(name) for name in ("x_m", "y_m", "speed_mps"))
    accel_mps2 = interpolate("accel_mps2")
    computed = _differentiate(speed_mps)
    lane = rows["lane"].cast(pl.Float64).fill_null(np.nan).to_numpy()[np.where(weight < 0.5, before, after)]
    yaw_rad = find_headings(front_x_m, front_y_m)
    yaw_rate_radps = _differentiate(yaw_rad)
    bend_rad = np.arctan(WHEELBASE_SHARE * size_m[:, 0] * yaw_rate_radps / np.maximum(speed_mps, LEAST_SPEED_MPS))
    return Motion(
        time_s=time_s,
        vehicle_id=ids,
        size_m=size_m,
        kind=kind,
        ego=int(np.searchsorted(ids, ego_id)),
        x_m=front_x_m - size_m[:, 0] / 2 * np.cos(yaw_rad),
        y_m=front_y_m - size_m[:, 0] / 2 * np.sin(yaw_rad),
        yaw_rad=yaw_rad,
        speed_mps=speed_mps,
        accel_mps2=np.where(np.isnan(accel_mps2), computed, accel_mps2),
        yaw_rate_radps=yaw_rate_radps,
        steering_deg=np.clip(np.degrees(bend_rad) * STEERING_RATIO, -MAX_STEERING_DEG, MAX_STEERING_DEG),
        lane=np.where(known, lane, np.nan),
        usual_sizes=usual,
    )


def _find_entries(rows: pl.DataFrame, number: Integers, count: int, time_s: Floats) -> tuple[Integers, Floats, Flags]:
    """Return, (T, V), each vehicle's entry at or before a tick, the weight of the next entry, and whether both exist.

    Gaps are not bridged: beyond a track's last entry before missing frames, only a tick exactly at it is known.
    """
    frame, entry_s = rows["frame"].to_numpy(), rows["time_s"].to_numpy()
    stride = max(float(entry_s.max(initial=0)), float(time_s[-1])) + 10.0  # puts each vehicle on its own stretch
    wanted = np.arange(count)[None, :] * stride + time_s[:, None] + TIME_TOLERANCE_S
    before = np.maximum(np.searchsorted(number * stride + entry_s, wanted, side="right") - 1, 0)
    after = np.minimum(before + 1, rows.height - 1)
    late_s = time_s[:, None] - entry_s[before]
    exact = np.abs(late_s) <= 2 * TIME_TOLERANCE_S
    follows = (number[after] == number[before]) & (frame[after] - frame[before] == 1)
    step_s = np.where(follows, entry_s[after] - entry_s[before], 1.0)
    known = (number[before] == np.arange(count)) & (late_s >= -TIME_TOLERANCE_S * 2) & (exact | follows)
    return before, np.where(exact | ~follows, 0.0, late_s / step_s), known


def _find_sizes(vehicles: pl.DataFrame, ids: Integers) -> tuple[tuple[str, ...], Floats, int]:
    """Return class and size of each vehicle, and the number of those without a recorded length or width."""
    wanted = pl.DataFrame({"vehicle_id": ids}).with_columns(pl.col("vehicle_id").cast(vehicles["vehicle_id"].dtype))
    found = wanted.join(vehicles, on="vehicle_id", how="left", maintain_order="left").with_columns(
        kind=pl.col("class").fill_null("car")
    )
    kind = tuple(found["kind"].to_list())
    usual = np.array([USUAL_SIZES_M[each] for each in kind]).reshape(-1, 3)
    stated = np.stack(
        [found[name].cast(pl.Float64).fill_null(np.nan).to_numpy() for name in ("length_m", "width_m")], axis=1
    )
    missing = ~(stated > 0)
    return (
        kind,
        np.concatenate((np.where(missing, usual[:, :2], stated), usual[:, 2:]), axis=1),
        int(missing.any(axis=1).sum()),
    )


def find_headings(x_m: Floats, y_m: Floats) -> Floats:
    """Return where vehicles head, rad clockwise from the road's axis, by their smoothed velocity.

    Below LEAST_SPEED_MPS, and backwards, the last heading holds; before the first one, that one; without any, 0.

    Args:
        x_m: positions along the road, (T, V).
        y_m: positions to the right, (T, V).
    """
    ahead, aside = (_smooth(np.diff(values, axis=0) * TICK_RATE_HZ) for values in (x_m, y_m))
    moving = (ahead > 0) & (np.hypot(ahead, aside) >= LEAST_SPEED_MPS)
    heading = np.arctan2(aside, ahead)
    tick = np.arange(len(x_m))[:, None]
    last = np.maximum.accumulate(np.where(moving, tick, -1), axis=0)
    first = np.where(moving.any(axis=0), moving.argmax(axis=0), 0)
    held = np.take_along_axis(heading, np.where(last < 0, first, last), axis=0)
    return np.where(np.isnan(x_m), np.nan, np.where(moving.any(axis=0), held, 0.0))


def _smooth(steps: Floats, ticks: int = SMOOTHING_TICKS) -> Floats:
    """Return the mean of the known steps from `ticks` before to `ticks` after each tick, (T - 1, V) to (T, V)."""
    empty = np.zeros((1, steps.shape[1]))
    total = np.concatenate((empty, np.cumsum(np.nan_to_num(steps), axis=0)))
    count = np.concatenate((empty, np.cumsum(~np.isnan(steps), axis=0)))
    tick = np.arange(len(total))
    low, high = np.maximum(tick - ticks, 0), np.minimum(tick + ticks, len(total) - 1)
    mean: Floats = (total[high] - total[low]) / np.maximum(count[high] - count[low], 1)
    return mean


def _differentiate(values: Floats) -> Floats:
    """Return the rate of change per second, (T, V), by the known neighbors of each tick; without any, 0."""
    rate = _smooth(np.diff(values, axis=0) * TICK_RATE_HZ, ticks=1)
    return np.where(np.isnan(values), np.nan, rate)
