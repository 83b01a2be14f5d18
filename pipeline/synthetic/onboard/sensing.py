"""What the instruments of one car of an overhead recording would have logged, and the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.onboard import gnss, radio
from tracklake.pipeline.synthetic.onboard.camera import Camera, Image, take_image
from tracklake.pipeline.synthetic.onboard.earth import Road, locate
from tracklake.pipeline.synthetic.onboard.lidar import Boxes, Lidar, Scan, cast_rays
from tracklake.pipeline.synthetic.onboard.motion import Motion, compute_motion
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.drives import TICK_RATE_HZ
from tracklake.schemas.errors import UsageError
from tracklake.schemas.text import suggest_name

RECORDING_START_US = 1_715_666_400_000_000
"""Moment at which every recording begins, 2024-05-14 06:00 UTC: recordings in a lake state no dates."""
TICK_US = 1_000_000 // TICK_RATE_HZ
"""Microseconds from tick to tick."""
ACCEL_NOISE_MPS2, YAW_RATE_NOISE_DEGPS = 0.1, 0.2
"""Standard deviations of a vehicle's inertial sensors."""


@dataclass(frozen=True)
class InstrumentConfig:
    """What is instrumented, and how well.

    Args:
        seed: seed of all noise; the same gives the same bytes.
        penetration: share of the vehicles, apart from the ego, that send messages.
        receiver: name of gnss.RECEIVERS, for all vehicles.
        heading_error_deg: constant error of each vehicle's heading, to the left or right by chance.
        lidar: scanner of the ego; None: it has none.
        camera: camera of the ego; None: it has none.
        channel: radio channel and clocks.
        road: place of the road on the earth.
    """

    seed: int = 1
    penetration: float = 0.6
    receiver: str = "plain"
    heading_error_deg: float = 1.0
    lidar: Lidar | None = field(default_factory=Lidar)
    camera: Camera | None = field(default_factory=Camera)
    channel: radio.Radio = field(default_factory=radio.Radio)
    road: Road = field(default_factory=Road)

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        if not 0 <= self.penetration <= 1:
            raise UsageError(f"penetration: expected a share from 0 to 1, got {self.penetration:g}")
        if self.receiver not in gnss.RECEIVERS:
            raise UsageError(f"receiver {self.receiver!r}: {suggest_name(self.receiver, gnss.RECEIVERS)}")
        if not 0 <= self.heading_error_deg <= 45:
            raise UsageError(f"heading error: expected 0 to 45 degrees, got {self.heading_error_deg:g}")
        if self.seed < 0:
            raise UsageError(f"seed: expected a whole number from 0, got {self.seed}")


@dataclass(frozen=True)
class SensedDrive:
    """What the instruments of an ego logged, and what was there."""

    start_us: int
    """Moment of tick 0, in microseconds since 1970."""
    messages: pl.DataFrame
    """Sent and received messages with the columns that writers of messages take, in the order of their arrival."""
    scans: tuple[Scan, ...]
    """One per tick, or none."""
    images: tuple[Image, ...]
    """One per tick, or none."""
    seen: tuple[Integers, ...]
    """Vehicles of `motion` that the boxes of each tick's scan and image stand for."""
    truth: pl.DataFrame
    motion: Motion


def sense_drive(
    tracks: pl.DataFrame,
    vehicles: pl.DataFrame,
    facts: Mapping[str, Any],
    ego_id: int,
    config: InstrumentConfig,
) -> SensedDrive:
    """Compute what the instruments of a vehicle logged; the arguments are those of `instrument_drive`."""
    motion = compute_motion(tracks, vehicles, ego_id, facts["subset"])
    place = [config.seed, crc32(f"{facts['dataset']}/{facts['subset']}".encode())]
    own = [np.random.default_rng([*place, ego_id, number]) for number in range(4)]
    connected = radio.draw_connected(np.random.default_rng(place), motion.vehicle_id, config.penetration)
    connected[motion.ego] = True
    sent = radio.draw_transmissions(own[0], config.channel, *motion.x_m.shape, ego=motion.ego)
    start_us = RECORDING_START_US + round(motion.time_s[0] * TICK_RATE_HZ) * TICK_US
    measured = _measure(motion, config, sent, own[1])
    seen, boxes = _list_boxes(motion)
    scans = tuple(cast_rays(config.lidar, each, own[2]) for each in boxes) if config.lidar else ()
    images = tuple(take_image(config.camera, each, own[3]) for each in boxes) if config.camera else ()
    visible = np.full(motion.x_m.shape, np.nan)
    for tick, scan in enumerate(scans):
        visible[tick, seen[tick]] = scan.visible
    arrives = radio.select_received(sent, config.channel, measured["distance_m"]) & connected
    arrives[:, motion.ego] = ~np.isnan(measured["distance_m"][:, motion.ego])
    # The log begins with tick 0: what was stamped before is not in it, so that all files begin at the same moment.
    arrives &= (sent.stamped_ms >= 0) & (sent.arrived_ms <= (len(motion.time_s) - 1) * radio.PERIOD_MS)
    messages = _list_messages(motion, config, sent, measured, arrives, start_us)
    truth = _list_truth(motion, config, sent, connected, visible, facts)
    return SensedDrive(start_us, messages, scans, images, seen, truth, motion)


