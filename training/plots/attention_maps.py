"""Attention weights of one sample: every head's weights between vehicles, and from vehicles to lanes."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tracklake.training.data.gathers import find_nearest, gather_nearest
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.inputs import NEAREST
from tracklake.training.plots.forecasts import Doubles
from tracklake.training.plots.picture import Picture, take_picture

if TYPE_CHECKING:
    from tracklake.training.models.attention import SceneAttention

LANES = ("left", "own", "right")
"""Names of the ego's lane and its neighbors, in the order of the weights."""
EGO = "ego"
"""Name of the sample's vehicle, vehicle 0 of its scene."""


@dataclass(frozen=True)
class AttentionMap:
    """One sample, the n vehicles of its scene, and their attention weights. Vehicle 0 is the ego.

    Args:
        picture: the sample and its scene.
        vehicle_id: n ids, unique within the subset.
        place_m: (n, 2) front centres relative to the ego's: along the road, and across, positive to the right.
        size_m: (n, 2) length and width; 0 where unknown.
        lanes: (3, 3) per lane of LANES: the centre's offset in m, the width in m, and 1 where the lane exists.
        vehicles: (heads, n, n) weights of the encoder; a row attends to the columns and sums to 1.
        to_lanes: (heads, n, 3) weights of the encoder from vehicles to lanes.
        decoder: (heads, n, n) weights of the decoder.
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
        """Number of attention heads."""
        return len(self.vehicles)

    @property
    def names(self) -> list[str]:
        """Names of the vehicles: the ego, then 1, 2, ... from the nearest to the farthest."""
        return [EGO, *(str(number) for number in range(1, len(self.vehicle_id)))]

    def to_dict(self) -> dict[str, Any]:
        """Make plain values for JSON; null where a size is unknown."""
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


def map_attention(
    folder: TensorFolder, network: "SceneAttention", samples: npt.ArrayLike, *, nearest: int = NEAREST
) -> list[AttentionMap]:
    """Compute the attention of samples (B,) in one batch, of the ego and its nearest vehicles, without padding.

    Args:
        folder: tensors.
        network: a network with attention.
        samples: (B,) sample numbers.
        nearest: most vehicles around each ego.

    Raises:
        IndexError: no sample has the number.
    """
    numbers = np.asarray(samples, dtype=np.int64)
    observed, _ = gather_nearest(folder, numbers, nearest=nearest)
    weights = network.read_attention(observed)
    ids = folder.run_vehicle_id[folder.runs_of(find_nearest(folder, numbers, nearest).row)]
    maps = []
    for row, (sample, present) in enumerate(zip(numbers.tolist(), observed.vehicle_mask.sum(axis=1), strict=True)):
        there = slice(int(present))  # padding comes last
        maps.append(
            AttentionMap(
                picture=take_picture(folder, sample, {}),
                vehicle_id=tuple(ids[row, there].tolist()),
                place_m=observed.history[row, there, -1].astype(np.float64),
                size_m=observed.size_m[row, there].astype(np.float64),
                lanes=observed.lanes[row].astype(np.float64),
                vehicles=weights.vehicles[row, :, there, there].astype(np.float64),
                to_lanes=weights.lanes[row, :, there].astype(np.float64),
                decoder=weights.decoder[row, :, there, there].astype(np.float64),
            )
        )
    return maps
