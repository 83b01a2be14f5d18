"""A sample and its scene as plain numbers: the road, the vehicles, their true futures, and the models' forecasts.

Futures are read beside the predictions, never before them: models get what `read_samples` allows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Floats, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS, PARTS
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.gathers import (
    check_numbers,
    expand_groups,
    find_nearest,
    gather_nearest,
    locate_rows,
    read_samples,
)
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.prediction import Density, NotFiniteError, Prediction
from tracklake.training.runs.forecasters import Forecaster


@dataclass(frozen=True)
class Alternative:
    """One component of a forecast's mixture: a bivariate normal density per tick.

    Args:
        probability: weight in the mixture.
        mean_m: (F, 2) positions on the carriageway.
        sigma_m: (F, 2) standard deviations along and across the road.
        correlation: (F,) correlation of the two.
    """

    probability: float
    mean_m: Floats
    sigma_m: Floats
    correlation: Floats


@dataclass(frozen=True)
class Forecast:
    """One model's prediction of one vehicle.

    Args:
        model: name of the run or model.
        position_m: (F, 2) positions on the carriageway after 1, 2, ... ticks.
        alternatives: the most probable first; empty where the model gives no density.
        lateral: probabilities by maneuver; None where the model gives none; `longitudinal` likewise.
    """

    model: str
    position_m: Floats
    alternatives: tuple[Alternative, ...] = ()
    lateral: dict[str, float] | None = None
    longitudinal: dict[str, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Make plain values for JSON."""
        return {
            "model": self.model,
            "position_m": self.position_m.round(3).tolist(),
            "alternatives": [
                {
                    "probability": round(one.probability, 4),
                    "mean_m": one.mean_m.round(3).tolist(),
                    "sigma_m": one.sigma_m.round(4).tolist(),
                    "correlation": one.correlation.round(4).tolist(),
                }
                for one in self.alternatives
            ],
            "lateral": self.lateral,
            "longitudinal": self.longitudinal,
        }


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
        origin: recorded or synthetic.
        time_s: seconds since the recording began.
        lateral: true lateral maneuver; `longitudinal` likewise.
        markings_m: y of the lanes' borders, from the left edge to the right one.
        marked: whether the borders are known; else lanes are NOMINAL_LANE_M wide.
        vehicles: the sample's own first, then by id.
        lane_centred: whether lateral positions are lane centres, so that only errors along the road mean anything.
    """

    sample: int
    part: str
    split: str
    dataset: str
    subset: str
    origin: str
    time_s: float
    rate_hz: int
    lateral: str
    longitudinal: str
    markings_m: tuple[float, ...]
    marked: bool
    vehicles: tuple[Vehicle, ...]
    lane_centred: bool = False

    @property
    def place(self) -> str:
        """Dataset and subset, as drawings name them: `synthetic` where traffic was generated."""
        return f"{'synthetic ' if self.origin == 'synthetic' else ''}{self.dataset} {self.subset}"

    @property
    def own(self) -> Vehicle:
        """The vehicle of the drawn sample."""
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
    check_numbers([sample], folder.sample_row, "sample")
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
        origin=facts["origin"],
        time_s=tick / folder.protocol.rate_hz,
        rate_hz=folder.protocol.rate_hz,
        lateral=LATERAL_MANEUVERS[folder.sample_lateral[sample]],
        longitudinal=LONGITUDINAL_MANEUVERS[folder.sample_longitudinal[sample]],
        markings_m=tuple(float(border) for border in markings),
        marked=bool(facts["lane_markings_m"]),
        vehicles=vehicles,
        lane_centred=bool(folder.lane_centred[folder.run_subset[run]]),
    )


def forecast_samples(
    folder: TensorFolder, samples: npt.ArrayLike, models: Sequence[Forecaster]
) -> dict[int, list[Forecast]]:
    """Predict samples (B,) with every model, in one batch each; by sample number, in the models' order.

    Raises:
        IndexError: no sample has the number.
        NotFiniteError: a predicted position is not a finite number.
    """
    sample = np.asarray(samples, dtype=np.int64)
    predictions = [(one.name, one.predictor.predict(read_samples(folder, sample, one.reads)[0])) for one in models]
    origin = _find_origins(folder, sample)
    return {
        number: [_place_forecast(name, prediction, row, origin[row]) for name, prediction in predictions]
        for row, number in enumerate(sample.tolist())
    }


def forecast_scene(folder: TensorFolder, sample: int, models: Sequence[Forecaster]) -> dict[int, list[Forecast]]:
    """Predict a sample's whole scene with every model; by vehicle id, in the models' order.

    A model of scenes predicts all vehicles at once; any other model predicts every sample of the scene by itself.

    Raises:
        IndexError: no sample has the number.
        NotFiniteError: a predicted position is not a finite number.
    """
    scene = int(folder.scene_of_sample[check_numbers([sample], folder.sample_row, "sample")[0]])
    members = slice(int(folder.scene_offset[scene]), int(folder.scene_offset[scene + 1]))
    samples = folder.scene_sample[members]
    ids = folder.run_vehicle_id[folder.runs_of(folder.scene_row[members])].tolist()
    found: dict[int, list[Forecast]] = {vehicle: [] for vehicle in ids}
    for model in models:
        if model.reads == "scene":
            for vehicle, forecast in _forecast_together(folder, sample, model, len(ids) - 1).items():
                found[vehicle].append(forecast)
        else:
            of_sample = forecast_samples(folder, samples[samples >= 0], [model])
            for vehicle, number in zip(ids, samples.tolist(), strict=True):
                found[vehicle] += of_sample.get(number, [])
    return {vehicle: forecasts for vehicle, forecasts in found.items() if forecasts}


def _forecast_together(folder: TensorFolder, sample: int, model: Forecaster, others: int) -> dict[int, Forecast]:
    """Predict a sample's vehicle and the others of its scene at once, by id."""
    number = np.asarray([sample], dtype=np.int64)
    observed, _ = gather_nearest(folder, number, nearest=others)
    network: Any = model.predictor  # a network with attention
    prediction, origin = network.predict_vehicles(observed), _find_origins(folder, number)[0]
    rows = find_nearest(folder, number, others)[0][network.limit(observed).vehicle_mask]
    ids = folder.run_vehicle_id[folder.runs_of(rows)].tolist()
    return {vehicle: _place_forecast(model.name, prediction, row, origin) for row, vehicle in enumerate(ids)}


