"""What is drawn of samples: the road, the vehicles on it, what came, and what models say; as plain numbers.

What came is looked up beside the predictions, never before them: models are given what `read_samples` says may be seen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.batches import SceneBatch
from tracklake.training.data.namespaces import expand_groups
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.plots.forecasts import Forecast

Doubles = npt.NDArray[np.float64]
Role = Literal["own", "neighbor", "other"]


@dataclass(frozen=True)
class Vehicle:
    """One vehicle of a moment. Positions on the carriageway in m, as in `tracks`: those that are known.

    Args:
        vehicle_id: unique within the subset.
        sample: its number where it is a sample at this moment; else -1.
        role: `own` of the sample drawn; `neighbor` in its 13 x 3 grid; `other`.
        history_m: (h, 2) front centre, the last one at the moment itself; 1 <= h <= H.
        future_m: (f, 2) what came, at 1, 2, ... ticks; 0 <= f <= F.
        length_m: NaN where unknown.
        width_m: likewise.
        forecasts: of the models, in their order.
    """

    vehicle_id: int
    sample: int
    role: Role
    history_m: Doubles
    future_m: Doubles
    length_m: float
    width_m: float
    forecasts: tuple[Forecast, ...] = ()


@dataclass(frozen=True)
class Picture:
    """One moment of one carriageway.

    Args:
        sample: the number of the sample drawn.
        part: of the split, that it stands in.
        split: the split's name.
        dataset: of the sample.
        subset: likewise.
        time_s: since the recording began.
        rate_hz: ticks a second.
        lateral: the maneuver that came.
        longitudinal: likewise.
        markings_m: y of the lanes' borders, from the left edge to the right one.
        marked: whether they are known; else lanes of NOMINAL_LANE_M are taken.
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
        """The vehicle that the sample is of."""
        return self.vehicles[0]

    @property
    def models(self) -> tuple[str, ...]:
        """Whose forecasts are drawn, in order."""
        return tuple(dict.fromkeys(said.model for vehicle in self.vehicles for said in vehicle.forecasts))

    def to_dict(self) -> dict[str, Any]:
        """The numbers drawn, as plain values for JSON; null where unknown."""
        plain = {name: getattr(self, name) for name in _PLAIN}
        return {**plain, "markings_m": list(self.markings_m), "vehicles": [_describe(one) for one in self.vehicles]}


_PLAIN = (
    "sample",
    "part",
    "split",
    "dataset",
    "subset",
    "time_s",
    "rate_hz",
    "lateral",
    "longitudinal",
    "marked",
)


def _describe(vehicle: Vehicle) -> dict[str, Any]:
    sizes = {"length_m": vehicle.length_m, "width_m": vehicle.width_m}
    return {
        "vehicle_id": vehicle.vehicle_id,
        "sample": vehicle.sample if vehicle.sample >= 0 else None,
        "role": vehicle.role,
        **{name: None if np.isnan(size) else round(size, 3) for name, size in sizes.items()},
        "history_m": vehicle.history_m.round(3).tolist(),
        "truth_m": vehicle.future_m.round(3).tolist(),
        "predictions": [said.to_dict() for said in vehicle.forecasts],
    }


def take_picture(folder: TensorFolder, sample: int, forecasts: Mapping[int, Sequence[Forecast]]) -> Picture:
    """Look up what stood on the road at a sample's moment, and put models' forecasts to it.

    Args:
        folder: of the sample.
        sample: its number.
        forecasts: by vehicle id; of those that have any.

    Raises:
        IndexError: a number below 0, or not below S.
    """
    scene = _find_scene(folder, sample)
    batch = folder.gather_scenes([scene], absolute=True)
    row = folder.sample_row[sample]
    run = int(folder.runs_of(np.asarray([row]))[0])
    facts = folder.index["subsets"][folder.run_subset[run]]
    markings = facts["lane_markings_m"] or np.arange(max(facts["last_lane"], 1) + 1) * NOMINAL_LANE_M
    return Picture(
        sample=sample,
        part=PARTS[folder.sample_part[sample]],
        split=folder.split,
        dataset=facts["dataset"],
        subset=facts["subset"],
        time_s=_time_of(folder, run, int(row)),
        rate_hz=folder.protocol.rate_hz,
        lateral=LATERAL_MANEUVERS[folder.sample_lateral[sample]],
        longitudinal=LONGITUDINAL_MANEUVERS[folder.sample_longitudinal[sample]],
        markings_m=tuple(float(border) for border in markings),
        marked=bool(facts["lane_markings_m"]),
        vehicles=_list_vehicles(folder, batch, sample, forecasts),
    )


def _find_scene(folder: TensorFolder, sample: int) -> int:
    if not 0 <= sample < len(folder.sample_row):
        raise IndexError(f"samples are numbered 0 to {len(folder.sample_row) - 1:,}, got {sample}")
    return int(folder.scene_of_sample[sample])


def _time_of(folder: TensorFolder, run: int, row: int) -> float:
    tick = int(folder.run_first_tick[run]) + row - int(folder.run_first_row[run])
    return tick / folder.protocol.rate_hz


def _list_vehicles(
    folder: TensorFolder, batch: SceneBatch, sample: int, forecasts: Mapping[int, Sequence[Forecast]]
) -> tuple[Vehicle, ...]:
    """The vehicles of the scene: the sample's own, then the others in their order."""
    member, _ = expand_groups(folder.scene_offset, batch.scene)
    row = folder.scene_row[member]
    run = folder.runs_of(row)
    pairs, _ = expand_groups(folder.neighbor_offset, np.asarray([sample]))
    near = np.isin(row, folder.neighbor_row[pairs])
    order = np.argsort(batch.sample != sample, kind="stable")
    return tuple(
        Vehicle(
            vehicle_id=int(batch.vehicle_id[v]),
            sample=int(batch.sample[v]),
            role="own" if batch.sample[v] == sample else "neighbor" if near[v] else "other",
            history_m=batch.history[v][batch.history_mask[v]].astype(np.float64),
            future_m=batch.future[v][batch.future_mask[v]].astype(np.float64),
            length_m=float(folder.run_length_m[run[v]]),
            width_m=float(folder.run_width_m[run[v]]),
            forecasts=tuple(forecasts.get(int(batch.vehicle_id[v]), ())),
        )
        for v in order
    )
