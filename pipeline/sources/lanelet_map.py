"""Lanelet2 maps (`.osm`): the middle of each lane, in the plane of a recording's tracks."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import polars as pl

from tracklake.pipeline.sources.csv import open_raw
from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.pipeline.transforms.tracks.utm import find_zone, project_utm
from tracklake.schemas.arrays import Floats

SPACING_M = 1.0
"""Greatest distance of two points of a lanelet's middle, in m."""
POINT_SCHEMA = {"lanelet": pl.Int64(), "x_m": pl.Float64(), "y_m": pl.Float64(), "angle_rad": pl.Float64()}
POINT_SCHEMA |= {"width_m": pl.Float64()}
"""Columns of points of lanelets' middles: place and direction in the plane of the tracks, and the lanelet's width."""


@dataclass(frozen=True)
class LaneletMap:
    """The lanelets of a map: rows of POINT_SCHEMA, the number of lanelets, and of those whose bounds are missing."""

    points: pl.DataFrame
    lanelets: int
    skipped: int


def is_lanelet_map(head: bytes) -> bool:
    """Recognise an OSM file by its first bytes."""
    return b"<osm" in head[:2000]


def read_lanelet_map(file: RawFile, lon_deg: float, origin_m: tuple[float, float]) -> LaneletMap:
    """Read the lanelets of a map; those with bounds that are not in the file are skipped and counted.

    Args:
        file: map.
        lon_deg: longitude of the site, which tells the UTM zone.
        origin_m: easting and northing of the tracks' origin.

    Raises:
        SourceError: the file is no whole XML file, or holds no lanelet.
    """
    try:
        with open_raw(file) as handle:
            root = ElementTree.fromstring(handle.read())
    except ElementTree.ParseError as damage:
        raise SourceError(
            f"{file.name}: damaged or cut short ({damage}). Expected a Lanelet2 map (.osm). Restore it, or move it "
            "away: then road axes are fitted to the tracks."
        ) from None
    nodes = {node.get("id"): (_number(node, "lat"), _number(node, "lon")) for node in root.iter("node")}
    ways = {way.get("id"): [nodes.get(each.get("ref")) for each in way.iter("nd")] for way in root.iter("way")}
    relations = [relation for relation in root.iter("relation") if _read_tags(relation).get("type") == "lanelet"]
    zone = find_zone(lon_deg)
    frames, skipped = [], 0
    for relation in relations:
        bounds = [
            _join_ways(
                [ways.get(member.get("ref")) for member in relation.iter("member") if member.get("role") == role]
            )
            for role in ("left", "right")
        ]
        identity = relation.get("id", "")
        left, right = (
            None if bound is None else np.stack(project_utm(bound[:, 0], bound[:, 1], zone), 1) - origin_m
            for bound in bounds
        )
        if left is None or right is None or not identity.lstrip("-").isdigit():
            skipped += 1
            continue
        frames.append(_find_middle(int(identity), left, right))
    if not frames:
        raise SourceError(
            f"{file.name}: no lanelet in it ({len(relations)} without their bounds). Expected a Lanelet2 map (.osm). "
            "Restore it, or move it away: then road axes are fitted to the tracks."
        )
    return LaneletMap(pl.concat(frames), len(frames), skipped)


def _number(node: ElementTree.Element, name: str) -> float:
    try:
        return float(node.get(name, "nan"))
    except ValueError:
        return math.nan


def _read_tags(element: ElementTree.Element) -> Mapping[str | None, str | None]:
    return {tag.get("k"): tag.get("v") for tag in element.iter("tag")}


def _join_ways(ways: Sequence[list[tuple[float, float] | None] | None]) -> Floats | None:
    """Join a bound's ways into places (N, 2) in degrees; None where one, or a node of it, is missing."""
    found = [node for way in ways if way is not None for node in way if node is not None and math.isfinite(sum(node))]
    expected = sum(len(way) for way in ways if way is not None)
    if None in ways or len(found) < max(2, expected):
        return None
    return np.array(found)


def _find_middle(lanelet: int, left: Floats, right: Floats) -> pl.DataFrame:
    """Find the points of a lanelet's middle, in its direction: its left bound (N, 2) lies to the left of it."""
    if np.hypot(*(left[0] - right[0])) > np.hypot(*(left[0] - right[-1])):
        right = right[::-1]
    longest = max(_measure_ways(bound)[-1] for bound in (left, right))
    count = max(3, math.ceil(longest / SPACING_M) + 1)
    left, right = (_resample(bound, count) for bound in (left, right))
    middle = (left + right) / 2
    ahead, aside = middle[-1] - middle[0], (left - right).mean(axis=0)
    if ahead[0] * aside[1] - ahead[1] * aside[0] < 0:
        middle, left, right = middle[::-1], left[::-1], right[::-1]
    step = np.gradient(middle, axis=0)
    return pl.DataFrame(
        {
            "lanelet": np.full(count, lanelet),
            "x_m": middle[:, 0],
            "y_m": middle[:, 1],
            "angle_rad": np.arctan2(step[:, 1], step[:, 0]),
            "width_m": np.hypot(*(left - right).T),
        },
        schema=POINT_SCHEMA,
    )


def _measure_ways(line: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])


def _resample(line: Floats, count: int) -> Floats:
    """Return so many points (N, 2) at equal distances along a line."""
    ways = _measure_ways(line)
    at = np.linspace(0.0, ways[-1], count)
    return np.stack([np.interp(at, ways, line[:, axis]) for axis in (0, 1)], 1)
