"""The assessed repair windows as the report's tables: a row per subset or start position, estimators side by side."""

from collections.abc import Sequence
from typing import Any

from tracklake.schemas.start_assessments import ESTIMATORS

Row = dict[str, Any]


def tabulate_assessments(assessed: dict[str, list[Row]]) -> Row:
    """Put the estimators of each subset and of each position beside one another.

    Args:
        assessed: `starts.assessed` of `quality_reports.summaries.collect`.

    Returns:
        estimators: their names in order. overall: rows by estimator, of the whole lake. subsets: {dataset, subset,
        starts, missing_s, estimators: rows by estimator}, sums per data set (subset null) behind its subsets.
        positions: the same with beyond_m for the subset.
    """
    of_datasets = [row for row in assessed["subsets"] if row["dataset"] is not None]
    return {
        "estimators": list(ESTIMATORS),
        "overall": {row["estimator"]: row for row in assessed["subsets"] if row["dataset"] is None},
        "subsets": _beside(of_datasets, ("dataset", "subset")),
        "positions": _beside(assessed["positions"], ("dataset", "beyond_m")),
    }


def _beside(rows: Sequence[Row], key: tuple[str, ...]) -> list[Row]:
    """One row per key; all estimators were measured on the same cut tracks."""
    found: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        shared = {name: row[name] for name in (*key, "starts", "missing_s")}
        beside = found.setdefault(tuple(row[name] for name in key), {**shared, "estimators": {}})
        beside["estimators"][row["estimator"]] = row
    return list(found.values())
