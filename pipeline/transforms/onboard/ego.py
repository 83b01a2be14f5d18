"""The ego's own state on the 10 Hz clock, by the records that it had logged until each tick.

An extended Kalman filter joins positions, speed, yaw rate and heading. What it knows beyond the log: the direction in
which the ego moves tells what its logged heading is off by, a part of the state that changes slowly. A heading that was
never logged comes from the motion alone, and at a standstill the last one holds.

Beside the place on Earth stands one by odometry, speed and yaw rate summed up: a frame that stands still on the ground
and moves without jumps. Errors of positions and of the heading do not reach it, so that what LiDAR measures in the
ego's frame is consistent in it over time.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.onboard.geodesy import compute_axes, convert_to_ecef, convert_to_geodetic
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.drives import TICK_RATE_HZ

MAX_EGO_AGE_S = 1.5
"""Time after its last record up to which the ego's state is extrapolated, in s; later ticks have none."""
STEP_S = 1 / TICK_RATE_HZ
"""Time from tick to tick, in s."""
STANDSTILL_MPS = 1.0
"""Speed under which a logged heading is not read, in m/s: receivers derive it from the motion."""
FIRST_WAY_M = 3.0
"""Distance after which the motion tells the first heading where none was logged, in m."""
POSITION_M, SPEED_MPS, YAW_RATE_RADPS, HEADING_RAD = 1.5, 0.2, np.radians(0.3), np.radians(0.5)
"""Standard deviations of what is logged: position, speed, yaw rate, and heading apart from its slow error."""
HEADING_ERROR_RAD, HEADING_DRIFT_RAD = np.radians(2.0), np.radians(0.02)
"""Standard deviations of the slow error of logged headings at first, and of its change per square root of a second."""
SPEED_NOISE, YAW_NOISE_RADPS = 1.0, np.radians(4.0)
"""Changes of speed (m/s) beside the logged acceleration, and of the yaw rate, per square root of a second."""
EAST, NORTH, YAW, SPEED, YAW_RATE, HEADING_ERROR = range(6)
"""Parts of the filter's state: place in the plane (m), heading (rad), speed (m/s), yaw rate (rad/s), heading error."""


@dataclass(frozen=True)
class EgoTrack:
    """The ego at the ticks 0 to T - 1.

    Args:
        known: (T,) whether the state is known; other arrays hold NaN or the last value where it is not.
        start: (T,) number of the stretch of known ticks without a gap.
        ecef_m: (T, 3) place on Earth.
        lat_deg: (T,) latitude, likewise longitude and height.
        heading_rad: (T,) clockwise from north, with its standard deviation.
        odometry_m: (T, 2) place in the frame of odometry: x ahead and y to the right of the first tick's heading.
        odometry_rad: (T,) heading in that frame, clockwise.
    """

    known: Flags
    start: Integers
    ecef_m: Floats
    lat_deg: Floats
    lon_deg: Floats
    height_m: Floats
    heading_rad: Floats
    heading_sigma_rad: Floats
    speed_mps: Floats
    yaw_rate_radps: Floats
    odometry_m: Floats
    odometry_rad: Floats


def pick_records(ego_states: pl.DataFrame, ticks: int) -> pl.DataFrame:
    """Return the last record until each tick and since the tick before, with `tick` and `age_s`.

    Where both the ego's messages and its receiver were logged, the later one counts, and values that it lacks come
    from the other.
    """
    names = ("elevation_m", "speed_mps", "heading_deg", "accel_mps2", "yaw_rate_degps")
    due = (pl.col("time_s") * TICK_RATE_HZ - 1e-6).ceil().cast(pl.Int32).alias("tick")
    return (
        ego_states.with_columns(due)
        .filter(pl.col("tick") < ticks)
        .sort("time_s", "source", descending=[False, True])
        .group_by("tick", maintain_order=True)
        .agg(pl.col("time_s", "lat_deg", "lon_deg").last(), *(pl.col(name).drop_nulls().last() for name in names))
        .sort("tick")
        .with_columns(age_s=pl.col("tick") / TICK_RATE_HZ - pl.col("time_s"))
    )


