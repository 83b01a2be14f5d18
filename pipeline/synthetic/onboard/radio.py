"""V2V radio: who sends, what arrives at the ego and when, under which temporary ids, counters and clocks."""

from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.drives import TICK_RATE_HZ

COUNTERS, IDS = 128, 2**32
"""Numbers of message counters, and of temporary ids, which have 4 bytes."""
PERIOD_MS = 1000 // TICK_RATE_HZ
"""Time from message to message of a sender, in ms."""


@dataclass(frozen=True)
class Radio:
    """The channel and the senders' clocks.

    Args:
        range_m: distance at which nothing is received any more.
        loss: share of messages lost near the ego; it grows to 1 with the fourth power of distance / range.
        bursts_per_min: losses of everything from one sender per minute, each `burst_s` long on average.
        burst_s: mean length of such a loss, in s.
        latency_s: mean time from generation to reception; half of it is constant, the rest exponential.
        id_change_s: time after which a sender takes another temporary id and counter.
        clock_offset_s: standard deviation of the senders' clocks against the ego's.
        clock_steps: share of the senders whose clock jumps once during the drive, by 0.1 to 0.5 s.
    """

    range_m: float = 300.0
    loss: float = 0.02
    bursts_per_min: float = 1.0
    burst_s: float = 0.4
    latency_s: float = 0.03
    id_change_s: float = 300.0
    clock_offset_s: float = 0.002
    clock_steps: float = 0.02


@dataclass(frozen=True)
class Transmissions:
    """Messages that V vehicles send, one per tick, (T, V) each; times are ms since the first tick by the true clock."""

    sent_ms: Integers
    stamped_ms: Integers
    """Moment of sending by the sender's clock."""
    arrived_ms: Floats
    counter: Integers
    temporary_id: Integers
    fading: Floats
    """Drawn numbers from 0 to 1: a message arrives if that exceeds its share of loss."""
    burst: Flags
    """Whether a burst of losses swallows the message."""


def draw_connected(random: np.random.Generator, vehicle_id: Integers, penetration: float) -> Flags:
    """Draw which vehicles send messages; at a higher penetration the same ones do, and further ones.

    A vehicle has the draw of its id's number, so that who else is near changes nothing.

    Args:
        random: generator by PCG64, at its start.
        vehicle_id: (V,) ids, rising.
        penetration: share of the vehicles that send.
    """
    draws, skipped = random.bit_generator, np.diff(vehicle_id, prepend=-1) - 1
    assert isinstance(draws, np.random.PCG64)
    drawn = np.empty(len(vehicle_id))
    for vehicle, count in enumerate(skipped.tolist()):  # an array up to the greatest id could take gigabytes
        draws.advance(count)
        drawn[vehicle] = random.random()
    connected: Flags = drawn < penetration
    return connected


def draw_transmissions(
    random: np.random.Generator, radio: Radio, ticks: int, vehicles: int, *, ego: int
) -> Transmissions:
    """Draw when V vehicles send, and what becomes of their messages; the ego sends at the ticks, by the true clock."""
    shape = (ticks, vehicles)
    other = np.arange(vehicles) != ego
    sent_ms = np.arange(ticks)[:, None] * PERIOD_MS + random.integers(PERIOD_MS, size=vehicles) * other
    offset_ms = np.rint(1000 * radio.clock_offset_s * random.standard_normal(vehicles)) * other
    step_ms = np.rint(random.uniform(100, 500, vehicles) * np.where(random.random(vehicles) < 0.5, -1, 1))
    stepped = (random.random(vehicles) < radio.clock_steps * other) & (
        np.arange(ticks)[:, None] >= ticks * random.uniform(0.2, 0.8, vehicles)
    )
    latency_ms = 1000 * radio.latency_s * (0.5 + 0.5 * random.exponential(size=shape))
    period = (sent_ms + 1000 * radio.id_change_s * random.random(vehicles)) // (1000 * radio.id_change_s)
    periods = int(period.max(initial=0)) + 1
    # Counters and ids change together, so that nothing links one id to the next.
    first_counter = random.integers(COUNTERS, size=(periods, vehicles))
    ids = random.integers(1, IDS, size=(periods, vehicles))
    number = (period.astype(np.int64), np.arange(vehicles))
    burst = _draw_bursts(random, radio, shape)
    return Transmissions(
        sent_ms=sent_ms,
        stamped_ms=(sent_ms + offset_ms + np.where(stepped, step_ms, 0)).astype(np.int64),
        arrived_ms=sent_ms + latency_ms * other,
        counter=(first_counter[number] + np.arange(ticks)[:, None]) % COUNTERS,
        temporary_id=ids[number],
        fading=random.random(shape),
        burst=burst,
    )


def _draw_bursts(random: np.random.Generator, radio: Radio, shape: tuple[int, int]) -> Flags:
    """Draw, by a chain of two states, which messages are lost in bursts."""
    begins = random.random(shape) < radio.bursts_per_min / 60 / TICK_RATE_HZ
    lasts = random.random(shape) >= 1 / max(radio.burst_s * TICK_RATE_HZ, 1)
    burst = begins
    for tick in range(1, shape[0]):
        burst[tick] |= burst[tick - 1] & lasts[tick]
    return burst


def select_received(sent: Transmissions, radio: Radio, distance_m: Floats) -> Flags:
    """Return which messages arrive, by the distance in m at which they were sent, (T, V); NaN: not sent."""
    nearness = 1 - np.minimum(np.nan_to_num(distance_m, nan=np.inf) / radio.range_m, 1) ** 4
    return (sent.fading < (1 - radio.loss) * nearness) & ~sent.burst & ~np.isnan(distance_m)
