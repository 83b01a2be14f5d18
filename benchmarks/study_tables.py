"""How the study's tables are written."""

from collections.abc import Iterable, Sequence

import polars as pl

from tracklake.schemas.evaluations import EVERYTHING
from tracklake.training.models import MODELS

FEW = 30
"""Figures over fewer samples are not shown."""


def pick(
    rows: pl.DataFrame, dataset: str = EVERYTHING, group: str = EVERYTHING, average: str = "samples"
) -> pl.DataFrame:
    """Rows of one dataset, group and average."""
    return rows.filter((pl.col("dataset") == dataset) & (pl.col("group") == group) & (pl.col("average") == average))


def order(models: Iterable[str]) -> list[str]:
    """In the registry's order."""
    known = list(MODELS)
    return sorted(models, key=lambda name: (known.index(name) if name in known else len(known), name))


def show(rows: pl.DataFrame, figure: str, digits: int = 2) -> str:
    """Mean ± spread of the one row; a dash where there is no figure, or one of few samples."""
    if not rows.height or rows[figure][0] is None or ("n" in rows.columns and rows["n"][0] < FEW):
        return "-"
    mean, spread = rows[figure][0], rows[f"{figure}_sd"][0]
    shown = f"{mean:.{digits}f}"
    return shown if spread is None or rows["seeds"][0] < 2 else f"{shown} ± {spread:.{digits}f}"


def grid(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [f"| {' | '.join(head)} |", f"| {' | '.join('---' for _ in head)} |"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in body)])
