"""Logs of a training as CSV: a row after a number of steps and one after each epoch."""

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

Row = dict[str, float | int | str | None]

COURSE_FILE = "course.csv"
COURSE = {
    "step": "optimiser steps done",
    "epoch": "epoch of the last of them, from 0",
    "phase": "the recipe's loss",
    "seconds": "time since the training began, without interruptions",
    "loss": "mean over the steps since the row before",
    "learning_rate": "learning rate of the last step",
    "samples_per_s": "samples a second over the steps since the row before",
    "data_share": "share of the time of those steps that reading batches took",
}
"""Columns of course.csv and their meanings."""

EPOCHS_FILE = "epochs.csv"
EPOCHS = {
    "epoch": "from 0; the last one may be shorter than the others",
    "step": "optimiser steps done by its end",
    "phase": "the recipe's loss in its last step",
    "seconds": "as in course.csv, before validating",
    "loss": "mean over its steps of that phase",
    "validation_loss": "the same loss over the part `val`; empty where it is not measured",
    "best": "1 where that is the smallest of its phase so far, else 0; empty where it is not measured",
}
"""Columns of epochs.csv and their meanings."""


@contextmanager
def open_log(path: Path, columns: dict[str, str], rows: list[Row]) -> Iterator[Callable[[Row], None]]:
    """Open a CSV file and yield a function that adds a row to the file, at once, and to the list.

    Args:
        path: file of the log, replaced where it exists by the rows known already.
        columns: names of the columns, in order.
        rows: rows known already; grows with the file.
    """
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        stream.flush()

        def write_row(row: Row) -> None:
            rows.append(row)
            writer.writerow(row)
            stream.flush()

        yield write_row
