"""The road of an overhead recording on the WGS-84 ellipsoid.

This code is independent of the conversion that reads messages, so that one can be checked by the other.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Floats


@dataclass(frozen=True)
class Road:
    """The road's place on the earth: where x = y = 0 lies, near Cologne as highD's sites, and where x leads."""

    lat_deg: float = 50.94
    lon_deg: float = 6.80
    elevation_m: float = 110.0
    bearing_deg: float = 57.0


SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Axis and flattening of the WGS-84 ellipsoid."""
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
"""Squared eccentricity of the WGS-84 ellipsoid."""


def locate(road: Road, x_m: Floats, y_m: Floats) -> Mapping[str, Floats]:
    """Return WGS-84 latitude, longitude and elevation of places on the plane that touches the earth at the origin."""
    bearing, lat, lon = (np.radians(each) for each in (road.bearing_deg, road.lat_deg, road.lon_deg))
    east = x_m * np.sin(bearing) + y_m * np.cos(bearing)
    north = x_m * np.cos(bearing) - y_m * np.sin(bearing)
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    from_axis = (normal + road.elevation_m) * np.cos(lat) - north * np.sin(lat)
    ecef_x = from_axis * np.cos(lon) - east * np.sin(lon)
    ecef_y = from_axis * np.sin(lon) + east * np.cos(lon)
    ecef_z = (normal * (1 - ECCENTRICITY2) + road.elevation_m) * np.sin(lat) + north * np.cos(lat)
    return _to_geodetic(ecef_x, ecef_y, ecef_z)


def _to_geodetic(x: Floats, y: Floats, z: Floats) -> Mapping[str, Floats]:
    """Invert geodetic to ECEF: Bowring's formula, once iterated, is exact to less than a nanometre near the ground."""
    flat = np.hypot(x, y)
    reduced = np.arctan2(z, flat * (1 - FLATTENING))
    lat = reduced
    for _ in range(2):
        lat = np.arctan2(
            z + ECCENTRICITY2 / (1 - FLATTENING) * SEMI_MAJOR_M * np.sin(reduced) ** 3,
            flat - ECCENTRICITY2 * SEMI_MAJOR_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan((1 - FLATTENING) * np.tan(lat))
    normal = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY2 * np.sin(lat) ** 2)
    elevation_m = flat * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR_M**2 / normal
    return {"lat_deg": np.degrees(lat), "lon_deg": np.degrees(np.arctan2(y, x)), "elevation_m": elevation_m}
