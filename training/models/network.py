"""The interface of the torch networks that the training loop trains, and their way to a prediction."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tracklake.training.data.observed import Observed, Truth
from tracklake.training.models.prediction import Prediction

Result = TypeVar("Result")


class Network(nn.Module):
    """A model that learns; subclasses define `loss` and `predict_tensors`."""

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(self.parameters()).device

    def loss(self, observed: Any, truth: Truth[Tensor], phase: str) -> Tensor:  # noqa: ANN401  (Observed or ObservedScene of tensors)
        """Return () the loss over all B samples.

        Args:
            observed: `Observed` or `ObservedScene`, as the registry's `reads` says.
            truth: futures and maneuvers; no other method of a model gets them.
            phase: the recipe's `Phase.loss`.

        Raises:
            ValueError: no such phase.
        """
        raise NotImplementedError

    def predict_tensors(self, observed: Any) -> Prediction:  # noqa: ANN401  (as above)
        """Predict B samples given as tensors on the weights' device; called by `infer`."""
        raise NotImplementedError

    def predict(self, observed: Any) -> Prediction:  # noqa: ANN401  (Observed or ObservedScene of NumPy arrays)
        """Predict B samples given as NumPy arrays."""
        return self.infer(observed, self.predict_tensors)

    def infer(self, observed: Any, function: Callable[[Any], Result]) -> Result:  # noqa: ANN401  (as above)
        """Call a function with tensors on the weights' device, without gradients and in evaluation mode.

        Args:
            observed: `Observed` or `ObservedScene` of NumPy arrays.
            function: called with the same of tensors.
        """
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


def check_phase(phase: str, *known: str) -> None:
    """Refuse a loss that a model does not have.

    Raises:
        ValueError: no such phase.
    """
    if phase not in known:
        raise ValueError(f"unknown phase `{phase}` of training: expected one of {', '.join(known)}")


def to_numpy(tensor: Tensor) -> npt.NDArray[Any]:
    """Convert a tensor on any device to an array."""
    return tensor.detach().cpu().numpy()


def mean_squared_distance(predicted: Tensor, future: Tensor, known: Tensor) -> Tensor:
    """Return () the mean squared distance in m2 over known positions: (..., F, 2), (..., F, 2), (..., F)."""
    squares = ((predicted - future) ** 2).sum(dim=-1)
    return (squares * known).sum() / known.sum().clamp(min=1)