def estimate_ego(ego_states: pl.DataFrame, ticks: int) -> EgoTrack:
    """Estimate the ego's state at every tick from EGO_STATES."""
    records = pick_records(ego_states, ticks)
    at = records["tick"].to_numpy()
    ecef_m, axes, plane_m = _lay_out_plane(records)
    measured = np.full((ticks, 6), np.nan)  # east, north, heading, speed, yaw rate, age
    measured[at, :2] = plane_m
    columns = {2: "heading_deg", 3: "speed_mps", 4: "yaw_rate_degps", 5: "age_s"}
    for place, name in columns.items():
        values = records[name].cast(pl.Float64).fill_null(np.nan).to_numpy()
        measured[at, place] = np.radians(values) if name.startswith(("heading", "yaw")) else values
    stands = np.isnan(measured[:, 4]) & (measured[:, 3] < STANDSTILL_MPS / 2)
    measured[stands, 4] = 0.0  # a vehicle that stands does not turn
    accel = np.zeros(ticks)
    accel[at] = records["accel_mps2"].cast(pl.Float64).fill_null(0.0).to_numpy()
    state, sigma, known = _filter(measured, accel)
    speed, yaw_rate = np.where(known, state[:, SPEED], 0.0), np.where(known, state[:, YAW_RATE], 0.0)
    yaw = np.cumsum(np.append(0.0, yaw_rate[1:])) * STEP_S
    middle = yaw - yaw_rate * STEP_S / 2
    steps = (speed * STEP_S)[:, None] * np.stack((np.cos(middle), np.sin(middle)), 1)
    last = np.maximum(np.searchsorted(at, np.arange(ticks), side="right") - 1, 0)
    if len(at):  # the last record's place, and from there in the plane tangent at it
        off_m = np.where(known[:, None], state[:, :2] - plane_m[last], 0.0)
        placed = ecef_m[last] + np.squeeze(np.swapaxes(axes[last, :2], 1, 2) @ off_m[..., None], -1)
    else:
        placed = np.full((ticks, 3), np.nan)
    begins = known & ~np.append(False, known[:-1])
    lat_deg, lon_deg, height_m = convert_to_geodetic(placed)
    return EgoTrack(
        known=known,
        start=np.cumsum(begins),
        ecef_m=placed,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        height_m=height_m,
        heading_rad=state[:, YAW],
        heading_sigma_rad=sigma,
        speed_mps=speed,
        yaw_rate_radps=yaw_rate,
        odometry_m=np.cumsum(steps, axis=0) - steps[:1],
        odometry_rad=yaw,
    )


def _lay_out_plane(records: pl.DataFrame) -> tuple[Floats, Floats, Floats]:
    """Return ECEF and axes of records, and their places in a plane: steps east and north, each at its own record.

    Its axes thus point east and north everywhere, also after a hundred kilometres.
    """
    lat_deg, lon_deg = records["lat_deg"].to_numpy(), records["lon_deg"].to_numpy()
    ecef_m = convert_to_ecef(lat_deg, lon_deg, records["elevation_m"].cast(pl.Float64).fill_null(0.0).to_numpy())
    axes = compute_axes(lat_deg, lon_deg)
    steps = np.squeeze(axes[:, :2] @ np.diff(ecef_m, axis=0, prepend=ecef_m[:1])[..., None], -1)
    return ecef_m, axes, np.cumsum(steps, axis=0)


def _filter(measured: Floats, accel_mps2: Floats) -> tuple[Floats, Floats, Flags]:
    """Run the filter over the ticks; return (T, 6) states, the heading's standard deviation, and which are known."""
    ticks = len(measured)
    states, sigmas, known = np.full((ticks, 6), np.nan), np.full(ticks, np.nan), np.zeros(ticks, dtype=bool)
    state: Floats | None = None
    covariance, first, age, error = np.empty((6, 6)), np.full(2, np.nan), np.inf, 0.0
    for tick in range(ticks):
        record, accel = measured[tick], accel_mps2[tick]
        seen = not np.isnan(record[0])
        age = record[5] if seen else age + STEP_S
        if age > MAX_EGO_AGE_S + STEP_S / 2:
            state, first = None, np.full(2, np.nan)
            continue
        if state is not None:
            state, covariance = _predict(state, covariance, accel)
            if seen:
                state, covariance = _update(state, covariance, record)
            error = state[HEADING_ERROR]
        elif seen:
            first = record[:2] if np.isnan(first[0]) else first
            begun = _begin(record, first, error)
            if begun is not None:
                state, covariance = begun
        if state is not None:
            states[tick], sigmas[tick], known[tick] = state, np.sqrt(covariance[YAW, YAW]), True
    return states, sigmas, known


