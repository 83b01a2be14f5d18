"""Who attends to whom in chosen samples: the attention of every head, as a table and as a drawing."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from schemas.columns import LATERAL_MANEUVERS
from training.attention_drawing import draw_attention
from training.attention_rows import AttentionMap
from training.observed import ObservedScene
from training.pictures import take_picture
from training.reading import NEAREST
from training.surroundings import find_around, gather_surroundings
from training.tensors import TensorFolder

LEAST_NEIGHBORS = 5
"""In the grid of a sample that is shown as an example: with nobody around there is little to attend to."""
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

    def look(self, observed: ObservedScene[Any]) -> Weights:
        """Who attends to what."""
        ...


@dataclass(frozen=True)
class Examples:
    """Samples that are shown; None where the part has none.

    Args:
        change: the first with a lane change.
        keep: the first that keeps its lane.
    """

    change: int | None
    keep: int | None

    @property
    def samples(self) -> list[int]:
        """Those that there are."""
        return [sample for sample in (self.change, self.keep) if sample is not None]


def choose_examples(folder: TensorFolder, part: str, *, least_neighbors: int = LEAST_NEIGHBORS) -> Examples:
    """The first lane change and the first lane keep of a part, with enough neighbors around.

    True maneuvers choose what is drawn; no model is told of them.

    Args:
        folder: where.
        part: train, val or eval.
        least_neighbors: in the sample's grid; where no sample has so many, the first with any number.

    Raises:
        ValueError: no such part.
    """
    samples = folder.samples_of(part)
    neighbors = folder.neighbor_offset[samples + 1] - folder.neighbor_offset[samples]
    keeps = folder.sample_lateral[samples] == LATERAL_MANEUVERS.index("keep")

    def first(of: npt.NDArray[np.bool_]) -> int | None:
        found = samples[of & (neighbors >= least_neighbors)]
        found = found if len(found) else samples[of]
        return int(found[0]) if len(found) else None

    return Examples(change=first(~keeps), keep=first(keeps))


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
    observed, _ = gather_surroundings(folder, numbers, nearest=nearest)
    weights = network.look(observed)
    ids = folder.run_vehicle_id[folder.runs_of(find_around(folder, numbers, nearest).row)]
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
