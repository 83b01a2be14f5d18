"""Errors, sigma and levels of every sample of a part at the scored horizons."""

from typing import Any

import numpy as np

from tracklake.schemas.arrays import Flags, Integers, Singles
from tracklake.training.comparison.calibration import find_levels, find_variance
from tracklake.training.data.observed import Truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.scores import find_vehicles
from tracklake.training.models.prediction import Density, Prediction


class SampleRecord:
    """Records of the S samples of a part at its T scored horizons, filled batch by batch by `observe`.

    Attributes:
        samples: (S,) their numbers.
        vehicle: (S,) their vehicles, counted from 0.
        seconds: the T horizons.
        known: (S, T) whether the true position is known.
        error_m: (S, T, 2) predicted minus true position; NaN where the truth is not known. Where lateral positions are
            lane centres, figures across the road and levels are NaN.
        sigma_m: (S, T, 2) standard deviation of the predicted density; NaN where the model gives none.
        level: (S, T) probability of the smallest region that holds the truth (`calibration`); NaN likewise.
    """

    def __init__(self, folder: TensorFolder, part: str) -> None:
        self.samples: Integers = folder.samples_of(part)
        subset, self.vehicle = find_vehicles(folder, self.samples)
        self._lane_centred = folder.lane_centred[subset]
        protocol = folder.protocol
        self._at = np.array(protocol.scored_ticks) - 1
        self.seconds = [tick / protocol.rate_hz for tick in protocol.scored_ticks]
        shape = (len(self.samples), len(self._at))
        self.known: Flags = np.zeros(shape, dtype=np.bool_)
        self.level: Singles = np.full(shape, np.nan, dtype=np.float32)
        self.error_m, self.sigma_m = (np.full((*shape, 2), np.nan, dtype=np.float32) for _ in range(2))

    def observe(self, chosen: slice, prediction: Prediction, truth: Truth[Any]) -> None:
        """Add a batch of an evaluation (`training.evaluation.evaluate.Observer`)."""
        known, future = truth.future_mask[:, self._at], truth.future[:, self._at]
        self.known[chosen] = known
        self.error_m[chosen] = np.where(known[..., None], prediction.position_m[:, self._at] - future, np.nan)
        if prediction.density is not None:
            own = prediction.density
            at = Density(
                own.weight, own.mean_m[:, :, self._at], own.sigma_m[:, :, self._at], own.correlation[:, :, self._at]
            )
            self.level[chosen] = np.where(known, find_levels(at, future), np.nan)
            self.sigma_m[chosen] = np.sqrt(find_variance(at))
        unknown = self._lane_centred[chosen]
        self.error_m[chosen][unknown, :, 1] = np.nan
        self.sigma_m[chosen][unknown, :, 1] = np.nan
        self.level[chosen][unknown] = np.nan
