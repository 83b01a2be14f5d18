"""Lanelet2 maps of the sample's bent roads: the lanes of each carriageway, in sections."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tracklake.pipeline.synthetic.bent_roads import BEYOND_M, Line
from tracklake.pipeline.synthetic.onboard.earth import FLATTENING, SEMI_MAJOR_M
from tracklake.pipeline.synthetic.scenarios import RAMP_VISIBLE_M, WEAVE_BEGINS_M, WEAVE_ENDS_M, Road
from tracklake.pipeline.synthetic.sumo import MERGE_M
from tracklake.schemas.arrays import Floats, Integers

SITE_DEG = (50.981, 6.912)
"""Latitude and longitude of the sample's site, which is none."""
ORIGIN_M = (353_430.0, 5_649_820.0)
"""Easting and northing of the tracks' origin, UTM zone 32."""
ZONE_DEG = 9.0
"""Central meridian of UTM zone 32."""
NODE_M = 5.0
"""Distance of two nodes of a lane's bound, in m."""


@dataclass(frozen=True)
class Lanelets:
    """The lanelets of one carriageway: (L,) arrays of ids, lanes, and where they begin and end along the line.

    `ramp_lane` is the lane of the on-ramp, 0 without one; `last_lane` the rightmost main lane.
    """

    line: Line
    ids: Integers
    lanes: Integers
    begin_m: Floats
    end_m: Floats
    width_m: float
    last_lane: int
    ramp_lane: int

    def find(self, along_m: Floats, lanes: Integers) -> Integers:
        """Return the lanelet of each place (N,), by its lane; that of a lane's nearest section."""
        outside = np.maximum(self.begin_m - along_m[:, None], along_m[:, None] - self.end_m)
        away = np.abs(self.lanes - lanes[:, None]) * 1e6 + np.maximum(outside, 0.0)
        found: Integers = away.argmin(axis=1)
        return found

    def find_middle(self, place: Integers, along_m: Floats) -> Floats:
        """Return how far the lanelets' middles are to the right of the line at places (N,)."""
        closing = np.clip((WEAVE_BEGINS_M - along_m) / MERGE_M, 0, 1)
        ramp = self.last_lane + 0.5 + closing**2 * (3 - 2 * closing)
        across = np.where(self.lanes[place] == self.ramp_lane, ramp, self.lanes[place] - 0.5)
        middle: Floats = across * self.width_m
        return middle


def list_lanelets(road: Road, line: Line, side: int) -> Lanelets:
    """List the lanelets of a carriageway; the ids of the two sides (0, 1) differ."""
    end = road.window_m + BEYOND_M / 2
    sections = [(-BEYOND_M / 2, end)] if not road.ramp else [
        (-BEYOND_M / 2, WEAVE_BEGINS_M), (WEAVE_BEGINS_M, WEAVE_ENDS_M), (WEAVE_ENDS_M, end)
    ]  # fmt: skip
    lanelets = [
        (2_000 * side + 100 * section + lane, lane, *section_m)
        for section, section_m in enumerate(sections)
        for lane in range(1, road.lanes + 1 + (road.ramp and section == 1))
    ]
    if road.ramp:
        lanelets.append((2_000 * side + 90, road.lanes + 2, RAMP_VISIBLE_M - 10, WEAVE_BEGINS_M))
    ids, lanes, begins, ends = (np.array(values) for values in zip(*lanelets, strict=True))
    ramp_lane = road.lanes + 2 if road.ramp else 0
    return Lanelets(line, ids + 1_000, lanes, begins, ends, road.lane_width_m, road.lanes, ramp_lane)


def write_map(path: Path, carriageways: Iterable[Lanelets]) -> int:
    """Write a Lanelet2 map with two ways for each lanelet; returns the number of lanelets."""
    nodes: list[str] = []
    ways: list[str] = []
    relations: list[str] = []
    for lanelets in carriageways:
        for place, identity in enumerate(lanelets.ids.tolist()):
            begin, end = float(lanelets.begin_m[place]), float(lanelets.end_m[place])
            along = np.linspace(begin, end, int((end - begin) / NODE_M) + 2)
            middle = lanelets.find_middle(np.full(len(along), place), along)
            for shift in (-0.5, 0.5):
                x, y, _ = lanelets.line.locate(along, middle + shift * lanelets.width_m)
                lat, lon = _find_degrees(x, y)
                first = len(nodes) + 1
                nodes += [f'<node id="{first + i}" lat="{lat[i]:.9f}" lon="{lon[i]:.9f}"/>' for i in range(len(along))]
                refs = "".join(f'<nd ref="{first + i}"/>' for i in range(len(along)))
                ways.append(f'<way id="{len(ways) + 1}">{refs}<tag k="type" v="line_thin"/></way>')
            bounds = ((len(ways) - 1, "left"), (len(ways), "right"))
            members = "".join(f'<member type="way" ref="{way}" role="{role}"/>' for way, role in bounds)
            tags = '<tag k="type" v="lanelet"/><tag k="subtype" v="highway"/>'
            relations.append(f'<relation id="{identity}">{members}{tags}</relation>')
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "\n".join(['<?xml version="1.0"?>', '<osm version="0.6">', *nodes, *ways, *relations, "</osm>", ""])
    path.write_bytes(text.encode())
    return len(relations)


def _find_degrees(x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
    """Find latitudes and longitudes of places (N,) in the plane of the tracks, by Krueger's inverse series."""
    n = FLATTENING / (2 - FLATTENING)
    radius = 0.9996 * SEMI_MAJOR_M / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    north, east = (y_m + ORIGIN_M[1]) / radius, (x_m + ORIGIN_M[0] - 500_000) / radius
    back = (n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96, n**2 / 48 + n**3 / 15, 17 * n**3 / 480)
    turned = [
        (factor * np.sin(2 * k * north) * np.cosh(2 * k * east), factor * np.cos(2 * k * north) * np.sinh(2 * k * east))
        for k, factor in enumerate(back, start=1)
    ]
    along, aside = north - sum(each for each, _ in turned), east - sum(each for _, each in turned)
    conformal = np.arcsin(np.sin(along) / np.cosh(aside))
    series = (2 * n - 2 * n**2 / 3 - 2 * n**3, 7 * n**2 / 3 - 8 * n**3 / 5, 56 * n**3 / 15)
    lat = conformal + sum(factor * np.sin(2 * k * conformal) for k, factor in enumerate(series, start=1))
    return np.degrees(lat), ZONE_DEG + np.degrees(np.arctan2(np.sinh(aside), np.cos(along)))
