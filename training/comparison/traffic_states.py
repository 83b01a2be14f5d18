"""Densities of traffic around samples, and their classes."""

import numpy as np

from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.comparisons import ALL_DENSITIES, DENSITY_CLASSES
from tracklake.training.data.gathers import locate_rows
from tracklake.training.data.tensor_folder import TensorFolder


def measure_densities(folder: TensorFolder, samples: Integers) -> Floats:
    """Measure the vehicles per km of lane in each sample's scene: (B,); NaN where no lane is known.

    The lanes' length is what the vehicles of the whole subset drive on of each lane, so that ramps count as far as they
    reach.
    """
    lane_km = _measure_lanes(folder)
    scene = folder.scene_of_sample[samples]
    vehicles = np.diff(folder.scene_offset)[scene]
    subset = folder.run_subset[folder.runs_of(folder.sample_row[samples])]
    with np.errstate(divide="ignore", invalid="ignore"):
        density: Floats = np.where(lane_km[subset] > 0, vehicles / lane_km[subset], np.nan)
    return density


def _measure_lanes(folder: TensorFolder) -> Floats:
    """Measure the length of all lanes of each subset together, in km: (subsets,)."""
    rows = np.arange(len(folder.lane))
    x_m = locate_rows(folder, rows)[:, 0]
    subset = np.repeat(folder.run_subset, np.diff(folder.run_first_row))
    lanes = int(folder.lane.max(initial=0)) + 1
    place = subset * lanes + folder.lane
    order = np.argsort(place, kind="stable")
    present, first = np.unique(place[order], return_index=True)
    length_km = np.zeros(len(folder.index["subsets"]) * lanes)
    if len(present):
        reach = np.maximum.reduceat(x_m[order], first) - np.minimum.reduceat(x_m[order], first)
        length_km[present] = reach / 1000.0
    total: Floats = length_km.reshape(-1, lanes)[:, 1:].sum(axis=1)
    return total


def list_classes(density: Floats) -> dict[str, Flags]:
    """List which samples (B,) belong to each class of DENSITY_CLASSES, and to all; classes without any are left out."""
    groups = {ALL_DENSITIES: np.ones(len(density), dtype=np.bool_)}
    groups |= {name: (density >= least) & (density < most) for name, (least, most) in DENSITY_CLASSES.items()}
    return {name: members for name, members in groups.items() if members.any()}
