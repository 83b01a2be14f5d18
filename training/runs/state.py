"""The progress of a training between two steps, apart from weights and optimiser."""

import math
from dataclasses import dataclass, field
from typing import Any

from tracklake.training.runs.logs import Row


@dataclass
class TrainingState:
    """Progress of a training between two steps, apart from weights and optimiser.

    Args:
        step: optimiser steps done; gives the epoch and the place in it, too.
        samples: samples in these steps.
        elapsed_s: time since the start in s, without interruptions.
        stepping_s: time in steps, in s, reading included.
        reading_s: time for reading batches, in s.
        smooth_loss: running mean of the loss.
        losses: loss of every step.
        phases: loss of each phase so far, and its first step.
        course: rows of course.csv.
        epochs: rows of epochs.csv.
        logged: step, samples, stepping_s and reading_s at the last row of course.csv.
        best_loss: smallest validation loss of the present phase.
        best_epoch: epoch of that loss.
        best_weights: weights at its end.
        stale_epochs: epochs of the last phase since then.
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
    logged: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)
    best_loss: float | None = None
    best_epoch: int | None = None
    best_weights: dict[str, Any] | None = None
    stale_epochs: int = 0

    def begin_phase(self, loss: str) -> None:
        """Begin a phase with another loss, which is not compared with the one before."""
        self.phases.append((loss, self.step))
        self.smooth_loss = math.nan
        self.best_loss = self.best_epoch = self.best_weights = None

    def describe_phases(self) -> list[dict[str, Any]]:
        """Describe each phase: loss, steps, and the loss's mean over their first and last twentieth."""
        ends = [*(first for _, first in self.phases[1:]), self.step]
        phases = []
        for (loss, first), end in zip(self.phases, ends, strict=True):
            losses = self.losses[first:end]
            some = max(1, len(losses) // 20)
            means = {"loss_first": sum(losses[:some]) / some, "loss_last": sum(losses[-some:]) / some}
            phases.append({"loss": loss, "steps": len(losses), **means})
        return phases

    def count_step(self, loss: float, samples: int) -> None:
        """Count one more step with its loss and number of samples."""
        self.step += 1
        self.samples += samples
        self.losses.append(loss)
        self.smooth_loss = loss if math.isnan(self.smooth_loss) else 0.98 * self.smooth_loss + 0.02 * loss
