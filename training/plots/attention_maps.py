"""Who attends to whom in chosen samples: the attention of every head, as a table and as a drawing."""

import json
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from tracklake.training.data.nearest_vehicles import find_nearest, gather_nearest
from tracklake.training.data.observed import ObservedScene
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.inputs import NEAREST
from tracklake.training.plots.attention_drawing import draw_attention
from tracklake.training.plots.attention_rows import AttentionMap
from tracklake.training.plots.picture import take_picture

SUFFIX = ".svg"


class Weights(Protocol):
    """`training.models.attention.Attention`, here without torch."""

    @property
    def vehicles(self) -> npt.NDArray[np.float32]:
        """(B, heads, V, V) of the encoder."""
        ...

    @property
    def lanes(self) -> npt.NDArray[np.float32]:
        """(B, heads, V, 3) of the encoder."""
        ...

    @property
    def decoder(self) -> npt.NDArray[np.float32]:
        """(B, heads, V, V) of the decoder."""
        ...


class Looking(Protocol):
    """A network with attention: `training.models.attention.SceneAttention`."""

    def read_attention(self, observed: ObservedScene[Any]) -> Weights:
        """Who attends to what."""
        ...


def map_attention(
    folder: TensorFolder, network: Looking, samples: npt.ArrayLike, *, nearest: int = NEAREST
) -> list[AttentionMap]:
    """What a network attends to in samples: only vehicles that are there, the ego first, then the nearest.

    Args:
        folder: of the samples.
        network: asked once, for all of them.
        samples: (B,) numbers.
        nearest: vehicles around each, at most.

    Raises:
        IndexError: a number below 0, or not below S.
    """
    numbers = np.asarray(samples, dtype=np.int64)
    observed, _ = gather_nearest(folder, numbers, nearest=nearest)
    weights = network.read_attention(observed)
    ids = folder.run_vehicle_id[folder.runs_of(find_nearest(folder, numbers, nearest).row)]
    return [
        _cut(folder, int(sample), each, observed, weights, ids[each, : observed.vehicle_mask[each].sum()])
        for each, sample in enumerate(numbers)
    ]


def _cut(
    folder: TensorFolder,
    sample: int,
    each: int,
    observed: ObservedScene[Any],
    weights: Weights,
    ids: npt.NDArray[np.int32],
) -> AttentionMap:
    there = len(ids)  # rows of vehicles that are not there come last
    return AttentionMap(
        picture=take_picture(folder, sample, {}),
        vehicle_id=tuple(int(vehicle) for vehicle in ids),
        place_m=observed.history[each, :there, -1].astype(np.float64),
        size_m=observed.size_m[each, :there].astype(np.float64),
        lanes=observed.lanes[each].astype(np.float64),
        vehicles=weights.vehicles[each, :, :there, :there].astype(np.float64),
        to_lanes=weights.lanes[each, :, :there].astype(np.float64),
        decoder=weights.decoder[each, :, :there, :there].astype(np.float64),
    )


def export_attention(
    folder: TensorFolder,
    network: Looking,
    samples: npt.ArrayLike,
    out_dir: Path,
    *,
    nearest: int = NEAREST,
    suffix: str = SUFFIX,
) -> list[Path]:
    """Write a drawing and a table (JSON) of every sample; files of the same names are replaced.

    Args:
        folder: of the samples.
        network: with attention.
        samples: (B,) numbers.
        out_dir: made where it is not there.
        nearest: vehicles around each, at most.
        suffix: of the drawings: `.svg` or `.png`.

    Returns:
        The files: drawing and table of the first sample, of the second ...

    Raises:
        IndexError: a number below 0, or not below S.
        ValueError: another suffix.
    """
    out_dir.mkdir(parents=True, exist_ok=True)
    written = []
    for shown in map_attention(folder, network, samples, nearest=nearest):
        picture = shown.picture
        name = f"{picture.subset}_{picture.own.vehicle_id}_{picture.time_s:.1f}s_attention"
        drawing, table = out_dir / f"{name}{suffix}", out_dir / f"{name}.json"
        draw_attention(shown, drawing)
        table.write_text(json.dumps(shown.to_dict(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        written += [drawing, table]
    return written
