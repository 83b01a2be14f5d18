"""Where a training stands between two steps, weights and optimiser apart."""

import math
from dataclasses import dataclass, field
from typing import Any

from tracklake.training.runs.logs import Row


@dataclass
class TrainingState:
    """Where a training stands, weights and optimiser apart.

    Args:
        step: optimiser steps done; says the epoch and the place in it, too.
        samples: in these steps.
        elapsed_s: since it began, interruptions left out.
        stepping_s: of these, in steps, batches read included.
        reading_s: of these, for batches.
        smooth_loss: running mean of the loss.
        losses: of every step.
        phases: loss of each phase so far, and its first step.
        course: rows of course.csv.
        epochs: rows of epochs.csv.
        marked: step, samples, stepping_s and reading_s at the last row of course.csv.
        best_loss: least validation loss of the present phase.
        best_epoch: where it was.
        best_weights: and with which weights.
        stale_epochs: of the last phase, since then.
    """

    step: int = 0
    samples: int = 0
    elapsed_s: float = 0.0
    stepping_s: float = 0.0
    reading_s: float = 0.0
    smooth_loss: float = math.nan
    losses: list[float] = field(default_factory=list)
    phases: list[tuple[str, int]] = field(default_factory=list)
    course: list[Row] = field(default_factory=list)
    epochs: list[Row] = field(default_factory=list)
    marked: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)
    best_loss: float | None = None
    best_epoch: int | None = None
    best_weights: dict[str, Any] | None = None
    stale_epochs: int = 0

    def begin_phase(self, loss: str) -> None:
        """Another loss from here on; losses of two kinds are not compared."""
        self.phases.append((loss, self.step))
        self.smooth_loss = math.nan
        self.best_loss = self.best_epoch = self.best_weights = None

    def take_step(self, loss: float, samples: int) -> None:
        """One more step is done."""
        self.step += 1
        self.samples += samples
        self.losses.append(loss)
        self.smooth_loss = loss if math.isnan(self.smooth_loss) else 0.98 * self.smooth_loss + 0.02 * loss
