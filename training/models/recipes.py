"""How a model is trained when nobody says otherwise: phases of losses, and the optimiser's settings."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Phase:
    """So many epochs with one loss.

    Args:
        loss: what the network's `loss` is told.
        epochs: passes over the training part, or over as many samples of it as an epoch takes.
    """

    loss: str
    epochs: int


@dataclass(frozen=True)
class Recipe:
    """A model's own way of being trained.

    Args:
        phases: one after the other; where a time budget is given, they share it in proportion to their epochs.
        batch_size: samples per step.
        learning_rate: of the optimiser, at its height.
        optimizer: `adam`, or `adamw` (decoupled weight decay).
        schedule: of the learning rate: `constant`, or `cosine` after a short warm-up.
        max_gradient_norm: gradients are scaled down to this.
    """

    phases: tuple[Phase, ...]
    batch_size: int = 128
    learning_rate: float = 1e-3
    optimizer: Literal["adam", "adamw"] = "adam"
    schedule: Literal["constant", "cosine"] = "constant"
    max_gradient_norm: float = 10.0

    @property
    def epochs(self) -> int:
        """Of all phases together."""
        return sum(phase.epochs for phase in self.phases)

    def phase_at(self, spent: float, budget: float) -> Phase:
        """The phase after so much of a budget: in whole steps, or in seconds."""
        ended = 0
        for phase in self.phases:
            ended += phase.epochs
            if spent * self.epochs < ended * budget:  # of whole numbers, exact: no step falls into the wrong phase
                return phase
        return self.phases[-1]
