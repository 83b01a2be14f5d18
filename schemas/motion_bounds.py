"""Bounds of a vehicle's motion along the road by its class, which reconstructed tracks keep and a rule checks."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class MotionBounds:
    """Bounds of a vehicle's motion along the road.

    The greatest acceleration is `accel_at_rest_mps2` at rest and falls linearly with speed by `accel_fall_per_s` per
    m/s (Long 2000, Acceleration Characteristics of Starting Vehicles), but not below `least_accel_mps2`.

    Args:
        braking_mps2: greatest deceleration, a positive number.
        jerk_mps3: greatest change of acceleration per second, of either sign.
    """

    accel_at_rest_mps2: float
    accel_fall_per_s: float
    least_accel_mps2: float
    braking_mps2: float
    jerk_mps3: float


BOUNDS: Mapping[str, MotionBounds] = MappingProxyType(
    {
        "car": MotionBounds(5.0, 0.09, 2.0, 8.0, 15.0),
        "truck": MotionBounds(2.7, 0.06, 1.0, 7.0, 15.0),
        "motorcycle": MotionBounds(7.2, 0.10, 3.0, 8.0, 15.0),
    }
)
"""Bounds of motion by the vehicle's class; a vehicle of unknown class has those of DEFAULT_CLASS."""
DEFAULT_CLASS = "car"
