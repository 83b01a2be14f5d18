"""How a training went, as CSV: a row every so many steps, and one per epoch, on the disk as soon as they are made."""

import csv
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

Row = dict[str, float | int | str | None]

COURSE_FILE = "course.csv"
COURSE = {
    "step": "optimiser steps done",
    "epoch": "of the last of them, from 0",
    "phase": "the recipe's loss",
    "seconds": "since the training began, without the time it was interrupted",
    "loss": "mean over the steps since the row before",
    "learning_rate": "of the last step",
    "samples_per_s": "over the steps since the row before",
    "data_share": "of the time of those steps, the share spent on reading batches",
}
"""Columns and what they mean."""

EPOCHS_FILE = "epochs.csv"
EPOCHS = {
    "epoch": "from 0; the last one may be shorter than the others",
    "step": "optimiser steps done by its end",
    "phase": "the recipe's loss, of its last step",
    "seconds": "as in course.csv, before validating",
    "loss": "mean over its steps of that phase",
    "validation_loss": "of the same phase over the part `val`; empty where it is not measured",
    "best": "1 where that is the least of its phase so far, else 0; empty where it is not measured",
}
"""Likewise of the epochs."""


@contextmanager
def writing_rows(path: Path, columns: dict[str, str], rows: list[Row]) -> Iterator[Callable[[Row], None]]:
    """A CSV file of certain rows, and a function that adds one to the file and to the list.

    Args:
        path: of the file; replaced where it exists, so that it holds the rows given and no others.
        columns: their names, in order.
        rows: what is known already; grows with the file.
    """
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        stream.flush()

        def write(row: Row) -> None:
            rows.append(row)
            writer.writerow(row)
            stream.flush()

        yield write
