"""Positions on the WGS-84 ellipsoid in the frame of a vehicle that drives on it, and back.

    geodetic (latitude, longitude, height) -> ECEF -> plane tangent at the ego (east, north, up) -> the ego's frame

ECEF comes from PROJ (`+proj=cart`). The tangent plane has another origin at every row, so that its rotation is done
here, for all rows at once. Choi et al. (2021) print z = ((1 + e2) N + h) sin(lat) in equation (1); the ellipsoid is
z = ((1 - e2) N + h) sin(lat), which PROJ computes.
"""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from tracklake.schemas.arrays import Floats

if TYPE_CHECKING:
    from pyproj import Transformer

TO_ECEF = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
"""PROJ's pipeline from longitude and latitude in degrees and ellipsoidal height in m to ECEF in m."""


@cache
def _open_transformer() -> "Transformer":
    """Return PROJ's transformer of TO_ECEF, which may be used from several threads."""
    from pyproj import Transformer

    return Transformer.from_pipeline(TO_ECEF)


def convert_to_ecef(lat_deg: Floats, lon_deg: Floats, height_m: Floats) -> Floats:
    """Return (N, 3) Earth-centred, Earth-fixed positions in m of (N,) WGS-84 positions."""
    return np.stack(_open_transformer().transform(lon_deg, lat_deg, height_m), axis=-1)


def convert_to_geodetic(ecef_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitude (deg), longitude (deg) and height above the ellipsoid (m) of (N, 3) ECEF positions."""
    x_m, y_m, z_m = ecef_m.T
    lon_deg, lat_deg, height_m = _open_transformer().transform(x_m, y_m, z_m, direction="INVERSE")
    return lat_deg, lon_deg, height_m


def compute_axes(lat_deg: Floats, lon_deg: Floats) -> Floats:
    """Return (N, 3, 3) unit vectors east, north and up, the rows of each matrix, in ECEF at (N,) positions."""
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    rows = (
        (-sin_lon, cos_lon, np.zeros_like(lat)),
        (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat),
        (cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turn_by_heading(plane_m: Floats, heading_rad: Floats) -> Floats:
    """Turn (N, 2) vectors (east, north) into (ahead, right) of a heading clockwise from north, or back.

    The two frames have opposite handedness, so the matrix is a reflection and its own inverse.
    """
    sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
    first, second = plane_m[..., 0], plane_m[..., 1]
    return np.stack((first * sine + second * cosine, first * cosine - second * sine), axis=-1)


def place_in_ego_frame(positions: Floats, ego: Floats, heading_deg: Floats) -> Floats:
    """Return where positions lie in the frame of an ego, which may be another at every row.

    Args:
        positions: (N, 3) WGS-84 latitude (deg), longitude (deg) and height (m).
        ego: the same of the ego, (N, 3) or (1, 3).
        heading_deg: heading of the ego, clockwise from north, (N,) or (1,).

    Returns:
        (N, 3) ahead, right and up of the ego, in m.
    """
    delta_m = convert_to_ecef(*positions.T) - convert_to_ecef(*ego.T)
    enu_m = np.squeeze(compute_axes(ego[:, 0], ego[:, 1]) @ delta_m[..., None], -1)
    return np.concatenate((turn_by_heading(enu_m[:, :2], np.radians(heading_deg)), enu_m[:, 2:]), axis=1)


def locate_from_ego_frame(places_m: Floats, ego: Floats, heading_deg: Floats) -> Floats:
    """Return (N, 3) WGS-84 positions of places in an ego's frame: the inverse of `place_in_ego_frame`."""
    plane_m = turn_by_heading(places_m[:, :2], np.radians(heading_deg))
    enu_m = np.concatenate((plane_m, places_m[:, 2:]), axis=1)
    delta_m = np.squeeze(np.swapaxes(compute_axes(ego[:, 0], ego[:, 1]), 1, 2) @ enu_m[..., None], -1)
    return np.stack(convert_to_geodetic(convert_to_ecef(*ego.T) + delta_m), axis=1)
