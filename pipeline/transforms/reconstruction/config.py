"""Settings of the reconstruction: noise, weights of smoothness, longest filled gap, bounds of motion by class."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from tracklake.schemas.motion_bounds import BOUNDS as BOUNDS
from tracklake.schemas.motion_bounds import DEFAULT_CLASS as DEFAULT_CLASS
from tracklake.schemas.motion_bounds import MotionBounds as MotionBounds


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
