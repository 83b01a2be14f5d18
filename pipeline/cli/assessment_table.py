"""What `tracklake repair --assess` says of the estimates: coverage and excess over the whole lake."""

from pathlib import Path
from typing import Any

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.lake import connect
from tracklake.quality_reports.summaries import query
from tracklake.schemas.start_assessments import ESTIMATORS


def show_assessment(terminal: Terminal, root: Path) -> list[dict[str, Any]]:
    """Print how good the windows are, beside the other estimators'.

    Args:
        terminal: for people.
        root: the lake.

    Returns:
        Rows of assessed_subsets.sql over the whole lake, one per estimator; none where no track could be cut.
    """
    with connect(root) as connection:
        rows = query(connection, "assessed_subsets", {"estimators": list(ESTIMATORS)})
    overall = [row for row in rows if row["dataset"] is None]
    if not overall:
        terminal.say("no estimate could be measured: no vehicle is fully tracked as far as 20 m beyond the cut-off")
        return []
    ours, *others = overall
    terminal.say(
        f"the windows cover {ours['coverage']:.2%} of the time truly missing, and {ours['excess']:.2%} of it is "
        f"excluded in vain ({ours['starts']:,} cut tracks, {ours['missing_s']:,.1f} s)"
    )
    beside = (f"{row['estimator'].replace('_', ' ')} {row['coverage']:.2%} / {row['excess']:.2%}" for row in others)
    terminal.say(f"beside it: {', '.join(beside)}")
    return overall
