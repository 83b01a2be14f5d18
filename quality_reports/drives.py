"""Numbers of the report about drives: SQL over the lake's views, and distances and errors of messages' positions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict, cast

import polars as pl

from tracklake.quality_reports.rules.along_messages import place_messages
from tracklake.quality_reports.rules.registry import DRIVE_RULES
from tracklake.quality_reports.summaries import Connection, Row, plain_row, query, query_frame
from tracklake.schemas.quality_drives import (
    DriveErrors,
    DriveFacts,
    DriveLoss,
    DriveRule,
    Drives,
    DriveScore,
    DriveStation,
    DriveWarnings,
)

MAX_AGE_S = 5.0
"""Oldest message that is compared with the truth, in s: tracks end 3 s after the last one."""
BIN_M = 25.0
"""Width of bins of distance from the ego, in m."""
ERRORS = ("message_error", "error", "smoothed_error")
"""Errors against the truth: of the last message alone, of the fused position, and of the smoothed one."""


OF_ONE_DRIVE = ("drives", "stations", "rules", "losses", "errors")
"""Lists of figures that each belong to one drive."""
SCORED = ("model", "seconds", "n", "mae_m", "mae_m_low", "mae_m_high", "rmse_m")
WARNED = ("model", "n", "true", "hits", "missed", "false", "warnings_per_hour", "median_time_s")
"""Figures of a run at one horizon, and of its warnings, that the report shows."""


SENSED = {"scans": "LiDAR scan", "images": "camera image"}
"""Nouns of what sensors logged, by figure."""


class ScoreLists(TypedDict):
    """Scores and warnings of runs on drives, as quality.json has them."""

    scores: list[DriveScore]
    warnings: list[DriveWarnings]


@dataclass(frozen=True)
class DriveRows:
    """Rows of one drive.

    Args:
        messages: rows of drive_messages.sql.
        ticks: rows of drive_ticks.sql, with message_error_m.
        distances: distance_m and lost_before of other vehicles' messages when they arrived; null where unknown.
    """

    messages: pl.DataFrame
    ticks: pl.DataFrame
    distances: pl.DataFrame


def read_drive(connection: Connection, drive: str) -> DriveRows:
    """Read what plots and distances of a drive are made of."""
    asked = {"drive": drive}
    messages, states, ticks = (
        query_frame(connection, f"drive_{name}", asked) for name in ("messages", "states", "ticks")
    )
    placed = place_messages(ticks, messages, states, max_age_s=MAX_AGE_S)
    across = [pl.col(f"message_{axis}_m") - pl.col(f"true_{axis}_m") for axis in "xy"]
    ticks = placed.with_columns(message_error_m=(across[0] ** 2 + across[1] ** 2).sqrt())
    others = messages.filter(~pl.col("own"))
    arrival = pl.coalesce("received_s", "time_s")
    arrivals = others.select("vehicle_id", "lost_before", tick=(arrival * 10 - 1e-6).ceil().cast(pl.Int32))
    at = place_messages(arrivals, others, states)
    distance = (pl.col("message_x_m") ** 2 + pl.col("message_y_m") ** 2).sqrt()
    return DriveRows(messages, ticks, at.select("lost_before", distance_m=distance))


def collect_drives(
    connection: Connection,
    scores: Sequence[Mapping[str, Any]] = (),
    published: Sequence[Mapping[str, Any]] = (),
    *,
    only: str | None = None,
) -> Drives | None:
    """Gather the report's numbers about drives; None where the lake holds none.

    Args:
        connection: connection to a lake.
        scores: runs on drives: model, rows of one horizon each, warnings.
        published: rows of published figures, shown beside scores.
        only: name of the drive whose errors and losses are wanted; None: of all.
    """
    facts = [row for row in query(connection, "drives") if only in (None, row["drive"])]
    if not facts:
        return None
    units = {rule.name: rule.unit for rule in DRIVE_RULES}
    rules = [{**row, "unit": units.get(row["rule"], "")} for row in query(connection, "drive_rules")]
    collected: dict[str, list[Row]] = {"drives": [], "losses": [], "errors": []}
    for row in facts:
        rows = read_drive(connection, row["drive"])
        collected["drives"].append({**row, **sum_up_errors(rows.ticks)})
        collected["losses"] += [{"drive": row["drive"], **each} for each in bin_losses(rows.distances)]
        collected["errors"] += [{"drive": row["drive"], **each} for each in bin_errors(rows.ticks)]
    return {
        "drives": cast("list[DriveFacts]", collected["drives"]),
        "stations": cast("list[DriveStation]", query(connection, "drive_stations")),
        "rules": cast("list[DriveRule]", rules),
        "losses": cast("list[DriveLoss]", collected["losses"]),
        "errors": cast("list[DriveErrors]", collected["errors"]),
        **list_scores(scores, published),
    }


def list_scores(scores: Sequence[Mapping[str, Any]], published: Sequence[Mapping[str, Any]]) -> ScoreLists:
    """List the scores of runs on drives by horizon, the published ones beside them, and the warnings of the runs."""
    rows = [("measured", row) for score in scores for row in score["rows"]]
    rows += [("published", row) for row in published] if rows else []
    renamed = {"cell": "cell_share", "cell_with_forest": "cell_with_forest_share"}
    listed = [
        {"origin": origin, **{name: row[name] for name in SCORED}, **{new: row[old] for old, new in renamed.items()}}
        for origin, row in rows
    ]
    warned = [{name: score["warnings"][name] for name in WARNED} for score in scores]
    return {
        "scores": cast("list[DriveScore]", list(map(plain_row, listed))),
        "warnings": cast("list[DriveWarnings]", list(map(plain_row, warned))),
    }


def select_drive(drives: Drives, drive: str) -> dict[str, list[Row]]:
    """Select the rows of one drive."""
    rows = cast("dict[str, list[Row]]", drives)
    return {name: [row for row in rows[name] if row["drive"] == drive] for name in OF_ONE_DRIVE}


def describe_drive(facts: Mapping[str, Any]) -> str:
    """Return in a line what a drive holds and how good it is."""
    percent = "" if facts["lost_share"] is None else f", {100 * facts['lost_share']:.1f} % lost"
    parts = [f"{describe_messages(facts)}{percent}"]
    if facts["latency_median_s"] is not None:
        parts.append(f"median latency {1000 * facts['latency_median_s']:.0f} ms")
    if facts["scans"]:
        parts.append(_count(facts["scans"], "LiDAR scan"))
    if facts["error_median_m"] is not None:
        parts.append(f"median position error {facts['error_median_m']:.2f} m against truth")
    return ", ".join(parts)


def describe_drives(drives: Sequence[Mapping[str, Any]]) -> str:
    """Return in a line the number of drives, and what they hold together."""
    total = {name: sum(row[name] for row in drives) for name in ("stations", "messages", "own_messages", *SENSED)}
    sensed = [_count(total[name], noun) for name, noun in SENSED.items() if total[name]]
    return ", ".join([f"{_count(len(drives), 'drive')}: {describe_messages(total)}", *sensed])


def describe_messages(facts: Mapping[str, Any]) -> str:
    """Return how many messages of how many other vehicles were logged; where there are none, those of the ego."""
    if facts["messages"]:
        return f"{_count(facts['stations'], 'station')}, {_count(facts['messages'], 'message')}"
    own = f", {facts['own_messages']:,} of the ego" if facts["own_messages"] else ""
    return f"no messages of other vehicles{own}"


def _count(number: int, noun: str) -> str:
    """Return a number with its noun."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def sum_up_errors(ticks: pl.DataFrame) -> Row:
    """Return the errors of a drive's positions against the truth; nulls where there is none."""
    known = ticks.filter(pl.col("true_x_m").is_not_null())
    medians = [pl.col(f"{name}_m").median().alias(f"{name}_median_m") for name in ERRORS]
    summed = known.select(*medians, error_p95_m=pl.col("error_m").quantile(0.95, "linear")).row(0, named=True)
    return plain_row({"true_ticks": known.height, **summed})


