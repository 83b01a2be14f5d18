"""What the tracker tells the sensors' measurements, and what they tell it: one tick of one drive.

Positions are in the ego's frame: x ahead and y to the right of its centre, z up from the ground, in m. Headings are
relative to the ego's and clockwise, so a vehicle at heading h points along (cos h, sin h).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Floats, Integers


@dataclass(frozen=True)
class Predicted:
    """Vehicles that the tracker expects at this tick, V of them."""

    vehicle_id: Integers
    """(V,), unique."""
    centre_m: Floats
    """(V, 2) x and y of the box's centre."""
    covariance_m2: Floats
    """(V, 2, 2) covariance of `centre_m`."""
    heading_rad: Floats
    """(V,) relative to the ego's, clockwise."""
    size_m: Floats
    """(V, 2) length and width; NaN where unknown."""


@dataclass(frozen=True)
class Measured:
    """Positions measured by the LiDAR at this tick, M of them: at most one per predicted vehicle."""

    row: Integers
    """(M,) index into `Predicted`, or -1 for a vehicle that was not predicted."""
    centre_m: Floats
    """(M, 2) x and y of the box's centre."""
    covariance_m2: Floats
    """(M, 2, 2) covariance of `centre_m`: range noise, spacing of the beams, unknown size and side."""
    cluster: Integers
    """(M,) number of the cluster that its returns are from; the one with most of them where there are several."""
    lean: Floats
    """(M,) by how much the centre moves ahead per half metre that the vehicle is longer: 1 where the rear is exact and
    the front follows from the length, -1 where the front is exact, 0 where both are."""
    size_m: Floats
    """(M, 2) length and width that the centre was computed with: as predicted, else as seen, else usual ones."""


@dataclass(frozen=True)
class LidarMeasurement:
    """Result of one scan."""

    measured: Measured
    clusters: Mapping[str, npt.NDArray[np.generic]]
    """Columns of LIDAR_CLUSTERS without place and tick, (C,) each."""
    association: Mapping[str, npt.NDArray[np.generic]]
    """`cluster`, `side`, `distance_m`, `gate` and `candidates` of ASSOCIATION, (M,) each, in the order of `measured`;
    distance and gate are NaN where row is -1."""


@dataclass(frozen=True)
class Camera:
    """Pinhole camera that looks along the ego's axis, as in the table `drives`."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    x_m: float
    y_m: float
    z_m: float


@dataclass(frozen=True)
class CameraMeasurement:
    """What B camera boxes tell of the predicted vehicles; NaN where a box is no vehicle's."""

    row: Integers
    """(B,) index into `Predicted`, or -1."""
    bearing_rad: Floats
    """(B,) of the vehicle's centre from the camera: atan2(y, x), clockwise from straight ahead."""
    bearing_variance_rad2: Floats
    """(B,)."""
    range_m: Floats
    """(B,) from the camera to the vehicle's centre, from the box's width and the vehicle's: a weak measurement."""
    range_variance_m2: Floats
    """(B,)."""


@dataclass(frozen=True)
class Scanner:
    """Place of the LiDAR in the ego's frame, as in the table `drives`."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 1.9
