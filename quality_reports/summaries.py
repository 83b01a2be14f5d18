"""The report's numbers: one SQL statement per file over the lake's views, gathered into plain values."""

import math
from collections.abc import Mapping, Sequence
from datetime import date, datetime
from importlib.resources import files
from pathlib import PurePath
from typing import Any, Protocol, SupportsFloat, TypeAlias

import polars as pl

from tracklake.quality_reports.published import SOURCE, list_published
from tracklake.quality_reports.rules.registry import RULES, Rule, describe
from tracklake.schemas.columns import PARTS
from tracklake.schemas.split_leakage import QUANTITIES
from tracklake.schemas.start_assessments import ESTIMATORS

QUALITY_SCHEMA = "tracklake/quality/1"
SIGNIFICANT_DIGITS = 10
"""A sum's last digits depend on the order in which threads add; beyond these the report would not repeat."""
REJECTS_PER_FILE = 10
REJECT_CHARACTERS = 300


class Result(Protocol):
    """What the report needs of a statement's result."""

    @property
    def description(self) -> Sequence[Any] | None:
        """A tuple per column, of which the first is its name."""
        ...

    def fetchall(self) -> list[Any]:
        """All rows as tuples."""
        ...

    def pl(self) -> pl.DataFrame:
        """All rows as a frame."""
        ...


class Connection(Protocol):
    """What the report needs of a lake's connection: DuckDB's own has it, and the read-only one of the lake."""

    def execute(self, statement: str, parameters: Mapping[str, Any] = ..., /) -> Result:
        """Run a statement."""
        ...


Row = dict[str, Any]
Plain: TypeAlias = "bool | int | float | str | list[Plain] | dict[str, Plain] | None"
"""What JSON knows."""
Parameters = Mapping[str, Any]


def statement(name: str) -> str:
    """The text of `sql/<name>.sql`."""
    return (files("tracklake.quality_reports") / "sql" / f"{name}.sql").read_text(encoding="utf-8")


def query(connection: Connection, name: str, parameters: Parameters | None = None) -> list[Row]:
    """Run `sql/<name>.sql` and return its rows as dictionaries of plain values.

    Args:
        connection: with the catalog's views.
        name: the file's name without its suffix.
        parameters: values of its $names.
    """
    # Not on a cursor: it would be a connection of its own, without the caller's local settings and registered frames.
    result = connection.execute(statement(name), dict(parameters or {}))
    names = [column[0] for column in result.description or ()]
    return [dict(zip(names, map(plain, row), strict=True)) for row in result.fetchall()]


def query_frame(connection: Connection, name: str, parameters: Parameters | None = None) -> pl.DataFrame:
    """Run `sql/<name>.sql` and return its rows as a frame: for what is drawn, not printed.

    Args:
        connection: with the catalog's views.
        name: the file's name without its suffix.
        parameters: values of its $names.
    """
    return connection.execute(statement(name), dict(parameters or {})).pl()


def plain_row(row: Mapping[str, Any]) -> Row:
    """A mapping with values that JSON knows; see `plain`."""
    return {str(key): plain(value) for key, value in row.items()}


