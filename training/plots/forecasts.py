"""Predictions of models on the carriageway: one forecast per model and vehicle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Floats, Integers, Singles
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.training.data.nearest_vehicles import find_nearest, gather_nearest
from tracklake.training.data.positions import check_numbers, locate_rows
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.inputs import read_samples
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
    scene = int(folder.scene_of_sample[check_numbers([sample], len(folder.sample_row), "sample")[0]])
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
    scene = network.predict_scene(observed)
    ids = folder.run_vehicle_id[folder.runs_of(find_nearest(folder, number, others).row[0])].tolist()
    origin = _find_origins(folder, number)[0]
    sigma = np.sqrt(np.diagonal(scene.covariance_m2[0], axis1=-2, axis2=-1))  # (V, F, 2)
    correlation = scene.covariance_m2[0, ..., 0, 1] / sigma.prod(axis=-1)
    weight = np.ones((len(ids), 1), dtype=sigma.dtype)
    density = Density(weight, scene.mean_m[0, :, None], sigma[:, None], correlation[:, None])
    prediction = Prediction(scene.mean_m[0], density)
    present = np.flatnonzero(scene.vehicle_mask[0]).tolist()
    return {ids[row]: _place_forecast(model.name, prediction, row, origin) for row in present}


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
