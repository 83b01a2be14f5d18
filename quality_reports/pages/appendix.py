"""Tables of speeds and errors as in Hamalainen (2020), each row of the lake followed by the published one."""

from collections.abc import Mapping
from typing import Any

from tracklake.quality_reports.pages.rendering import label_sums
from tracklake.quality_reports.summaries import Row
from tracklake.schemas.quality import Quality
from tracklake.schemas.quality_tracks import PublishedFigures

FIGURES = ("min_mps", "p2_5_mps", "median_mps", "p97_5_mps", "max_mps", "mean_mps", "std_mps")
"""Columns of speeds_per_second.sql that Hamalainen (2020) publishes, in m/s."""
COUNTED = (
    ("headway", "negative_headway_recorded"),
    ("acceleration", "high_acceleration"),
    ("slow", "low_constant_speed"),
)
"""Errors that Hamalainen (2020) counts, and the rules that count them in the same way."""
COUNTS = ("vehicles", "vehicle_share", "entries", "entry_share")
"""Figures of each of these errors."""


def compare_speeds(quality: Quality) -> list[Row]:
    """Return speeds over seconds per dataset and subset, each row followed by the published one where there is one.

    Returns:
        Rows with label, dataset, subset, is_published, seconds, and FIGURES.
    """
    published = _index_published(quality)
    compared = []
    for row in quality["speeds"]["per_second"]:
        compared.append({**label_sums(row), "is_published": False})
        figures = published.get((row["dataset"], row["subset"]))
        if figures is not None:
            speeds = {name: figures.get(name) for name in FIGURES}
            compared.append({**_label_published(row), "seconds": None, **speeds})
    return compared


def count_errors(quality: Quality) -> list[Row]:
    """Count the three errors of Hamalainen (2020) per dataset and subset, each row followed by the published one.

    Returns:
        Rows with label, dataset, subset, is_published and, for each error, `<error>_<count>` of COUNTED and COUNTS.
    """
    published = _index_published(quality)
    rules = {rule["name"]: rule for rule in quality["rules"]}
    if not all(rule in rules for _, rule in COUNTED):
        return []
    found: dict[tuple[str, str | None], Row] = {}
    for error, rule in COUNTED:
        rows_of_rule: list[Mapping[str, Any]] = [*rules[rule]["datasets"], *rules[rule]["subsets"]]
        for each in rows_of_rule:
            counts = {f"{error}_{count}": each[count] for count in COUNTS}
            found.setdefault((each["dataset"], each.get("subset")), {}).update(counts)
    rows = []
    for (dataset, subset), counts in sorted(found.items(), key=lambda item: (item[0][0], item[0][1] or "")):
        row = {"dataset": dataset, "subset": subset}
        rows.append({**label_sums(row), **counts, "is_published": False})
        figures = published.get((dataset, subset))
        if figures is not None:
            rows.append({**_label_published(row), **_count_published(figures)})
    return rows


def _index_published(quality: Quality) -> dict[tuple[str, str | None], PublishedFigures]:
    """Return the published figures by (dataset, subset); NGSIM's recordings are one subset each, of the same name."""
    return {(row["dataset"], row["recording"]): row for row in quality["published"]["figures"]}


def _count_published(figures: Mapping[str, Any]) -> Row:
    """Return the published counts of the three errors, with their shares."""
    counts: Row = {}
    for error, _ in COUNTED:
        vehicles, entries = figures.get(f"{error}_vehicles"), figures.get(f"{error}_entries")
        counts |= {
            f"{error}_vehicles": vehicles,
            f"{error}_vehicle_share": _divide(vehicles, figures["vehicles"]),
            f"{error}_entries": entries,
            f"{error}_entry_share": _divide(entries, figures["entries"]),
        }
    return counts


def _divide(part: int | None, whole: int | None) -> float | None:
    """Return the share of a part; None where either is unknown."""
    return part / whole if part is not None and whole else None


def _label_published(row: Mapping[str, Any]) -> Row:
    """Return the beginning of a row of published figures."""
    return {"dataset": row["dataset"], "subset": row["subset"], "label": "published", "is_published": True}
