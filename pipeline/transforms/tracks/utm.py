"""The plane of UTM: WGS-84 degrees to metres, by Krueger's series to the third power (0.1 mm within a zone)."""

import numpy as np

from tracklake.schemas.arrays import Floats

SEMI_MAJOR_M, FLATTENING = 6_378_137.0, 1 / 298.257223563
"""Axis and flattening of the WGS-84 ellipsoid."""
SCALE, FALSE_EASTING_M, FALSE_NORTHING_M = 0.9996, 500_000.0, 10_000_000.0
"""Scale on the central meridian, and what is added to eastings, and to northings in the south."""
THIRD = FLATTENING / (2 - FLATTENING)
"""Third flattening of the ellipsoid."""
RADIUS_M = SEMI_MAJOR_M / (1 + THIRD) * (1 + THIRD**2 / 4 + THIRD**4 / 64)
"""Radius of the circle that is as long as a meridian, in m."""
SERIES = (
    THIRD / 2 - 2 * THIRD**2 / 3 + 5 * THIRD**3 / 16,
    13 * THIRD**2 / 48 - 3 * THIRD**3 / 5,
    61 * THIRD**3 / 240,
)
"""Coefficients of Krueger's series."""


def find_zone(lon_deg: float) -> int:
    """Return the number of the UTM zone of a longitude; the exceptions of Norway and Svalbard are not made."""
    return int((lon_deg + 180) // 6) % 60 + 1


def project_utm(lat_deg: Floats, lon_deg: Floats, zone: int) -> tuple[Floats, Floats]:
    """Return easting and northing in m of places (N,) in a zone."""
    lat, lon = np.radians(lat_deg), np.radians(lon_deg - (6 * zone - 183))
    root = 2 * np.sqrt(THIRD) / (1 + THIRD)
    slope = np.sinh(np.arctanh(np.sin(lat)) - root * np.arctanh(root * np.sin(lat)))
    north, east = np.arctan2(slope, np.cos(lon)), np.arctanh(np.sin(lon) / np.sqrt(1 + slope**2))
    easting, northing = east.copy(), north.copy()
    for place, factor in enumerate(SERIES, start=1):
        easting += factor * np.cos(2 * place * north) * np.sinh(2 * place * east)
        northing += factor * np.sin(2 * place * north) * np.cosh(2 * place * east)
    false_northing = np.where(lat < 0, FALSE_NORTHING_M, 0.0)
    return FALSE_EASTING_M + SCALE * RADIUS_M * easting, false_northing + SCALE * RADIUS_M * northing
