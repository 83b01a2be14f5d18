"""Recipes: how a model is trained by default, in phases of losses with the optimiser's settings."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Phase:
    """A number of epochs with one loss.

    Args:
        loss: name of the loss, given to the network's `loss`.
        epochs: passes over the training part, or over as many samples as an epoch takes.
    """

    loss: str
    epochs: int


@dataclass(frozen=True)
class Recipe:
    """A model's own settings of training.

    Args:
        phases: one after the other; where a time budget is given, they share it in proportion to their epochs.
        batch_size: samples per step.
        learning_rate: highest learning rate of the optimiser.
        optimizer: `adam`, or `adamw` (decoupled weight decay).
        schedule: course of the learning rate: `constant`, or `cosine` after a short warm-up.
        max_gradient_norm: largest norm of the gradients; larger ones are scaled down.
    """

    phases: tuple[Phase, ...]
    batch_size: int = 128
    learning_rate: float = 1e-3
    optimizer: Literal["adam", "adamw"] = "adam"
    schedule: Literal["constant", "cosine"] = "constant"
    max_gradient_norm: float = 10.0

    @property
    def epochs(self) -> int:
        """Number of epochs of all phases together."""
        return sum(phase.epochs for phase in self.phases)

    def phase_at(self, spent: float, budget: float) -> Phase:
        """Return the phase after a part of a budget is spent, both in whole steps or both in seconds."""
        ended = 0
        for phase in self.phases:
            ended += phase.epochs
            if spent * self.epochs < ended * budget:  # of whole numbers, exact: no step falls into the wrong phase
                return phase
        return self.phases[-1]
