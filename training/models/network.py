"""The interface of the torch networks, what their outputs are added to, and what their losses share."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import Protocol
from tracklake.training.data.observed import Observed, Truth
from tracklake.training.models.motion import count_velocity_ticks, extrapolate
from tracklake.training.models.prediction import Prediction

Result = TypeVar("Result")

ANCHORINGS = {"both": (1.0, 1.0), "longitudinal": (1.0, 0.0), "lateral": (0.0, 1.0), "none": (0.0, 0.0)}
"""Choices of the axes, along and across the road, on which outputs are counted from constant velocity."""


class Network(nn.Module):
    """A model that learns; subclasses define `loss` and `predict_tensors`."""

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(self.parameters()).device

    def loss(self, observed: Any, truth: Truth[Tensor], phase: str) -> Tensor:  # noqa: ANN401  (Observed or ObservedScene of tensors)
        """Return () the loss over all B samples; raises ValueError on a phase that is no loss of the network.

        Args:
            observed: `Observed` or `ObservedScene`, as the registry's `reads` says.
            truth: futures and maneuvers; no other method of a model gets them.
            phase: the recipe's `Phase.loss`.
        """
        raise NotImplementedError

    def supervised(self, observed: Any, truth: Truth[Tensor]) -> Tensor:  # noqa: ANN401, ARG002  (as above; what a scene's loss covers depends on it)
        """Return the true positions that the loss covers: (B, F), of scenes (B, V, F)."""
        return truth.future_mask

    def predict_tensors(self, observed: Any) -> Prediction:  # noqa: ANN401  (as above)
        """Predict B samples given as tensors on the weights' device; called by `infer`."""
        raise NotImplementedError

    def predict(self, observed: Any) -> Prediction:  # noqa: ANN401  (Observed or ObservedScene of NumPy arrays)
        """Predict B samples given as NumPy arrays."""
        return self.infer(observed, self.predict_tensors)

    def infer(self, observed: Any, function: Callable[[Any], Result]) -> Result:  # noqa: ANN401  (as above)
        """Call a function with NumPy inputs as tensors on the weights' device, in evaluation mode without gradients."""
        trained = self.training
        self.eval()
        try:
            with torch.no_grad():
                return function(observed.each(lambda array: torch.from_numpy(np.asarray(array)).to(self.device)))
        finally:
            self.train(trained)


class PlaceNetwork(Network):
    """A network that predicts positions from a sample's own history: `forward` (B, H, 2) -> (B, F, 2)."""

    def loss(self, observed: Observed[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """Return () the mean squared distance in m2; the only phase is `mse`."""
        check_phase(phase, "mse")
        return mean_squared_distance(self(observed.history), truth.future, truth.future_mask)

    def predict_tensors(self, observed: Observed[Tensor]) -> Prediction:
        """Return the positions alone."""
        return Prediction(position_m=to_numpy(self(observed.history)))


class Straight(nn.Module):
    """The fixed positions that a network's outputs are added to; nothing in it is learned.

    On an axis that is anchored (see ANCHORINGS): constant velocity, so that a network is left with braking,
    accelerating and changing lanes, and an error of 1 % of the distance driven costs it nothing. Otherwise the sample's
    last position, as published.
    """

    def __init__(self, protocol: Protocol, *, anchoring: str) -> None:
        super().__init__()
        self.ticks = count_velocity_ticks(protocol)
        steps = torch.arange(1, protocol.horizon_ticks + 1, dtype=torch.float32)[:, None]
        self.steps: Tensor
        self.register_buffer("steps", steps * find_anchored(anchoring), persistent=False)  # (F, 2)

    def forward(self, history: Tensor) -> Tensor:
        """Return (..., F, 2) in m relative to the last position of histories (..., H, 2)."""
        positions: Tensor = extrapolate(history, self.ticks, self.steps)
        return positions


def find_anchored(anchoring: str) -> Tensor:
    """Return (2,) 1 for each axis, along and across the road, that is anchored, else 0."""
    check_choice("anchoring", anchoring, tuple(ANCHORINGS))
    return torch.tensor(ANCHORINGS[anchoring])


def check_phase(phase: str, *known: str) -> None:
    """Raise ValueError where a model has no loss of a phase."""
    if phase not in known:
        raise ValueError(f"unknown phase `{phase}` of training: expected one of {', '.join(known)}")


def check_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    """Raise UsageError where a parameter's value is none of those known."""
    if value not in known:
        raise UsageError(f"parameter `{name}`: expected one of {', '.join(known)}, got {value!r}")


def to_numpy(tensor: Tensor) -> npt.NDArray[Any]:
    """Convert a tensor on any device to an array."""
    return tensor.detach().cpu().numpy()


def mean_squared_distance(predicted: Tensor, future: Tensor, known: Tensor) -> Tensor:
    """Return () the mean squared distance in m2 over known positions: (..., F, 2), (..., F, 2), (..., F)."""
    if predicted.shape != future.shape:
        raise UsageError(f"expected predicted positions of shape {tuple(future.shape)}, got {tuple(predicted.shape)}")
    squares = ((predicted - future) ** 2).sum(dim=-1)
    return (squares * known).sum() / known.sum().clamp(min=1)
