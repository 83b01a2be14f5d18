"""What models say of vehicles, placed on the carriageway: one object per model and vehicle, to be drawn."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, runtime_checkable
from typing import Protocol as Interface

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Singles as Floats
from tracklake.schemas.columns import LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.training.data.nearest_vehicles import find_nearest, gather_nearest
from tracklake.training.data.observed import ObservedScene
from tracklake.training.data.positions import check_numbers, locate_rows
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.inputs import NEAREST, read_samples
from tracklake.training.models.prediction import Density, NotFiniteError, Prediction
from tracklake.training.runs.forecasters import Forecaster

if TYPE_CHECKING:
    from tracklake.training.models.attention import SceneForecast

Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Alternative:
    """One bivariate normal density per tick, of those that a forecast mixes.

    Args:
        probability: of this alternative.
        mean_m: (F, 2) on the carriageway.
        sigma_m: (F, 2) standard deviations along and across the road.
        correlation: (F,) between the two.
    """

    probability: float
    mean_m: Doubles
    sigma_m: Doubles
    correlation: Doubles


@dataclass(frozen=True)
class Forecast:
    """What one model says of one vehicle.

    Args:
        model: the run's or model's name.
        position_m: (F, 2) on the carriageway, at 1, 2, ... ticks.
        alternatives: the most probable first; none where the model gives no density.
        lateral: probabilities by maneuver; None where it gives none.
        longitudinal: likewise.
    """

    model: str
    position_m: Doubles
    alternatives: tuple[Alternative, ...] = ()
    lateral: dict[str, float] | None = None
    longitudinal: dict[str, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
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
    """What every model says of samples (B,), all of them in one batch; by number of sample, in the models' order.

    Raises:
        IndexError: a number below 0, or not below S.
        ValueError: a place is not a finite number.
    """
    sample = np.asarray(samples, dtype=np.int64)
    found: dict[int, list[Forecast]] = {int(number): [] for number in sample}
    origin = find_origins(folder, sample)
    for model in models:
        observed, _ = read_samples(folder, sample, model.reads)
        said = model.predictor.predict(observed)
        for place_in_batch, number in enumerate(sample):
            found[int(number)].append(place_forecast(model.name, said, place_in_batch, origin[place_in_batch]))
    return found


def forecast_scene(
    folder: TensorFolder, sample: int, models: Sequence[Forecaster], *, nearest: int | None = NEAREST
) -> dict[int, list[Forecast]]:
    """What every model says of a sample's moment; by vehicle id, in the models' order.

    A model of scenes is asked once, about the sample's vehicle and those around it that it is shown; any other about
    all samples of the moment, each as it sees the others.

    Args:
        folder: of the sample.
        sample: its number.
        models: whom to ask.
        nearest: vehicles around the sample's that models of scenes are shown, at most; None: everyone at that moment.
            What they say of one vehicle may depend on how many they are shown.

    Raises:
        IndexError: a number below 0, or not below S.
        ValueError: a place is not a finite number, or `nearest` is negative.
    """
    scene = int(folder.scene_of_sample[check_numbers([sample], len(folder.sample_row), "sample")[0]])
    members = slice(int(folder.scene_offset[scene]), int(folder.scene_offset[scene + 1]))
    samples = folder.scene_sample[members]
    ids = folder.run_vehicle_id[folder.runs_of(folder.scene_row[members])].tolist()
    found: dict[int, list[Forecast]] = {vehicle: [] for vehicle in ids}
    shown = len(ids) - 1 if nearest is None else nearest
    for model in models:
        if isinstance(model.predictor, ScenePredictor):
            for vehicle, said in _forecast_around(folder, sample, model.name, model.predictor, shown).items():
                found[vehicle].append(said)
        else:
            of_sample = forecast_samples(folder, samples[samples >= 0], [model])
            for vehicle, number in zip(ids, samples.tolist(), strict=True):
                found[vehicle] += of_sample.get(number, [])
    return {vehicle: said for vehicle, said in found.items() if said}


@runtime_checkable
class ScenePredictor(Interface):
    """A model that predicts every vehicle of a scene at once."""

    def predict_scene(self, observed: ObservedScene[Any]) -> "SceneForecast":
        """Means, covariances and mask of all vehicles, relative to the ego's last position."""
        ...


def _forecast_around(
    folder: TensorFolder, sample: int, name: str, model: ScenePredictor, nearest: int
) -> dict[int, Forecast]:
    """What a model of scenes says of every vehicle that it is shown, by id."""
    number = np.asarray([sample], dtype=np.int64)
    observed, _ = gather_nearest(folder, number, nearest=nearest)
    said, around = model.predict_scene(observed), find_nearest(folder, number, nearest)
    ids = folder.run_vehicle_id[folder.runs_of(around.row[0])]
    origin = find_origins(folder, number)[0]
    variance = np.diagonal(said.covariance_m2[0], axis1=-2, axis2=-1)
    sigma = np.sqrt(variance)  # (V, F, 2)
    correlation = said.covariance_m2[0, ..., 0, 1] / (sigma[..., 0] * sigma[..., 1])
    weight = np.ones((len(ids), 1), dtype=sigma.dtype)
    density = Density(weight, said.mean_m[0, :, None], sigma[:, None], correlation[:, None])
    prediction = Prediction(said.mean_m[0], density)
    return {
        int(ids[v]): place_forecast(name, prediction, v, origin) for v in np.flatnonzero(said.vehicle_mask[0]).tolist()
    }


def find_origins(folder: TensorFolder, samples: npt.NDArray[np.int64]) -> Doubles:
    """(B, 2) the samples' last positions on the carriageway."""
    return np.asarray(locate_rows(folder, folder.sample_row[samples]), dtype=np.float64)


def place_forecast(model: str, said: Prediction, number: int, origin_m: Doubles) -> Forecast:
    """One sample's prediction, moved from its last position to the carriageway.

    Args:
        model: whose.
        said: of B samples.
        number: which of them.
        origin_m: (2,) the sample's last position.

    Raises:
        ValueError: a place is not a finite number.
    """
    position = said.position_m[number].astype(np.float64) + origin_m
    if not np.isfinite(position).all():
        raise NotFiniteError(model, "positions")
    return Forecast(
        model=model,
        position_m=position,
        alternatives=() if said.density is None else _place_density(said.density, number, origin_m),
        lateral=_name(LATERAL_MANEUVERS, said.lateral, number),
        longitudinal=_name(LONGITUDINAL_MANEUVERS, said.longitudinal, number),
    )


def _place_density(density: Density, number: int, origin_m: Doubles) -> tuple[Alternative, ...]:
    weight = density.weight[number].astype(np.float64)
    return tuple(
        Alternative(
            probability=float(weight[a]),
            mean_m=density.mean_m[number, a].astype(np.float64) + origin_m,
            sigma_m=density.sigma_m[number, a].astype(np.float64),
            correlation=density.correlation[number, a].astype(np.float64),
        )
        for a in np.argsort(-weight, kind="stable")
    )


def _name(names: tuple[str, ...], probabilities: Floats | None, number: int) -> dict[str, float] | None:
    if probabilities is None:
        return None
    return {name: round(float(share), 4) for name, share in zip(names, probabilities[number], strict=True)}
