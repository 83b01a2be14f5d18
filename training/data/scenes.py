"""Whole scenes: every vehicle at a tick, with its place in its lane."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Bytes, Floats, Integers
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.batches import SceneBatch
from tracklake.training.data.checks import AGAIN, TensorError
from tracklake.training.data.namespaces import expand_groups
from tracklake.training.data.positions import (
    find_runs,
    locate_rows,
    read_future,
    read_history,
    to_absolute,
    to_relative,
)

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder


@dataclass(frozen=True)
class Lanes:
    """Where the lanes of each subset lie; L is one more than the highest lane of all subsets.

    Args:
        last: (subsets,) the rightmost lane.
        centre_m: (subsets, L + 1) y of the lanes' centres; NaN where unknown, at lane 0 and at L.
        lane_width_m: (subsets, L + 1) widths of the lanes; NaN where the centre is.
    """

    last: npt.NDArray[np.int16]
    centre_m: Floats
    lane_width_m: Floats

    def find_adjacent(self) -> Floats:
        """Return (subsets, O, 3, 3) the lanes left of, under and right of lanes 0 to O - 1.

        Each is y of the centre, width, and 1; or zeros where the lane does not exist. Lane 0 stands for no lane and has
        no neighbors, and neither has any lane above O - 1. Where a subset has no markings, lanes of NOMINAL_LANE_M from
        the left edge on are taken.
        """
        own = np.arange(int(self.last.max(initial=0)) + 3)[:, None]
        lane = own + np.arange(-1, 2)
        exists = (own > 0) & (lane > 0) & (lane <= self.last[:, None, None])
        known = np.clip(lane, 0, self.centre_m.shape[1] - 1)
        centre, width = self.centre_m[:, known], self.lane_width_m[:, known]
        unmarked = np.isnan(centre)
        centre = np.where(unmarked, (lane - 0.5) * NOMINAL_LANE_M, centre)
        width = np.where(unmarked, NOMINAL_LANE_M, width)
        return np.stack([centre, width, exists], axis=-1) * exists[..., None]


def find_lanes(subsets: Sequence[Mapping[str, Any]]) -> Lanes:
    """Read the lanes from a folder's `subsets`; see `schemas.tensors.SUBSET_KEYS`."""
    most = max((len(subset["lane_markings_m"] or [0]) for subset in subsets), default=1)
    centre = np.full((len(subsets), most + 1), np.nan)
    width = centre.copy()
    for number, subset in enumerate(subsets):
        if subset["lane_markings_m"]:
            markings = np.array(subset["lane_markings_m"])
            centre[number, 1 : len(markings)] = (markings[1:] + markings[:-1]) / 2
            width[number, 1 : len(markings)] = np.diff(markings)
    return Lanes(
        last=np.array([subset["last_lane"] for subset in subsets], dtype=np.int16),
        centre_m=centre,
        lane_width_m=width,
    )


def find_scenes_of_samples(folder: "TensorFolder") -> npt.NDArray[np.int32]:
    """Return (S,) the scene that each sample stands in.

    Raises:
        TensorError: a sample stands in no scene, or in several.
    """
    member = np.flatnonzero(folder.scene_sample >= 0)
    sample, samples = folder.scene_sample[member], len(folder.sample_row)
    times = np.bincount(sample, minlength=samples)
    if len(times) != samples or (times != 1).any():
        raise TensorError(
            f"{folder.path}: array `scene_sample`: expected each of {samples:,} samples in one scene, got "
            f"{len(member):,} vehicles that are samples; {AGAIN}"
        )
    scene = np.empty(samples, dtype=np.int32)
    scene[sample] = np.searchsorted(folder.scene_offset, member, side="right") - 1
    return scene


def gather_scenes(folder: "TensorFolder", scene: Integers, *, absolute: bool = False) -> SceneBatch:
    """Read scenes by their numbers (B,); no vehicle is read by itself.

    Args:
        folder: tensors to read from.
        scene: numbers of scenes, each within the folder.
        absolute: measure positions on the carriageway.
    """
    member, vehicle_scene = expand_groups(folder.scene_offset, scene)
    row, sample = folder.scene_row[member].astype(np.int64), folder.scene_sample[member]
    run = find_runs(folder, row)
    history, history_mask = read_history(folder, row, folder.run_first_row[run])
    future, future_mask = read_future(folder, row, folder.run_first_row[run + 1] - 1)
    if absolute:
        history, future = to_absolute(folder, history, row), to_absolute(folder, future, row)
    else:
        stored = folder.position_m[row]
        history, future = to_relative(folder, history, stored), to_relative(folder, future, stored)
    origin, subset = locate_rows(folder, row), folder.run_subset[run]
    lane, lanes = folder.lane[row], folder.lanes
    known_lane = np.clip(lane, 0, lanes.centre_m.shape[1] - 1)
    return SceneBatch(
        scene=scene,
        vehicle_scene=vehicle_scene,
        vehicle_id=folder.run_vehicle_id[run],
        sample=sample,
        history=history,
        history_mask=history_mask,
        future=future,
        future_mask=future_mask,
        lateral=_read_maneuvers(folder.sample_lateral, sample),
        longitudinal=_read_maneuvers(folder.sample_longitudinal, sample),
        origin=origin,
        speed_mps=folder.speed_mps[row],
        lane=lane,
        lane_offset_m=(origin[:, 1] - lanes.centre_m[subset, known_lane]).astype(np.float32),
        lane_width_m=lanes.lane_width_m[subset, known_lane].astype(np.float32),
        has_left=lane > 1,
        has_right=(lane > 0) & (lane < lanes.last[subset]),
        absolute=absolute,
    )


def _read_maneuvers(values: Bytes, sample: npt.NDArray[np.int32]) -> npt.NDArray[np.int8]:
    """Return (V,) the maneuvers of vehicles that are samples, -1 for the others."""
    found = np.full(len(sample), -1, dtype=np.int8)
    found[sample >= 0] = values[sample[sample >= 0]]
    return found