def plain(value: object) -> Plain:
    """Turn a value into what JSON knows.

    NaN and infinity become None, other fractions are rounded to SIGNIFICANT_DIGITS, paths and dates become text,
    tuples and sets lists.

    Raises:
        TypeError: the value is of no such kind.
    """
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return float(f"{value:.{SIGNIFICANT_DIGITS}g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return plain_row(value)
    if isinstance(value, Sequence | set | frozenset) and not isinstance(value, bytes):
        return [plain(each) for each in (sorted(value) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, SupportsFloat):  # Decimal, NumPy scalars
        return plain(float(value))
    raise TypeError(f"cannot put a {type(value).__name__} into the report: {value!r}")


def collect(
    connection: Connection,
    provenance: Mapping[str, Any],
    *,
    rules: Sequence[Rule] = RULES,
    scores: Sequence[Mapping[str, Any]] | None = None,
) -> Row:
    """Gather every number of the report: what `quality.json` holds and the page shows.

    Rows are those of `sql/<name>.sql` (their first lines say what a row is); units are in the names; shares are
    0 to 1; null means unknown or not done, never zero. Nothing here depends on the clock or on row order.

    Returns a mapping with the keys
        schema: "tracklake/quality/1"; its number grows when a key changes meaning or goes.
        headline: one row of headline.sql.
        stages: [{stage, possible, done}] in subsets; rows of stages.sql.
        left_out: [{dataset, stages, reason, subsets}]; rows of left_out.sql.
        subsets: rows of subsets.sql.
        rules: [{name, severity, unit, thresholds: [{name, value, default, unit}], meaning, source, columns,
            total, datasets: [..], subsets: [..]}]; the last three are rows of findings.sql: runs, vehicles,
            vehicle_share, entries, entry_share, worst, subsets_checked, subsets_all.
        speeds: {summary: rows of speeds.sql, per_second: rows of speeds_per_second.sql, histogram: rows of
            speed_histogram.sql}.
        recordings: rows of recordings.sql.
        subset_scores: rows of subset_scores.sql.
        published: {source, figures: fields of quality_reports.published.Published}.
        starts: {subsets: rows of starts.sql, positions: rows of start_positions.sql, assessed: {subsets: rows of
            assessed_subsets.sql, positions: rows of assessed_positions.sql}}.
        samples: {subsets: rows of samples.sql, drops: rows of sample_drops.sql}.
        splits: {recipes, balance, members, leakage, context, shifts, left_out: rows of split_<name>.sql}.
        completeness: rows of completeness.sql.
        ingestion: {files: rows of ingested_files.sql, rejects: rows of rejects.sql}.
        model_scores: [{model, part, rows: [{seconds, rmse_m, n}]}], empty unless given.
        provenance: as given, and source_files: rows of source_files.sql.

    Args:
        connection: with the views tracks, vehicles, subsets, findings, start_cutoffs, missing_starts,
            start_assessments, samples, sample_drops, neighbors, the tables of splits, completeness, ingest_log,
            rejects and sample_counts; they may be empty.
        provenance: anything worth citing: lake, tracklake, versions, settings...; `thresholds`, where given, are the
            overrides that validation ran with (of most recordings; `thresholds_elsewhere` those of the others).
        rules: what validation judged by.
        scores: what evaluation found.

    Raises:
        ThresholdError: provenance["thresholds"] names a threshold that the rules do not have.
    """
    return {
        "schema": QUALITY_SCHEMA,
        "headline": query(connection, "headline")[0],
        "stages": query(connection, "stages"),
        "left_out": query(connection, "left_out"),
        "subsets": query(connection, "subsets"),
        "rules": _rules(connection, rules, provenance.get("thresholds") or {}),
        "speeds": {
            "summary": query(connection, "speeds"),
            "per_second": query(connection, "speeds_per_second"),
            "histogram": query(connection, "speed_histogram"),
        },
        "recordings": query(connection, "recordings"),
        "subset_scores": query(connection, "subset_scores"),
        "published": {"source": SOURCE, "figures": list_published()},
        "starts": {
            "subsets": query(connection, "starts"),
            "positions": query(connection, "start_positions"),
            "assessed": {
                "subsets": query(connection, "assessed_subsets", {"estimators": list(ESTIMATORS)}),
                "positions": query(connection, "assessed_positions", {"estimators": list(ESTIMATORS)}),
            },
        },
        "samples": {"subsets": query(connection, "samples"), "drops": query(connection, "sample_drops")},
        "splits": {
            "recipes": query(connection, "split_recipes"),
            "balance": query(connection, "split_balance", {"parts": list(PARTS)}),
            "members": query(connection, "split_members", {"parts": list(PARTS)}),
            "leakage": query(connection, "split_leakage", {"parts": list(PARTS)}),
            "context": query(connection, "split_context", {"parts": list(PARTS)}),
            "shifts": query(connection, "split_shifts", {"parts": list(PARTS), "quantities": list(QUANTITIES)}),
            "left_out": query(connection, "split_left_out"),
        },
        "completeness": query(connection, "completeness"),
        "ingestion": {
            "files": query(connection, "ingested_files"),
            "rejects": query(
                connection,
                "rejects",
                {"rejects_per_file": REJECTS_PER_FILE, "reject_characters": REJECT_CHARACTERS},
            ),
        },
        "model_scores": plain(list(scores or ())),
        "provenance": {**plain_row(provenance), "source_files": query(connection, "source_files")},
    }


def _rules(connection: Connection, rules: Sequence[Rule], thresholds: Mapping[str, float]) -> list[Row]:
    """Each rule's declaration, with what was found in the whole lake, per dataset and per subset."""
    rows = query(connection, "findings", {"rules": [rule.name for rule in rules]})
    extremes = {rule.name: "least" if rule.extreme == "min" else "greatest" for rule in rules}
    found: dict[str, list[Row]] = {rule.name: [] for rule in rules}
    for row in rows:
        name = row.pop("rule")
        least_and_greatest = {"least": row.pop("least"), "greatest": row.pop("greatest")}
        found[name].append({**row, "worst": least_and_greatest[extremes[name]]})
    nothing = dict.fromkeys(("runs", "vehicles", "vehicle_share", "entries", "entry_share", "worst"))
    return [
        {
            **declared,
            "total": next(
                (_without(row, "dataset", "subset") for row in found[declared["name"]] if row["dataset"] is None),
                {"subsets_checked": 0, "subsets_all": 0, **nothing},
            ),
            "datasets": [
                _without(row, "subset")
                for row in found[declared["name"]]
                if row["dataset"] is not None and row["subset"] is None
            ],
            "subsets": [row for row in found[declared["name"]] if row["subset"] is not None],
        }
        for declared in describe(rules, thresholds)
    ]


def _without(row: Row, *names: str) -> Row:
    """The row without some of its columns."""
    return {key: value for key, value in row.items() if key not in names}
