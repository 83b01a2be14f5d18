"""Numbers of the report about reconstructed tracks, and what they say in words."""

from collections.abc import Mapping, Sequence
from typing import Any, cast

from tracklake.quality_reports.rules.registry import RULES, Rule
from tracklake.quality_reports.summaries import Connection, query
from tracklake.schemas.quality_reconstruction import (
    ReconstructedRule,
    ReconstructedTracks,
    ReconstructionFigures,
    ReconstructionSkip,
    UnkeptBound,
)


def collect_reconstruction(connection: Connection, rules: Sequence[Rule] = RULES) -> ReconstructionFigures | None:
    """Gather the report's numbers about reconstructed tracks; None where the lake holds none."""
    rows = cast("list[ReconstructedTracks]", query(connection, "reconstruction"))
    if not rows:
        return None
    compared = query(connection, "reconstructed_rules", {"rules": [rule.name for rule in rules]})
    return {
        "datasets": [row for row in rows if row["subset"] is None],
        "subsets": [row for row in rows if row["subset"] is not None],
        "rules": cast("list[ReconstructedRule]", compared),
        "unkept_bounds": cast("list[UnkeptBound]", query(connection, "unkept_bounds")),
        "skips": cast("list[ReconstructionSkip]", query(connection, "reconstruction_skips")),
    }


def describe_reconstruction(row: Mapping[str, Any]) -> str:
    """Return in a line how noisy tracks were, how far they were moved and what could not be kept.

    Args:
        row: figures of a subset or dataset, as `schemas.quality_reconstruction.ReconstructedTracks`.
    """
    parts = []
    if row["noise_x_m"] is not None:
        source = "set" if row["noise_is_set"] else "estimated"
        across = "" if row["noise_y_m"] is None else f", {_format_metres(row['noise_y_m'])} across it"
        parts.append(f"noise {_format_metres(row['noise_x_m'])} along the road{across} ({source})")
    if row["moved_over_half_m_share"] is not None:
        parts.append(f"{_format_percent(row['moved_over_half_m_share'])} of the entries moved more than 0.5 m")
    if row["imputed_entries"]:
        parts.append(f"{_format_percent(row['imputed_share'])} of the entries fill gaps")
    unkept = row["bounds_not_kept"]
    parts.append(
        f"{unkept:,} bound{'' if unkept == 1 else 's'} could not be kept" if unkept else "all bounds were kept"
    )
    if row["vehicles_with_errors_before"] is not None:
        before, after = (row[f"vehicles_with_errors_{when}"] for when in ("before", "after"))
        parts.append(
            f"{before:,} of {row['vehicles']:,} vehicles have an error as recorded, {after:,} as reconstructed"
        )
    return "; ".join(parts)


def _format_metres(metres: float) -> str:
    """Return a length with two decimals; what they would show as zero is under 0.01 m."""
    return f"{metres:.2f} m" if metres >= 0.01 else "under 0.01 m"


def _format_percent(share: float) -> str:
    """Return a share in percent, to two significant digits where it is small."""
    return f"{100 * share:.1f} %" if share >= 0.01 or share == 0 else f"{100 * share:.2g} %"
