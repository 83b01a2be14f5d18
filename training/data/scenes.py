"""Whole scenes: every vehicle of a moment, with what is known of its lane."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.batches import Floats, Integers, SceneBatch
from tracklake.training.data.checks import AGAIN, TensorError
from tracklake.training.data.windows import place, spread, subtract

if TYPE_CHECKING:
    from tracklake.training.data.tensor_folder import TensorFolder


@dataclass(frozen=True)
class Lanes:
    """Where the lanes of each subset lie. L is one more than the highest lane of all of them.

    Args:
        last: (subsets,) the rightmost lane.
        width_m: (subsets,) of the carriageway.
        centre_m: (subsets, L + 1) y of the lanes' centres; NaN where unknown, at lane 0 and at L.
        lane_width_m: (subsets, L + 1) likewise.
    """

    last: npt.NDArray[np.int16]
    width_m: npt.NDArray[np.float64]
    centre_m: npt.NDArray[np.float64]
    lane_width_m: npt.NDArray[np.float64]

    @cached_property
    def around(self) -> npt.NDArray[np.float64]:
        """(subsets, O, 3, 3) lanes left of, under and right of lanes 0 to O - 1: y of the centre, width, 1; or zeros.

        Zeros stand for lanes that do not exist, and for all three of lane 0, which is none; of lanes above O - 1, none
        has a neighbor. Where a subset has no markings, lanes of NOMINAL_LANE_M from the left edge on are taken.
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
    """Read the lanes off a folder's `subsets`; see `schemas.tensors.SUBSET_KEYS`."""
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
        width_m=np.array([subset["width_m"] for subset in subsets], dtype=np.float64),
        centre_m=centre,
        lane_width_m=width,
    )


def find_scenes_of_samples(folder: "TensorFolder") -> npt.NDArray[np.int32]:
    """(S,) the scene that each sample stands in.

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
    """Read scenes by their numbers (B,); no vehicle is looked at by itself."""
    member, vehicle_scene = spread(folder.scene_offset, scene)
    row, sample = folder.scene_row[member].astype(np.intp), folder.scene_sample[member]
    run = folder.runs_of(row)
    first, last = folder.run_first_row[run], folder.run_first_row[run + 1] - 1
    history_ticks, horizon_ticks = folder.protocol.history_ticks, folder.protocol.horizon_ticks
    history_known = np.minimum(row - first + 1, history_ticks)
    future_known = np.minimum(last - row, horizon_ticks)
    history = folder.histories.take(row + 1 - history_ticks, first, row, history_known < history_ticks)
    future = folder.futures.take(row + 1, row, last, future_known < horizon_ticks)
    subset = folder.run_subset[run]
    stored, centre = folder.position_m[row], folder.centre_m[subset]
    origin = place(stored[:, None, :], centre, folder.step_m)[:, 0]
    if absolute:
        history, future = place(history, centre, folder.step_m), place(future, centre, folder.step_m)
    else:
        history, future = subtract(history, stored, folder.step_m), subtract(future, stored, folder.step_m)
    lane, lanes = folder.lane[row], folder.lanes
    known_lane = np.clip(lane, 0, lanes.centre_m.shape[1] - 1)
    offset: Floats = (origin[:, 1] - lanes.centre_m[subset, known_lane]).astype(np.float32)
    none = np.int8(-1)
    return SceneBatch(
        scene=scene,
        vehicle_scene=vehicle_scene,
        vehicle_id=folder.run_vehicle_id[run],
        sample=sample,
        history=history,
        history_mask=folder.history_masks.take(history_known.astype(np.uint8)),
        future=future,
        future_mask=folder.future_masks.take(future_known.astype(np.uint8)),
        lateral=_of_samples(folder.sample_lateral, sample, none),
        longitudinal=_of_samples(folder.sample_longitudinal, sample, none),
        origin=origin,
        speed_mps=folder.speed_mps[row],
        lane=lane,
        lane_offset_m=offset,
        lane_width_m=lanes.lane_width_m[subset, known_lane].astype(np.float32),
        has_left=lane > 1,
        has_right=(lane > 0) & (lane < lanes.last[subset]),
        absolute=absolute,
    )


def _of_samples(values: npt.NDArray[np.uint8], sample: npt.NDArray[np.int32], none: np.int8) -> npt.NDArray[np.int8]:
    """(V,) values of samples; `none` where the vehicle is no sample."""
    found = np.full(len(sample), none, dtype=np.int8)
    found[sample >= 0] = values[sample[sample >= 0]]
    return found
