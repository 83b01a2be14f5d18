"""How the study's tables are written."""

from collections.abc import Iterable, Sequence

import polars as pl

from training.models import MODELS


def order(models: Iterable[str]) -> list[str]:
    """In the registry's order."""
    known = list(MODELS)
    return sorted(models, key=lambda name: (known.index(name) if name in known else len(known), name))


def show(rows: pl.DataFrame, figure: str, digits: int = 2) -> str:
    """Mean ± spread of the one row; a dash where there is no figure."""
    if not rows.height or rows[figure][0] is None:
        return "-"
    mean, spread = rows[figure][0], rows[f"{figure}_sd"][0]
    return (
        f"{mean:.{digits}f}" if spread is None or rows["seeds"][0] < 2 else f"{mean:.{digits}f} ± {spread:.{digits}f}"
    )


def grid(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(
        [
            f"| {' | '.join(head)} |",
            f"| {' | '.join('---' for _ in head)} |",
            *(f"| {' | '.join(row)} |" for row in body),
        ]
    )
