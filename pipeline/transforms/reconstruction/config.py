"""Settings of the reconstruction: noise, weights of smoothness, longest filled gap, bounds of motion by class."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType


@dataclass(frozen=True)
class MotionBounds:
    """Bounds of a vehicle's motion along the road.

    The acceleration may reach `accel_at_rest_mps2` at standstill; the bound falls linearly with speed, by
    `accel_fall_per_s` per m/s, down to `accel_least_mps2`.

    Args:
        braking_mps2: greatest deceleration, a positive number.
        jerk_mps3: greatest change of acceleration per second, of either sign.
    """

    accel_at_rest_mps2: float
    accel_fall_per_s: float
    accel_least_mps2: float
    braking_mps2: float
    jerk_mps3: float


CAR = MotionBounds(5.0, 0.10, 2.0, 8.0, 15.0)
TRUCK = MotionBounds(2.5, 0.06, 1.0, 7.0, 15.0)
MOTORCYCLE = MotionBounds(7.0, 0.10, 3.0, 9.0, 15.0)
BOUNDS = MappingProxyType({"car": CAR, "truck": TRUCK, "motorcycle": MOTORCYCLE})
"""Bounds of motion by the vehicle's class; a vehicle of unknown class has a car's."""


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