def _measure(
    motion: Motion, config: InstrumentConfig, sent: radio.Transmissions, random: np.random.Generator
) -> dict[str, Floats]:
    """Return what each vehicle measures of itself when it sends, and how far it is from the ego then, (T, V) each."""
    ticks, vehicles = shape = motion.x_m.shape
    weight = (sent.sent_ms - np.arange(ticks)[:, None] * radio.PERIOD_MS) / radio.PERIOD_MS

    def interpolate(values: Floats) -> Floats:
        after = np.concatenate((values[1:], np.full((1, vehicles), np.nan)))
        return values + np.where(weight > 0, weight * (after - values), 0)

    x_m, y_m, yaw_rad, speed_mps = map(interpolate, (motion.x_m, motion.y_m, motion.yaw_rad, motion.speed_mps))
    accel_mps2, yaw_rate, steering_deg = map(
        interpolate, (motion.accel_mps2, motion.yaw_rate_radps, motion.steering_deg)
    )
    ego_x_m, ego_y_m = (
        interpolate(np.repeat(all_m[:, [motion.ego]], vehicles, 1)) for all_m in (motion.x_m, motion.y_m)
    )
    receiver = gnss.RECEIVERS[config.receiver]
    error_m = gnss.draw_positions(random, receiver, ticks, vehicles)
    heading_deg = config.road.bearing_deg + np.degrees(yaw_rad)
    heading_deg += gnss.draw_headings(random, config.heading_error_deg, ticks, vehicles)
    noise = {name: random.standard_normal(shape) for name in ("speed", "accel", "lateral", "yaw_rate")}
    return {
        **locate(config.road, x_m + error_m[..., 0], y_m + error_m[..., 1]),
        "distance_m": np.hypot(x_m - ego_x_m, y_m - ego_y_m),
        "signed_mps": speed_mps,
        "speed_mps": np.maximum(np.abs(speed_mps) + receiver.speed_mps * noise["speed"] * (speed_mps != 0), 0),
        "heading_deg": heading_deg % 360,
        "accel_mps2": accel_mps2 + ACCEL_NOISE_MPS2 * noise["accel"],
        "lateral_accel_mps2": speed_mps * yaw_rate + ACCEL_NOISE_MPS2 * noise["lateral"],
        "yaw_rate_degps": np.degrees(yaw_rate) + YAW_RATE_NOISE_DEGPS * noise["yaw_rate"],
        "steering_angle_deg": steering_deg,
    }


