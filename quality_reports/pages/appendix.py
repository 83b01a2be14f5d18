"""The tables that the validating study prints as appendices: what was found, and beneath it what was published."""

from collections.abc import Sequence
from typing import Any

from tracklake.quality_reports.pages.rendering import label_sums
from tracklake.quality_reports.published import is_comparable

Row = dict[str, Any]

FIGURES = ("min_mps", "p2_5_mps", "median_mps", "p97_5_mps", "max_mps", "mean_mps", "std_mps")
COUNTED = (
    ("headway", "negative_headway_recorded"),
    ("acceleration", "high_acceleration"),
    ("slow", "low_constant_speed"),
)
"""The errors that the study counts, and the rules that count as it does."""
COUNTS = ("vehicles", "vehicle_share", "entries", "entry_share")


def compare_speeds(quality: Row) -> list[Row]:
    """Speeds over seconds, datasets first and then their subsets, each followed by what was published, if anything.

    Args:
        quality: as `quality_reports.summaries.collect` returns it.

    Returns:
        Rows with label, dataset, subset, is_published, seconds, and FIGURES.
    """
    published = _by_subset(quality)
    compared = []
    for row in quality["speeds"]["per_second"]:
        compared.append({**label_sums(row), "is_published": False})
        figures = published.get((row["dataset"], row["subset"]))
        if figures is not None:
            told = {name: figures.get(name) for name in FIGURES}
            compared.append({**_published_row(row), "seconds": None, **told})
    return compared


def count_errors(quality: Row) -> list[Row]:
    """The study's three errors per dataset and subset, each followed by what was published, if anything.

    Args:
        quality: as `quality_reports.summaries.collect` returns it.

    Returns:
        Rows with label, dataset, subset, is_published and, for each error, `<error>_<count>` of COUNTED and COUNTS.
    """
    published = _by_subset(quality)
    rules = {rule["name"]: rule for rule in quality["rules"]}
    if not all(rule in rules for _, rule in COUNTED):
        return []
    found: dict[tuple[str, str | None], Row] = {}
    for error, rule in COUNTED:
        of_datasets = [{**row, "subset": None} for row in rules[rule]["datasets"]]
        for row in (*of_datasets, *rules[rule]["subsets"]):
            counts = {f"{error}_{count}": row[count] for count in COUNTS}
            found.setdefault((row["dataset"], row["subset"]), {}).update(counts)
    rows = []
    for (dataset, subset), counts in sorted(found.items(), key=lambda item: (item[0][0], item[0][1] or "")):
        row = {"dataset": dataset, "subset": subset}
        rows.append({**label_sums(row), **counts, "is_published": False})
        figures = published.get((dataset, subset))
        if figures is not None:
            rows.append({**_published_row(row), **_published_counts(figures)})
    return rows


def _by_subset(quality: Row) -> dict[tuple[str, str | None], Row]:
    """Published figures of what the lake holds, by (dataset, subset).

    NGSIM's freeway recordings are one subset each, of the same name.
    """
    held: dict[str, set[str]] = {}
    for row in quality["subsets"]:
        held.setdefault(row["dataset"], set()).add(row["recording"])
    figures: Sequence[Row] = quality["published"]["figures"]
    return {(row["dataset"], row["recording"]): row for row in figures if is_comparable(row, held)}


def _published_counts(figures: Row) -> Row:
    counts: Row = {}
    for error, _ in COUNTED:
        vehicles, entries = figures.get(f"{error}_vehicles"), figures.get(f"{error}_entries")
        counts |= {
            f"{error}_vehicles": vehicles,
            f"{error}_vehicle_share": _share(vehicles, figures["vehicles"]),
            f"{error}_entries": entries,
            f"{error}_entry_share": _share(entries, figures["entries"]),
        }
    return counts


def _share(part: int | None, whole: int | None) -> float | None:
    return part / whole if part is not None and whole else None


def _published_row(row: Row) -> Row:
    return {"dataset": row["dataset"], "subset": row["subset"], "label": "published", "is_published": True}
