"""What the training loop asks of a torch network, and the way from its tensors to a prediction."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from tracklake.training.data.observed import Observed, Truth
from tracklake.training.models.prediction import Prediction

Answer = TypeVar("Answer")


class Network(nn.Module):
    """A model that learns. Heirs give `loss` and `say`; `forward` is theirs to define."""

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    def loss(self, observed: Any, truth: Truth[Tensor], phase: str) -> Tensor:  # noqa: ANN401  (Observed or ObservedScene of tensors)
        """() what a step of training makes smaller, over all B samples.

        Args:
            observed: `Observed` or `ObservedScene`, as the registry's `reads` says.
            truth: what came; the one place where a model is given it.
            phase: the recipe's `Phase.loss`.

        Raises:
            ValueError: no such phase.
        """
        raise NotImplementedError

    def say(self, observed: Any) -> Prediction:  # noqa: ANN401  (as above)
        """Predict; called without gradients, in evaluation mode, with tensors on the weights' device."""
        raise NotImplementedError

    def predict(self, observed: Any) -> Prediction:  # noqa: ANN401  (Observed or ObservedScene of NumPy arrays)
        """Predict B samples given as NumPy arrays."""
        return self.ask(observed, self.say)

    def ask(self, observed: Any, question: Callable[[Any], Answer]) -> Answer:  # noqa: ANN401  (as above)
        """Let a function see tensors on the weights' device: without gradients, in evaluation mode.

        Args:
            observed: of NumPy arrays.
            question: what to do with the same of tensors.
        """
        trained = self.training
        self.eval()
        try:
            with torch.no_grad():
                return question(observed.each(lambda array: torch.from_numpy(np.asarray(array)).to(self.device)))
        finally:
            self.train(trained)


class PlaceNetwork(Network):
    """A network that puts out places alone, of a sample's own history. Heirs give `forward` (B, H, 2) -> (B, F, 2)."""

    def loss(self, observed: Observed[Tensor], truth: Truth[Tensor], phase: str) -> Tensor:
        """() mean squared distance in m2; the only phase is `mse`."""
        check_phase(phase, "mse")
        return mean_squared_distance(self(observed.history), truth.future, truth.future_mask)

    def say(self, observed: Observed[Tensor]) -> Prediction:
        """Places only."""
        return Prediction(position_m=to_numpy(self(observed.history)))


def check_phase(phase: str, *known: str) -> None:
    """Refuse a loss that a model does not have.

    Raises:
        ValueError: no such phase.
    """
    if phase not in known:
        raise ValueError(f"unknown phase `{phase}` of training: expected one of {', '.join(known)}")


def to_numpy(tensor: Tensor) -> npt.NDArray[Any]:
    """A tensor of any device as an array."""
    return tensor.detach().cpu().numpy()


def mean_squared_distance(predicted: Tensor, future: Tensor, known: Tensor) -> Tensor:
    """Mean squared distance in m2 over the known positions: (..., F, 2), (..., F, 2), (..., F) -> ()."""
    squares = ((predicted - future) ** 2).sum(dim=-1)
    return (squares * known).sum() / known.sum().clamp(min=1)
