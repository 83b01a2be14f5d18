"""A sample and its scene as plain numbers: the road, the vehicles, their true futures, and the models' forecasts.

Futures are read beside the predictions, never before them: models get what `read_samples` allows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from tracklake.schemas.arrays import Floats
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.namespaces import expand_groups
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.plots.forecasts import Forecast


@dataclass(frozen=True)
class Vehicle:
    """One vehicle of a scene; known positions on the carriageway in m, as in `tracks`.

    Args:
        vehicle_id: unique within the subset.
        sample: number of the vehicle's own sample at this tick; -1 without one.
        role: `own` for the sample's vehicle, `neighbor` in its 13 x 3 grid, else `other`.
        history_m: (h, 2) front centres up to this tick; 1 <= h <= H.
        future_m: (f, 2) true positions after 1, 2, ... ticks; 0 <= f <= F.
        length_m: NaN where unknown; `width_m` likewise.
        forecasts: in the models' order.
    """

    vehicle_id: int
    sample: int
    role: Literal["own", "neighbor", "other"]
    history_m: Floats
    future_m: Floats
    length_m: float
    width_m: float
    forecasts: tuple[Forecast, ...] = ()

    @property
    def has_density(self) -> bool:
        """Whether any forecast has a density."""
        return any(forecast.alternatives for forecast in self.forecasts)

    def to_dict(self) -> dict[str, Any]:
        """Make plain values for JSON; null where unknown."""
        return {
            "vehicle_id": self.vehicle_id,
            "sample": self.sample if self.sample >= 0 else None,
            "role": self.role,
            "length_m": None if np.isnan(self.length_m) else round(self.length_m, 3),
            "width_m": None if np.isnan(self.width_m) else round(self.width_m, 3),
            "history_m": self.history_m.round(3).tolist(),
            "truth_m": self.future_m.round(3).tolist(),
            "predictions": [forecast.to_dict() for forecast in self.forecasts],
        }


@dataclass(frozen=True)
class Picture:
    """A sample and its scene: all vehicles of a carriageway at one tick.

    Args:
        sample: number of the sample.
        part: part of the split that holds the sample.
        time_s: seconds since the recording began.
        lateral: true lateral maneuver; `longitudinal` likewise.
        markings_m: y of the lanes' borders, from the left edge to the right one.
        marked: whether the borders are known; else lanes are NOMINAL_LANE_M wide.
        vehicles: the sample's own first, then by id.
    """

    sample: int
    part: str
    split: str
    dataset: str
    subset: str
    time_s: float
    rate_hz: int
    lateral: str
    longitudinal: str
    markings_m: tuple[float, ...]
    marked: bool
    vehicles: tuple[Vehicle, ...]

    @property
    def own(self) -> Vehicle:
        """The sample's vehicle."""
        return self.vehicles[0]

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models with forecasts, in order."""
        return tuple(dict.fromkeys(forecast.model for vehicle in self.vehicles for forecast in vehicle.forecasts))

    def to_dict(self) -> dict[str, Any]:
        """Make plain values for JSON; null where unknown."""
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        vehicles = [vehicle.to_dict() for vehicle in self.vehicles]
        return {**plain, "markings_m": list(self.markings_m), "vehicles": vehicles}


def take_picture(folder: TensorFolder, sample: int, forecasts: Mapping[int, Sequence[Forecast]]) -> Picture:
    """Read a sample's scene, and join the models' forecasts by vehicle id.

    Raises:
        IndexError: no sample has the number.
    """
    if not 0 <= sample < len(folder.sample_row):
        raise IndexError(f"samples are numbered 0 to {len(folder.sample_row) - 1:,}, got {sample}")
    batch = folder.gather_scenes([int(folder.scene_of_sample[sample])], absolute=True)
    members, _ = expand_groups(folder.scene_offset, batch.scene)
    pairs, _ = expand_groups(folder.neighbor_offset, np.asarray([sample]))
    near = np.isin(folder.scene_row[members], folder.neighbor_row[pairs])
    runs = folder.runs_of(folder.scene_row[members])
    vehicles = tuple(
        Vehicle(
            vehicle_id=int(batch.vehicle_id[v]),
            sample=int(batch.sample[v]),
            role="own" if batch.sample[v] == sample else "neighbor" if near[v] else "other",
            history_m=batch.history[v][batch.history_mask[v]].astype(np.float64),
            future_m=batch.future[v][batch.future_mask[v]].astype(np.float64),
            length_m=float(folder.run_length_m[runs[v]]),
            width_m=float(folder.run_width_m[runs[v]]),
            forecasts=tuple(forecasts.get(int(batch.vehicle_id[v]), ())),
        )
        for v in np.argsort(batch.sample != sample, kind="stable")
    )
    row = int(folder.sample_row[sample])
    run = int(folder.runs_of(np.asarray([row]))[0])
    tick = int(folder.run_first_tick[run]) + row - int(folder.run_first_row[run])
    facts = folder.index["subsets"][folder.run_subset[run]]
    markings = facts["lane_markings_m"] or np.arange(max(facts["last_lane"], 1) + 1) * NOMINAL_LANE_M
    return Picture(
        sample=sample,
        part=PARTS[folder.sample_part[sample]],
        split=folder.split,
        dataset=facts["dataset"],
        subset=facts["subset"],
        time_s=tick / folder.protocol.rate_hz,
        rate_hz=folder.protocol.rate_hz,
        lateral=LATERAL_MANEUVERS[folder.sample_lateral[sample]],
        longitudinal=LONGITUDINAL_MANEUVERS[folder.sample_longitudinal[sample]],
        markings_m=tuple(float(border) for border in markings),
        marked=bool(facts["lane_markings_m"]),
        vehicles=vehicles,
    )
