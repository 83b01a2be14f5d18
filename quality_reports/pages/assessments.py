"""Tables of the assessed repair windows: a row per subset or start position, estimators side by side."""

from collections.abc import Mapping, Sequence
from typing import Any

from tracklake.quality_reports.summaries import Row
from tracklake.schemas.quality_tracks import Assessed
from tracklake.schemas.start_assessments import ESTIMATORS


def tabulate_assessments(assessed: Assessed) -> Row:
    """Put the estimators of each subset and of each position side by side.

    Returns:
        estimators: names in order. overall: rows of the whole lake, by estimator. subsets: {dataset, subset, starts,
        missing_s, estimators: rows by estimator}, sums per dataset (subset null) after its subsets. positions: the
        same with beyond_m instead of subset.
    """
    of_datasets = [row for row in assessed["subsets"] if row["dataset"] is not None]
    return {
        "estimators": list(ESTIMATORS),
        "overall": {row["estimator"]: row for row in assessed["subsets"] if row["dataset"] is None},
        "subsets": _group(of_datasets, ("dataset", "subset")),
        "positions": _group(assessed["positions"], ("dataset", "beyond_m")),
    }


def _group(rows: Sequence[Mapping[str, Any]], key: tuple[str, ...]) -> list[Row]:
    """Return one row per key; all estimators were measured on the same cut tracks."""
    found: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        shared = {name: row[name] for name in (*key, "starts", "missing_s")}
        group = found.setdefault(tuple(row[name] for name in key), {**shared, "estimators": {}})
        group["estimators"][row["estimator"]] = row
    return list(found.values())
