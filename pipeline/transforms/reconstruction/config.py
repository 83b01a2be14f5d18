"""Settings of the reconstruction: noise, weights of smoothness, longest filled gap, bounds of motion by class."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType


@dataclass(frozen=True)
class MotionBounds:
    """Bounds of a vehicle's motion along the road.

    The greatest acceleration is `accel_mps2` up to the speed `full_accel_until_mps`; beyond, it falls linearly by
    `accel_fall_per_s` per m/s (Long 2000, Acceleration Characteristics of Starting Vehicles), but not below
    `least_accel_mps2`.

    Args:
        braking_mps2: greatest deceleration, a positive number.
        jerk_mps3: greatest change of acceleration per second, of either sign.
    """

    accel_mps2: float
    full_accel_until_mps: float
    accel_fall_per_s: float
    least_accel_mps2: float
    braking_mps2: float
    jerk_mps3: float


CAR = MotionBounds(3.5, 11.1, 0.07, 1.5, 8.0, 15.0)
TRUCK = MotionBounds(2.5, 2.8, 0.10, 0.8, 7.0, 15.0)
MOTORCYCLE = MotionBounds(6.0, 11.1, 0.10, 2.5, 10.0, 15.0)
BOUNDS = MappingProxyType({"car": CAR, "truck": TRUCK, "motorcycle": MOTORCYCLE})
"""Bounds of motion by the vehicle's class; a vehicle of unknown class has a car's."""
DEFAULT_CLASS = "car"


@dataclass(frozen=True)
class ReconstructionConfig:
    """Settings of the reconstruction; what is None is estimated from each recording.

    Args:
        noise_x_m: standard deviation of the recorded x_m's noise.
        noise_y_m: standard deviation of the recorded y_m's noise.
        weight_x_s6: weight of the squared third derivative of x_m.
        weight_y_s6: weight of the squared third derivative of y_m.
        max_gap_s: longest time between two entries that is filled; longer gaps are never bridged.
        bounds: bounds of motion along the road by class.
        lateral_accel_mps2: greatest lateral acceleration, of either sign.
    """

    noise_x_m: float | None = None
    noise_y_m: float | None = None
    weight_x_s6: float | None = None
    weight_y_s6: float | None = None
    max_gap_s: float = 2.0
    bounds: Mapping[str, MotionBounds] = field(default_factory=lambda: BOUNDS)
    lateral_accel_mps2: float = 3.0
