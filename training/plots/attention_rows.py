"""The attention of one sample: what is drawn and written of it, as plain numbers and as rows for a chart."""

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.training.plots.picture import Picture
from tracklake.training.plots.rows import UNKNOWN_SIZE_M

Row = dict[str, Any]
Doubles = npt.NDArray[np.float64]

LANES = ("left", "own", "right")
EGO = "ego"
LEAST_MARGIN_M, MARGIN_SHARE = 6.0, 0.05
"""Drawn before and behind the outermost vehicles: the share of what they span, for their labels."""
VERGE_M = 2.5
"""Drawn beside the carriageway."""


@dataclass(frozen=True)
class AttentionMap:
    """One sample, the n vehicles of its scene and what they attend to. Vehicle 0 is the ego.

    Args:
        picture: the sample's moment.
        vehicle_id: n ids; unique within the subset.
        place_m: (n, 2) front centres, relative to the ego's: along the road, and across, positive to the right.
        size_m: (n, 2) length and width; 0 where unknown.
        lanes: (3, 3) left of, under and right of the ego: the centre's offset, the width, and 1 where it exists.
        vehicles: (heads, n, n) of the encoder; row: who attends, column: to whom; rows sum to 1.
        to_lanes: (heads, n, 3) of the encoder.
        decoder: (heads, n, n) of the decoder.
    """

    picture: Picture
    vehicle_id: tuple[int, ...]
    place_m: Doubles
    size_m: Doubles
    lanes: Doubles
    vehicles: Doubles
    to_lanes: Doubles
    decoder: Doubles

    @property
    def heads(self) -> int:
        """How many."""
        return len(self.vehicles)

    @property
    def names(self) -> list[str]:
        """What vehicles are called: the ego, then 1, 2, ... from the nearest to the farthest."""
        return [EGO, *(str(number) for number in range(1, len(self.vehicle_id)))]

    def to_dict(self) -> dict[str, Any]:
        """The numbers, as plain values for JSON; null where a size is unknown."""
        named = ("sample", "part", "split", "dataset", "subset", "time_s", "lateral", "longitudinal")
        vehicles = zip(self.names, self.vehicle_id, self.place_m.tolist(), self.size_m.tolist(), strict=True)
        return {
            **{name: getattr(self.picture, name) for name in named},
            "heads": self.heads,
            "vehicles": [
                {
                    "name": name,
                    "vehicle_id": vehicle_id,
                    "along_m": round(along_m, 3),
                    "across_m": round(across_m, 3),
                    "length_m": round(length_m, 3) or None,
                    "width_m": round(width_m, 3) or None,
                }
                for name, vehicle_id, (along_m, across_m), (length_m, width_m) in vehicles
            ],
            "lanes": [
                {"name": name, "exists": exists > 0, "offset_m": round(offset_m, 3), "width_m": round(width_m, 3)}
                for name, (offset_m, width_m, exists) in zip(LANES, self.lanes.tolist(), strict=True)
            ],
            "attention": {
                "encoder_vehicles": self.vehicles.round(6).tolist(),
                "encoder_lanes": self.to_lanes.round(6).tolist(),
                "decoder_vehicles": self.decoder.round(6).tolist(),
            },
        }


def tell_head(shown: AttentionMap, head: int) -> str:
    """What the ego attends to most in a head."""

    def tell(weights: Doubles) -> str:
        most = int(weights.argmax())
        return f"{'itself' if most == 0 else f'vehicle {most}'} ({weights[most]:.0%})"

    lanes = shown.to_lanes[head, 0]
    most = int(lanes.argmax())
    where = f"the {LANES[most]} lane ({lanes[most]:.0%})" if lanes.sum() > 0 else "no lane, as none is known"
    encoder, decoder = tell(shown.vehicles[head, 0]), tell(shown.decoder[head, 0])
    return f"the ego attends most to {encoder} and {where}; in the decoder to {decoder}"


def list_bands(shown: AttentionMap, head: int) -> list[Row]:
    """One row per lane that exists: its borders relative to the ego, and the ego's attention to it."""
    return [
        {
            "lane": LANES[number],
            "top_m": offset_m - width_m / 2,
            "bottom_m": offset_m + width_m / 2,
            "middle_m": offset_m,
            "weight": float(shown.to_lanes[head, 0, number]),
            "told": f"{LANES[number]} ({shown.to_lanes[head, 0, number]:.0%})",
        }
        for number, (offset_m, width_m, exists) in enumerate(shown.lanes.tolist())
        if exists
    ]


def list_markings(shown: AttentionMap) -> list[Row]:
    """One row per lane border, relative to the ego."""
    own_m = float(shown.picture.own.history_m[-1, 1])
    return [{"y_m": float(border) - own_m} for border in shown.picture.markings_m]


def list_boxes(shown: AttentionMap, head: int) -> list[Row]:
    """One row per vehicle: its box relative to the ego's front, its name, and the ego's attention to it."""
    rows = []
    for number, ((front_m, middle_m), (length_m, width_m)) in enumerate(
        zip(shown.place_m.tolist(), shown.size_m.tolist(), strict=True)
    ):
        length_m, width_m = (length_m, width_m) if length_m and width_m else UNKNOWN_SIZE_M
        weight = float(shown.vehicles[head, 0, number])
        rows.append(
            {
                "name": shown.names[number],
                "own": number == 0,
                "back_m": front_m - length_m,
                "front_m": front_m,
                "centre_m": front_m - length_m / 2,
                "top_m": middle_m - width_m / 2,
                "bottom_m": middle_m + width_m / 2,
                "middle_m": middle_m,
                "weight": weight,
                "told": f"{shown.names[number]} ({weight:.0%})",
            }
        )
    return rows


def list_cells(weights: Doubles, rows: list[str], columns: list[str]) -> list[Row]:
    """One row per number of a matrix, with the names of its row and column."""
    cells = product(enumerate(rows), enumerate(columns))
    return [{"by": by, "to": to, "weight": float(weights[r, c])} for (r, by), (c, to) in cells]


def span_road(shown: AttentionMap) -> tuple[tuple[float, float], tuple[float, float]]:
    """What is drawn of the road, relative to the ego: (first, last) along it, and (leftmost, rightmost) across it."""
    boxes, borders = list_boxes(shown, 0), [row["y_m"] for row in list_markings(shown)]
    first, last = min(box["back_m"] for box in boxes), max(box["front_m"] for box in boxes)
    margin = max(LEAST_MARGIN_M, MARGIN_SHARE * (last - first))
    along = first - margin, last + margin
    top, bottom = [box["top_m"] for box in boxes], [box["bottom_m"] for box in boxes]
    return along, (min([*top, *borders]) - VERGE_M, max([*bottom, *borders]) + VERGE_M)
