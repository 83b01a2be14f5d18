"""Progress of a training between two steps, and its logs as CSV."""

import csv
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Row = dict[str, float | int | str | None]

COLUMNS = {
    "course.csv": ("step", "epoch", "phase", "seconds", "loss", "learning_rate", "samples_per_s", "data_share"),
    "epochs.csv": ("epoch", "step", "phase", "seconds", "loss", "validation_loss", "best"),
}
"""Columns of each log; docs/training.md has their meanings."""


@contextmanager
def open_log(path: Path, rows: list[Row]) -> Iterator[Callable[[Row], None]]:
    """Write known rows to a log and yield a function that adds one to the file, at once, and to `rows`."""
    with path.open("w", encoding="utf-8", newline="", buffering=1) as stream:
        writer = csv.DictWriter(stream, COLUMNS[path.name], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)

        def write_row(row: Row) -> None:
            rows.append(row)
            writer.writerow(row)

        yield write_row


@dataclass
class TrainingState:
    """Progress of a training between two steps, apart from weights and optimiser."""

    step: int = 0  # optimiser steps done; gives the epoch and the place in it, too
    samples: int = 0  # in these steps
    supervised: int = 0  # true positions that the loss covered in these steps
    elapsed_s: float = 0.0  # since the start, without interruptions
    stepping_s: float = 0.0  # time in steps, reading included
    reading_s: float = 0.0  # time for reading batches
    smooth_loss: float = math.nan  # running mean of the loss
    losses: list[float] = field(default_factory=list)  # of every step
    phases: list[tuple[str, int]] = field(default_factory=list)  # loss of each phase so far, and its first step
    course: list[Row] = field(default_factory=list)  # rows of course.csv
    epochs: list[Row] = field(default_factory=list)  # rows of epochs.csv
    logged: tuple[int, int, float, float] = (0, 0, 0.0, 0.0)  # step, samples, stepping_s, reading_s at its last row
    best_loss: float | None = None  # smallest validation loss of the present phase
    best_epoch: int | None = None  # epoch of that loss
    best_weights: dict[str, Any] | None = None  # at its end
    stale_epochs: int = 0  # of the last phase since then

    @property
    def phase(self) -> str:
        """Loss of the present phase."""
        return self.phases[-1][0]

    def begin_phase(self, loss: str) -> None:
        """Begin a phase with another loss, which is not compared with the one before."""
        self.phases.append((loss, self.step))
        self.smooth_loss = math.nan
        self.best_loss = self.best_epoch = self.best_weights = None

    def count_step(self, loss: float, samples: int, supervised: int) -> None:
        """Count one more step with its loss and its numbers of samples and of supervised positions."""
        self.step += 1
        self.samples += samples
        self.supervised += supervised
        self.losses.append(loss)
        self.smooth_loss = loss if math.isnan(self.smooth_loss) else 0.98 * self.smooth_loss + 0.02 * loss

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
