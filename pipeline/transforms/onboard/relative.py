"""Messages of other vehicles as places in the ego's frame, at the tick by which they had arrived."""

from dataclasses import dataclass, fields

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.onboard.ego import EgoTrack
from tracklake.pipeline.transforms.onboard.geodesy import place_in_ego_frame
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.drives import TICK_RATE_HZ

MAX_MESSAGE_AGE_S = 1.0
"""Age at its arrival up to which a message is used, in s; also the farthest that a clock may run ahead."""
USUAL_ACCURACY_M = 1.5
"""Standard deviation of positions where messages do not state it, in m."""
LEAST_ACCURACY_M = 0.1
"""Least standard deviation of positions that is believed, in m."""
STRAIGHT_RAD = 1e-6
"""Turn between generation and tick under which the way is straight, in rad."""


@dataclass(frozen=True)
class RelativeMessages:
    """The latest message of each vehicle that arrived since the tick before, N of them, by tick and vehicle.

    Values are carried on from the moment of generation to the tick; NaN where they were not sent.

    Args:
        centre_m: (N, 2) ahead and to the right of the ego's centre.
        heading_rad: (N,) minus the ego's, clockwise, from -pi to pi.
        age_s: (N,) from generation to the tick.
        accuracy_m: (N,) standard deviation of the position.
    """

    tick: Integers
    vehicle_id: Integers
    centre_m: Floats
    heading_rad: Floats
    speed_mps: Floats
    accel_mps2: Floats
    steering_angle_deg: Floats
    length_m: Floats
    width_m: Floats
    age_s: Floats
    accuracy_m: Floats

    def select(self, rows: slice | Integers | Flags) -> "RelativeMessages":
        """Return some of the messages."""
        return RelativeMessages(**{each.name: getattr(self, each.name)[rows] for each in fields(self)})


def choose_messages(bsm: pl.DataFrame, ticks: int) -> pl.DataFrame:
    """Return the messages that are used, with `tick` and `age_s`.

    A message counts from the first tick after its arrival (its generation where that was not logged). Of several by one
    tick the one generated last is used, and none that is older than one used before, or than MAX_MESSAGE_AGE_S.
    """
    arrived_s = pl.col("received_s").fill_null(pl.col("time_s"))
    due = (arrived_s * TICK_RATE_HZ - 1e-6).ceil().cast(pl.Int64)
    newest = pl.col("time_s").cum_max().shift(1).over("vehicle_id")
    return (
        bsm.filter(~pl.col("own"))
        .with_columns(tick=due, age_s=due / TICK_RATE_HZ - pl.col("time_s"))
        .filter((pl.col("tick") < ticks) & (pl.col("age_s").abs() <= MAX_MESSAGE_AGE_S))
        .sort("tick", "time_s", "vehicle_id")
        .filter(newest.is_null() | (pl.col("time_s") > newest))
        .unique(["tick", "vehicle_id"], keep="last", maintain_order=True)
        .sort("tick", "vehicle_id")
    )


def advance(speed_mps: Floats, accel_mps2: Floats, yaw_rate_radps: Floats, age_s: Floats) -> tuple[Floats, Floats]:
    """Return how far (N,) vehicles drive ahead and to their right in `age_s`, at constant acceleration and yaw rate."""
    turn = yaw_rate_radps * age_s
    way = speed_mps * age_s
    way = np.where(age_s > 0, np.maximum(way + accel_mps2 * age_s**2 / 2, 0.0), way)
    bent = np.abs(turn) > STRAIGHT_RAD
    divisor = np.where(bent, turn, 1.0)
    ahead = np.where(bent, np.sin(turn) / divisor, 1.0)
    right = np.where(bent, (1 - np.cos(turn)) / divisor, turn / 2)
    return way * ahead, way * right


def place_messages(bsm: pl.DataFrame, ego: EgoTrack) -> RelativeMessages:
    """Place messages (BSM) in the ego's frame at the ticks at which the ego's state is known."""
    chosen = choose_messages(bsm, len(ego.known))
    chosen = chosen.filter(pl.Series(ego.known[chosen["tick"].to_numpy()], dtype=pl.Boolean))
    tick = chosen["tick"].to_numpy()

    def read(name: str) -> Floats:
        return chosen[name].cast(pl.Float64).fill_null(np.nan).to_numpy()

    age_s, speed, accel, sent = read("age_s"), read("speed_mps"), read("accel_mps2"), np.radians(read("heading_deg"))
    yaw_rate = np.nan_to_num(np.radians(read("yaw_rate_degps")))
    own = np.stack((ego.lat_deg[tick], ego.lon_deg[tick], ego.height_m[tick]), 1)
    level = np.stack((read("lat_deg"), read("lon_deg"), ego.height_m[tick]), 1)  # heights are too rough to help
    centre_m = place_in_ego_frame(level, own, np.degrees(ego.heading_rad[tick]))[:, :2]
    then = sent - ego.heading_rad[tick]
    ahead, right = advance(np.nan_to_num(speed), np.nan_to_num(accel), yaw_rate, age_s)
    sine, cosine = np.sin(then), np.cos(then)
    way_m = np.stack((ahead * cosine - right * sine, ahead * sine + right * cosine), 1)
    heading = then + yaw_rate * age_s
    return RelativeMessages(
        tick=tick,
        vehicle_id=chosen["vehicle_id"].to_numpy().astype(np.int64),
        centre_m=centre_m + np.nan_to_num(way_m),
        heading_rad=np.mod(heading + np.pi, 2 * np.pi) - np.pi,
        speed_mps=np.maximum(speed + np.nan_to_num(accel) * age_s, 0.0),
        accel_mps2=accel,
        steering_angle_deg=read("steering_angle_deg"),
        length_m=read("length_m"),
        width_m=read("width_m"),
        age_s=age_s,
        accuracy_m=np.maximum(np.nan_to_num(read("semi_major_m"), nan=USUAL_ACCURACY_M), LEAST_ACCURACY_M),
    )
