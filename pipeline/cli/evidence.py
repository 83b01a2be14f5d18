"""What `tracklake evaluate` shows beside the scores: differences between models with their intervals."""

from collections.abc import Sequence

import polars as pl

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.score_tables import HEADINGS, find_headline
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.training.comparison.arms import compare_arms
from tracklake.training.evaluation.evaluate import Evaluation

LINES = {"": "difference", "  lower bound": "low", "  upper bound": "high"}
"""Lines of a compared pair, and the columns that they show."""


def show_comparisons(terminal: Terminal, evaluations: Sequence[Evaluation]) -> pl.DataFrame:
    """Compare the first model with every other one, and print the differences of the headline errors and of NLL."""
    table = compare_arms(evaluations)
    seconds = table["seconds"].unique().sort().to_list()
    for figure in (*find_headline(evaluations[0].protocol.headline, set(table["figure"])), "nll_nats"):
        rows = table.filter(figure=figure)
        lines = [
            [name or f"{a} - {b}", *(format_number(value, 3) for value in own[column])]
            for (a, b), own in rows.group_by("a", "b", maintain_order=True)
            for name, column in LINES.items()
        ]
        if lines:
            title = f"difference of {HEADINGS[figure]}"
            print_table(terminal, ["", *(f"{ahead:g} s" for ahead in seconds)], lines, title=title, fold=True)
    vehicles = int(table["vehicles"].to_numpy().max())
    terminal.print_line(
        f"below 0 the first is better; bounds: 95 % interval over {vehicles:,} vehicles, and seeds where there are "
        "several (docs/training.md); with 0 between the bounds, no difference is shown",
        style="dim",
    )
    single = [name for name, of in (("a", "a_seeds"), ("b", "b_seeds")) for name in table.filter(pl.col(of) == 1)[name]]
    drawn = [own.model for own in evaluations if own.run.get("recipe") and own.model in single]
    if drawn:
        terminal.print_line(f"note: {', '.join(drawn)}: one seed; another one may change the difference", style="dim")
    return table