def _find_origins(folder: TensorFolder, samples: Integers) -> Floats:
    """Find the samples' last positions on the carriageway (B, 2)."""
    return np.asarray(locate_rows(folder, folder.sample_row[samples]), dtype=np.float64)


def _place_forecast(model: str, prediction: Prediction, row: int, origin_m: Floats) -> Forecast:
    """Move one prediction of a batch from the sample's last position (2,) to the carriageway."""
    position_m, density = prediction.position_m[row] + origin_m, prediction.density
    if not np.isfinite(position_m).all():
        raise NotFiniteError(model, "positions")
    alternatives = () if density is None else _place_density(density, row, origin_m)
    lateral = _name_maneuvers(LATERAL_MANEUVERS, prediction.lateral, row)
    longitudinal = _name_maneuvers(LONGITUDINAL_MANEUVERS, prediction.longitudinal, row)
    return Forecast(model, position_m, alternatives, lateral, longitudinal)


def _place_density(density: Density, row: int, origin_m: Floats) -> tuple[Alternative, ...]:
    return tuple(
        Alternative(
            probability=float(density.weight[row, a]),
            mean_m=density.mean_m[row, a] + origin_m,
            sigma_m=density.sigma_m[row, a].astype(np.float64),
            correlation=density.correlation[row, a].astype(np.float64),
        )
        for a in np.argsort(-density.weight[row], kind="stable")
    )


def _name_maneuvers(names: tuple[str, ...], probabilities: Singles | None, row: int) -> dict[str, float] | None:
    if probabilities is None:
        return None
    return {name: round(float(share), 4) for name, share in zip(names, probabilities[row], strict=True)}
