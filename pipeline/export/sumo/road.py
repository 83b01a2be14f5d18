"""The road of a subset as a network of SUMO: one straight edge with the recording's lanes.

SUMO's x is x_m; its y points up, so that it is -y_m. Lanes are counted from the right, beginning with 0.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

LANE_WIDTH_M = 3.66
"""Width of a lane where the recording tells none, in m: 12 ft."""
PLAUSIBLE_WIDTHS_M = (2.0, 5.0)
"""Range in which an estimated width of lanes is used, in m."""
MARGIN_M = 20.0
"""Length of the road before the first and after the last position, in m."""
SPEED_LIMIT_MPS = 100.0
"""Speed limit of the road, beyond all recorded speeds, in m/s."""


@dataclass(frozen=True)
class Road:
    """A straight road: its ends along x_m, and the y_m of the markings, leftmost first; `source` tells whence."""

    begin_m: float
    end_m: float
    markings_m: tuple[float, ...]
    source: str

    @property
    def lanes(self) -> int:
        """Number of lanes between the markings."""
        return len(self.markings_m) - 1


def find_road(tracks: pl.DataFrame, facts: Mapping[str, Any]) -> Road:
    """Find the road of a subset: lanes by its markings, else of equal width by the positions of the vehicles in them.

    Args:
        tracks: x_m, y_m, lane of the subset, not empty.
        facts: the subset's row of `subsets`.
    """
    x = tracks["x_m"].to_numpy()
    markings, source = _find_markings(tracks, facts)
    return Road(float(np.floor(x.min())) - MARGIN_M, float(np.ceil(x.max())) + MARGIN_M, tuple(markings), source)


def _find_markings(tracks: pl.DataFrame, facts: Mapping[str, Any]) -> tuple[list[float], str]:
    known = tracks.drop_nulls("lane").filter(pl.col("lane") >= 1)
    if known.is_empty():
        low, high = tracks["y_m"].to_numpy().min(), tracks["y_m"].to_numpy().max()
        return [low - LANE_WIDTH_M / 2, high + LANE_WIDTH_M / 2], "the recording has no lanes: one as wide as the road"
    lane, y = known["lane"].to_numpy().astype(np.float64), known["y_m"].to_numpy()
    most = int(lane.max())
    recorded = list(facts["lane_markings_m"] or ())
    if len(recorded) > most:
        return recorded, "the recording's markings"
    main = lane <= (facts["lanes"] or most)
    width = np.polyfit(lane[main], y[main], 1)[0] if len(np.unique(lane[main])) > 1 else LANE_WIDTH_M
    if not PLAUSIBLE_WIDTHS_M[0] <= width <= PLAUSIBLE_WIDTHS_M[1]:
        width = LANE_WIDTH_M
    left = float(np.mean(y[main] - (lane[main] - 0.5) * width)) if main.any() else 0.0
    return [left + number * float(width) for number in range(most + 1)], "estimated from the vehicles' positions"


def write_network(path: Path, road: Road) -> None:
    """Write the network: SUMO's lane 0 is the rightmost one, the recording's lane with the highest number."""
    begin, end, top, bottom = road.begin_m, road.end_m, -road.markings_m[0], -road.markings_m[-1]
    lanes = []
    for index in range(road.lanes):
        left, right = road.markings_m[-2 - index], road.markings_m[-1 - index]
        y = -(left + right) / 2
        lanes.append(
            f'        <lane id="road_{index}" index="{index}" speed="{SPEED_LIMIT_MPS:.2f}" length="{end - begin:.2f}" '
            f'width="{right - left:.3f}" shape="{begin:.3f},{y:.3f} {end:.3f},{y:.3f}"/>'
        )
    boundary = f"{begin:.2f},{bottom:.2f},{end:.2f},{top:.2f}"
    incoming = " ".join(f"road_{index}" for index in range(road.lanes))
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<net version="1.20">',
        f'    <location netOffset="0.00,0.00" convBoundary="{boundary}" origBoundary="{boundary}" projParameter="!"/>',
        '    <edge id="road" from="begin" to="end" priority="-1">',
        *lanes,
        "    </edge>",
        f'    <junction id="begin" type="dead_end" x="{begin:.2f}" y="{top:.2f}" incLanes="" intLanes="" '
        f'shape="{begin:.2f},{top:.2f} {begin:.2f},{bottom:.2f}"/>',
        f'    <junction id="end" type="dead_end" x="{end:.2f}" y="{top:.2f}" incLanes="{incoming}" intLanes="" '
        f'shape="{end:.2f},{bottom:.2f} {end:.2f},{top:.2f}"/>',
        "</net>",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