def _list_messages(
    motion: Motion,
    config: InstrumentConfig,
    sent: radio.Transmissions,
    measured: Mapping[str, Floats],
    arrives: Flags,
    start_us: int,
) -> pl.DataFrame:
    """List the messages that arrive, in the order of their arrival, and the ego's own."""
    tick, vehicle = np.nonzero(arrives)
    accuracy_m = gnss.RECEIVERS[config.receiver].accuracy_m
    names = [name for name in measured if name not in ("distance_m", "signed_mps")]
    own = vehicle == motion.ego
    return (
        pl.DataFrame(
            {
                "utc_us": start_us + 1000 * sent.stamped_ms[tick, vehicle],
                "arrived_us": start_us + np.rint(1000 * sent.arrived_ms[tick, vehicle]).astype(np.int64),
                "own": own,
                "sender": motion.vehicle_id[vehicle],
                "temporary_id": write_ids(sent.temporary_id[tick, vehicle]),
                "message_count": sent.counter[tick, vehicle],
                **{name: measured[name][tick, vehicle] for name in names},
                "backwards": measured["signed_mps"][tick, vehicle] < 0,
                "length_m": motion.size_m[vehicle, 0],
                "width_m": motion.size_m[vehicle, 1],
            }
        )
        .sort("arrived_us", "sender")
        .with_columns(
            pl.col("sender").cast(pl.String),
            pl.col("message_count").cast(pl.Int16),
            line=pl.int_range(1, pl.len() + 1),
            receiver=pl.lit(str(motion.vehicle_id[motion.ego])),
            received_us=pl.when("own").then(None).otherwise("arrived_us"),
            second_mark_ms=(pl.col("utc_us") // 1000 % 60_000).cast(pl.Int32),
            vertical_accel_mps2=pl.lit(0.0),
            semi_major_m=pl.lit(accuracy_m),
            semi_minor_m=pl.lit(accuracy_m),
            orientation_deg=pl.lit(0.0),
            transmission=pl.when("backwards").then(pl.lit("reverseGears")).otherwise(pl.lit("forwardGears")),
        )
        .drop("arrived_us", "backwards")
    )


def write_ids(ids: Integers) -> pl.Series:
    """Write temporary ids as 8 hex digits."""
    octets = pl.Series(ids.astype(np.uint32).byteswap().view("V4").tolist(), dtype=pl.Binary)
    return octets.bin.encode("hex").str.to_uppercase()


def _list_boxes(motion: Motion) -> tuple[tuple[Integers, ...], tuple[Boxes, ...]]:
    """Return at each tick which vehicles but the ego are there, and their boxes in the ego's frame."""
    ahead_m, aside_m, turn_rad = motion.place_relative()
    there = ~np.isnan(ahead_m)
    there[:, motion.ego] = False
    seen = tuple(np.flatnonzero(row) for row in there)
    boxes = (
        Boxes(ahead_m[tick, own], aside_m[tick, own], turn_rad[tick, own], motion.size_m[own])
        for tick, own in enumerate(seen)
    )
    return seen, tuple(boxes)


def _list_truth(
    motion: Motion,
    config: InstrumentConfig,
    sent: radio.Transmissions,
    connected: Flags,
    visible: Floats,
    facts: Mapping[str, Any],
) -> pl.DataFrame:
    """List where the vehicles within the radio's range truly are at each tick."""
    ahead_m, aside_m, turn_rad = motion.place_relative()
    near = np.hypot(ahead_m, aside_m) <= config.channel.range_m
    near[:, motion.ego] = False
    tick, vehicle = np.nonzero(near)
    ego = {
        name: values[tick, motion.ego]
        for name, values in (
            ("ego_speed_mps", motion.speed_mps),
            ("ego_yaw_deg", np.degrees(motion.yaw_rad)),
            ("ego_x_m", motion.x_m),
            ("ego_y_m", motion.y_m),
            ("ego_lane", motion.lane),
        )
    }
    return pl.DataFrame(
        {
            "truth_id": motion.vehicle_id[vehicle],
            "tick": tick,
            "truth_dataset": [facts["dataset"]] * len(tick),
            "truth_subset": [facts["subset"]] * len(tick),
            "connected": connected[vehicle],
            "rel_x_m": ahead_m[tick, vehicle],
            "rel_y_m": aside_m[tick, vehicle],
            "rel_heading_deg": (np.degrees(turn_rad[tick, vehicle]) + 180) % 360 - 180,
            "speed_mps": motion.speed_mps[tick, vehicle],
            "accel_mps2": motion.accel_mps2[tick, vehicle],
            **ego,
            "lane": motion.lane[tick, vehicle],
            "length_m": motion.size_m[vehicle, 0],
            "width_m": motion.size_m[vehicle, 1],
            "visible": visible[tick, vehicle],
            "temporary_id": write_ids(sent.temporary_id[tick, vehicle]),
        }
    ).with_columns(
        pl.when("connected").then("temporary_id").alias("temporary_id"),
        pl.col("accel_mps2", "visible").fill_nan(None),
        pl.col("lane", "ego_lane").fill_nan(None).cast(pl.Int16),
    )