def _begin(record: Floats, first_m: Floats, error_rad: float) -> tuple[Floats, Floats] | None:
    """Return the first state, by the logged heading or by the way since the first record; None where both lack.

    The error of the heading that an earlier stretch found is where the search for it begins.
    """
    heading, way = record[2], record[:2] - first_m
    variance = np.array([POSITION_M, POSITION_M, HEADING_ERROR_RAD, 30.0, 0.5, HEADING_ERROR_RAD]) ** 2
    covariance = np.diag(variance)
    if not np.isnan(heading):
        heading = heading - error_rad
        covariance[YAW, HEADING_ERROR] = covariance[HEADING_ERROR, YAW] = -variance[HEADING_ERROR]
        covariance[YAW, YAW] += HEADING_RAD**2
    elif np.hypot(*way) >= FIRST_WAY_M:
        heading = np.arctan2(way[0], way[1])
        covariance[YAW, YAW] = 0.5**2
    else:
        return None
    state = np.array([*record[:2], heading, *np.nan_to_num(record[3:5]), error_rad])
    covariance[SPEED, SPEED] = 30.0**2 if np.isnan(record[3]) else SPEED_MPS**2
    covariance[YAW_RATE, YAW_RATE] = 0.5**2 if np.isnan(record[4]) else YAW_RATE_RADPS**2
    return state, covariance


def _predict(state: Floats, covariance: Floats, accel_mps2: float) -> tuple[Floats, Floats]:
    """Take the ego's state one tick on."""
    middle = state[YAW] + state[YAW_RATE] * STEP_S / 2
    sine, cosine, way = np.sin(middle), np.cos(middle), state[SPEED] * STEP_S
    transition = np.eye(6)
    transition[EAST, [YAW, SPEED]] = way * cosine, STEP_S * sine
    transition[NORTH, [YAW, SPEED]] = -way * sine, STEP_S * cosine
    transition[YAW, YAW_RATE] = STEP_S
    after = state + np.array([way * sine, way * cosine, state[YAW_RATE] * STEP_S, accel_mps2 * STEP_S, 0.0, 0.0])
    after[SPEED] = max(after[SPEED], 0.0)
    noise = np.diag(
        [1e-4, 1e-4, 1e-8, SPEED_NOISE**2 * STEP_S, YAW_NOISE_RADPS**2 * STEP_S, HEADING_DRIFT_RAD**2 * STEP_S]
    )
    return after, transition @ covariance @ transition.T + noise


def _update(state: Floats, covariance: Floats, record: Floats) -> tuple[Floats, Floats]:
    """Correct the ego's state by a record that was logged up to one tick ago."""
    back = record[5]
    sine, cosine = np.sin(state[YAW]), np.cos(state[YAW])
    observation = np.zeros((5, 6))
    observation[0, [EAST, YAW, SPEED]] = 1.0, -back * state[SPEED] * cosine, -back * sine
    observation[1, [NORTH, YAW, SPEED]] = 1.0, back * state[SPEED] * sine, -back * cosine
    observation[2, [YAW, YAW_RATE, HEADING_ERROR]] = 1.0, -back, 1.0
    observation[3, SPEED] = observation[4, YAW_RATE] = 1.0
    way = back * state[SPEED]
    turned = state[YAW] - back * state[YAW_RATE] + state[HEADING_ERROR]
    expected = np.array([state[EAST] - way * sine, state[NORTH] - way * cosine, turned, state[SPEED], state[YAW_RATE]])
    residual = record[:5] - expected
    residual[2] = np.mod(residual[2] + np.pi, 2 * np.pi) - np.pi
    used = ~np.isnan(residual)
    used[2] &= state[SPEED] >= STANDSTILL_MPS
    residual, observation = residual[used], observation[used]
    noise = np.diag(np.square([POSITION_M, POSITION_M, HEADING_RAD, SPEED_MPS, YAW_RATE_RADPS])[used])
    gain = np.linalg.solve(observation @ covariance @ observation.T + noise, observation @ covariance).T
    covariance = covariance - gain @ observation @ covariance
    return state + gain @ residual, (covariance + covariance.T) / 2