def bin_errors(ticks: pl.DataFrame) -> list[Row]:
    """Return the errors against the truth by true distance, in bins of BIN_M."""
    known = ticks.filter(pl.col("true_x_m").is_not_null()).with_columns(
        distance_m=(pl.col("true_x_m") ** 2 + pl.col("true_y_m") ** 2).sqrt()
    )
    figures = [
        expression
        for name in ERRORS
        for expression in (
            pl.col(f"{name}_m").median().alias(f"{name}_median_m"),
            pl.col(f"{name}_m").quantile(0.95, "linear").alias(f"{name}_p95_m"),
        )
    ]
    return _bin(known, pl.len().alias("ticks"), *figures)


def bin_losses(distances: pl.DataFrame) -> list[Row]:
    """Return kept and lost messages by the distance of their sender, in bins of BIN_M."""
    lost = pl.col("lost_before").sum()
    return _bin(
        distances.filter(pl.col("distance_m").is_not_null()),
        messages=pl.len(),
        lost=lost,
        lost_share=lost / (lost + pl.len()),
    )


def _bin(rows: pl.DataFrame, *figures: pl.Expr, **named: pl.Expr) -> list[Row]:
    """Return figures by bin of distance_m."""
    start = (pl.col("distance_m") / BIN_M).floor() * BIN_M
    binned = rows.group_by(from_m=start).agg(*figures, **named).sort("from_m")
    return [plain_row(row) for row in binned.with_columns(until_m=pl.col("from_m") + BIN_M).iter_rows(named=True)]
