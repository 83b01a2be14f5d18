"""Reports on many subsets: sums by site and day, and the subsets with the worst verdicts in place of all."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

from tracklake.quality_reports.verdicts import BAD, CARE, GOOD, UNKNOWN, rank_verdicts
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.quality import Quality
from tracklake.schemas.quality_tracks import SubsetGroup

MANY_SUBSETS = 400
"""Most subsets that a report lists one by one, each with a page of its own."""
SHOWN_SUBSETS = 100
"""Subsets that it lists where there are more."""
DATE = re.compile(r"(?<!\d)(20\d\d)-?([01]\d)-?([0-3]\d)(?!\d)")
"""Date in the name of a recording."""


def shorten(quality: Quality) -> Quality:
    """Return the figures with sums by site and day, where there are many subsets, and else unchanged.

    Of what is listed by subset or recording, those with the worst verdicts are left; totals are of the whole lake.
    """
    if len(quality["subsets"]) <= MANY_SUBSETS:
        return quality
    worst = {(row["dataset"], row["subset"]) for row in rank_verdicts(quality["verdicts"])[:SHOWN_SUBSETS]}
    shown = [row for row in quality["subsets"] if (row["dataset"], row["subset"]) in worst]
    recordings = {(row["dataset"], row["recording"]) for row in shown}
    hashes = {
        (row["dataset"], row["file"])
        for row in quality["ingestion"]["files"]
        if (row["dataset"], row["recording"]) in recordings
    }

    def is_shown(row: Mapping[str, Any]) -> bool:
        if "dataset" not in row:  # a drive
            return True
        if row.get("subset") is not None:
            return (row["dataset"], row["subset"]) in worst
        if row.get("recording") is not None:
            return (row["dataset"], row["recording"]) in recordings
        return "sha256" not in row or (row["dataset"], row["file"]) in hashes

    return cast("Quality", {**_select(quality, is_shown), "groups": sum_groups(quality)})


def _select(value: Any, is_shown: Any) -> Any:  # noqa: ANN401  (any part of the document)
    """Return a part of the document without the rows that are not shown."""
    if isinstance(value, Mapping):
        return {name: _select(each, is_shown) for name, each in value.items()}
    if isinstance(value, list):
        return [_select(each, is_shown) for each in value if not isinstance(each, Mapping) or is_shown(each)]
    return value


def sum_groups(quality: Quality) -> list[SubsetGroup]:
    """Sum the figures of subsets by dataset, site, day and origin; the day is that in the recording's name, if any."""
    verdicts = _index(quality["verdicts"])
    starts, samples = _index(quality["starts"]["subsets"]), _index(quality["samples"]["subsets"])
    grouped: dict[tuple[str, str, str, str], list[Mapping[str, Any]]] = {}
    for row in quality["subsets"]:
        key = (row["dataset"], row["site"], find_day(row["recording"]) or "", row["origin"])
        grouped.setdefault(key, []).append(row)
    groups: list[SubsetGroup] = []
    for (dataset, site, day, origin), rows in sorted(grouped.items()):
        own = [(row["dataset"], row["subset"]) for row in rows]
        judged = [each for key in own for each in verdicts.get(key, ())]
        levels = [each["verdict"] for each in judged]
        flows = [row["flow_vphpl"] for row in rows if row["flow_vphpl"] is not None]
        entries = sum(row["entries"] for row in rows)
        groups.append(
            {
                "dataset": dataset,
                "site": site,
                "day": day or None,
                "origin": origin,
                "subsets": len(rows),
                "recordings": len({row["recording"] for row in rows}),
                "seconds": sum({row["recording"]: row["seconds"] for row in rows}.values()),
                "vehicles": sum(row["vehicles"] for row in rows),
                "entries": entries,
                "least_flow_vphpl": min(flows, default=None),
                "greatest_flow_vphpl": max(flows, default=None),
                "usable": levels.count(GOOD),
                "usable_with_care": levels.count(CARE),
                "not_usable": levels.count(BAD),
                "not_checked": levels.count(UNKNOWN),
                "error_share": _average(judged, "error_share"),
                "mean_speed_mps": _average(rows, "mean_speed_mps"),
                "late_starts": sum(each["late"] for key in own for each in starts.get(key, ())),
                "samples": sum(each["samples"] for key in own for each in samples.get(key, ())),
            }
        )
    return groups


def find_day(recording: str) -> str | None:
    """Return the date in the name of a recording, such as 2022-11-30 of i-24-20221130-0600."""
    found = DATE.search(recording)
    return None if found is None else "-".join(found.groups())


def describe_subset_origins(quality: Mapping[str, Any]) -> str | None:
    """Describe which subsets are synthetic, or which groups of them; None where none is."""
    if "groups" not in quality:
        return describe_synthetic({row["subset"]: row["origin"] for row in quality["subsets"]})
    groups = {f"{row['site']} {row['day'] or ''} {row['origin']}": row["origin"] for row in quality["groups"]}
    return describe_synthetic(groups, noun="day")


def _index(rows: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], list[Mapping[str, Any]]]:
    indexed: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in rows:
        indexed.setdefault((row["dataset"], row["subset"]), []).append(row)
    return indexed


def _average(rows: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """Return the mean of a figure over entries, rounded as all figures are."""
    known = [row for row in rows if row[name] is not None]
    entries = sum(row["entries"] for row in known)
    return float(f"{sum(row[name] * row['entries'] for row in known) / entries:.10g}") if entries else None
