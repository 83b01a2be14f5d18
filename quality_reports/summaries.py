"""Numbers of the report: SQL statements over the lake's views, one per file, gathered into plain values."""

import json
import math
from collections.abc import Mapping, Sequence
from datetime import date, datetime
from functools import cache
from importlib.resources import files
from pathlib import PurePath
from typing import Any, Protocol, SupportsFloat, TypeAlias, TypedDict, TypeVar, cast

import polars as pl

from tracklake.quality_reports.published import SOURCE, select_published
from tracklake.quality_reports.rules.registry import RULES, Rule, describe
from tracklake.quality_reports.verdicts import judge
from tracklake.schemas.columns import PARTS
from tracklake.schemas.quality import (
    QUALITY_SCHEMA,
    Completeness,
    IngestedFile,
    ModelScores,
    Provenance,
    Quality,
    RejectedRow,
    SampleDrops,
    SourceFile,
    SplitBalance,
    SplitContext,
    SplitLeakage,
    SplitLeftOut,
    SplitMember,
    SplitRecipe,
    Splits,
    SplitShift,
    SubsetSamples,
)
from tracklake.schemas.quality_tracks import (
    Headline,
    LeftOut,
    PositionAssessment,
    RecordingFacts,
    RuleFindings,
    SpeedBin,
    SpeedsOfEntries,
    SpeedsPerSecond,
    StageProgress,
    StartPosition,
    Starts,
    SubsetAssessment,
    SubsetFacts,
    SubsetScores,
    SubsetStarts,
    SubsetTraffic,
)
from tracklake.schemas.split_leakage import QUANTITIES
from tracklake.schemas.start_assessments import ESTIMATORS

SIGNIFICANT_DIGITS = 10
"""Digits to which fractions are rounded: a sum's last ones depend on the order in which threads add."""
REJECTS_PER_FILE = 10
"""Rejected lines that the report lists of each file."""
REJECT_CHARACTERS = 300
"""Longest text of a rejected line in the report, in characters."""

T = TypeVar("T")
Row = dict[str, Any]
Plain: TypeAlias = "bool | int | float | str | list[Plain] | dict[str, Plain] | None"
"""Values that JSON has."""
Parameters = Mapping[str, Any]
"""Values of a statement's $names."""
UNCHECKED: Row = {
    "subsets_checked": 0,
    "subsets_all": 0,
    **dict.fromkeys(("runs", "vehicles", "vehicle_share", "entries", "entry_share", "worst")),
}
"""Findings of a rule in a lake without subsets."""


class SubsetFigures(TypedDict):
    """Numbers of the overview that subsets' pages show as well."""

    subsets: list[SubsetFacts]
    rules: list[RuleFindings]
    per_second: list[SpeedsPerSecond]
    subset_scores: list[SubsetScores]
    traffic: list[SubsetTraffic]
    starts: list[SubsetStarts]
    positions: list[StartPosition]
    samples: list[SubsetSamples]
    members: list[SplitMember]
    left_out: list[LeftOut]
    completeness: list[Completeness]
    provenance: Row


class Result(Protocol):
    """Result of a statement, as far as the report reads it."""

    @property
    def description(self) -> Sequence[Any] | None:
        """Tuples that begin with a column's name."""
        ...

    def fetchall(self) -> list[Any]:
        """Return all rows as tuples."""
        ...

    def pl(self) -> pl.DataFrame:
        """Return all rows as a frame."""
        ...


class Connection(Protocol):
    """Connection to a lake: DuckDB's own, or the lake's read-only one."""

    def execute(self, statement: str, parameters: Mapping[str, Any] = ..., /) -> Result:
        """Run one of the report's SQL statements."""
        ...


@cache
def read_statement(name: str) -> str:
    """Return the text of `sql/<name>.sql`."""
    return (files("tracklake.quality_reports") / "sql" / f"{name}.sql").read_text(encoding="utf-8")


def query(connection: Connection, name: str, parameters: Parameters | None = None) -> list[Row]:
    """Run `sql/<name>.sql` and return its rows as dictionaries of plain values."""
    # Not on a cursor: it would be a connection of its own, without the caller's local settings and registered frames.
    result = connection.execute(read_statement(name), _bind(parameters))
    names = [column[0] for column in result.description or ()]
    return [dict(zip(names, map(plain, row), strict=True)) for row in result.fetchall()]


def query_frame(connection: Connection, name: str, parameters: Parameters | None = None) -> pl.DataFrame:
    """Run `sql/<name>.sql` and return its rows as a frame, for plots."""
    return connection.execute(read_statement(name), _bind(parameters)).pl()


def _bind(parameters: Parameters | None) -> Row:
    """Return a statement's values with lists as text, which it casts; DuckDB looks for pandas once per list item."""
    return {name: json.dumps(value) if isinstance(value, list) else value for name, value in (parameters or {}).items()}


def plain_row(row: Mapping[str, Any]) -> Row:
    """Turn a mapping's values into what JSON has; see `plain`."""
    return {str(key): plain(value) for key, value in row.items()}


def plain(value: object) -> Plain:
    """Turn a value into what JSON has.

    NaN and infinity become None, other fractions are rounded to SIGNIFICANT_DIGITS, paths and dates become text,
    tuples and sets lists.

    Raises:
        TypeError: JSON has nothing for the value.
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
) -> Quality:
    """Gather every number of the report: what `quality.json` holds and the pages show.

    The result depends neither on the clock nor on the order of rows. `provenance` are facts worth citing (lake,
    versions, settings); its `thresholds` are the overrides that validation used for most recordings,
    `thresholds_elsewhere` those of others. Scores are those of `schemas.quality.ModelScores`.

    Raises:
        ThresholdError: provenance["thresholds"] names a threshold that the rules do not have.
    """
    source_files = _query_rows(connection, "source_files", SourceFile)
    recordings = _query_rows(connection, "recordings", RecordingFacts)
    published, left_out = select_published(recordings)
    subsets = _query_rows(connection, "subsets", SubsetFacts)
    scored = _query_rows(connection, "subset_scores", SubsetScores)
    completeness = _query_rows(connection, "completeness", Completeness)
    checked = collect_rules(connection, rules, provenance.get("thresholds") or {})
    return {
        "schema": QUALITY_SCHEMA,
        "headline": _query_rows(connection, "headline", Headline)[0],
        "verdicts": judge(subsets, scored, checked, completeness),
        "stages": _query_rows(connection, "stages", StageProgress),
        "left_out": _query_rows(connection, "left_out", LeftOut),
        "subsets": subsets,
        "rules": checked,
        "speeds": {
            "summary": _query_rows(connection, "speeds", SpeedsOfEntries),
            "per_second": _query_rows(connection, "speeds_per_second", SpeedsPerSecond),
            "histogram": _query_rows(connection, "speed_histogram", SpeedBin),
        },
        "recordings": recordings,
        "subset_scores": scored,
        "published": {"source": SOURCE, "figures": published, "left_out": left_out},
        "traffic": _query_rows(connection, "traffic", SubsetTraffic),
        "starts": _collect_starts(connection),
        "samples": {
            "subsets": _query_rows(connection, "samples", SubsetSamples),
            "drops": _query_rows(connection, "sample_drops", SampleDrops),
        },
        "splits": _collect_splits(connection),
        "completeness": completeness,
        "ingestion": {
            "files": _query_rows(connection, "ingested_files", IngestedFile),
            "rejects": _query_rows(
                connection,
                "rejects",
                RejectedRow,
                {"rejects_per_file": REJECTS_PER_FILE, "reject_characters": REJECT_CHARACTERS},
            ),
        },
        "model_scores": [cast("ModelScores", plain_row(each)) for each in scores or ()],
        "provenance": cast("Provenance", {**plain_row(provenance), "source_files": source_files}),
    }


def collect_subsets(
    connection: Connection, provenance: Mapping[str, Any], *, rules: Sequence[Rule] = RULES
) -> SubsetFigures:
    """Gather the numbers of the overview that subsets' pages show as well; the arguments are those of `collect`."""
    return {
        "subsets": _query_rows(connection, "subsets", SubsetFacts),
        "rules": collect_rules(connection, rules, provenance.get("thresholds") or {}),
        "per_second": _query_rows(connection, "speeds_per_second", SpeedsPerSecond),
        "subset_scores": _query_rows(connection, "subset_scores", SubsetScores),
        "traffic": _query_rows(connection, "traffic", SubsetTraffic),
        "starts": _query_rows(connection, "starts", SubsetStarts),
        "positions": _query_rows(connection, "start_positions", StartPosition),
        "samples": _query_rows(connection, "samples", SubsetSamples),
        "members": _query_rows(connection, "split_members", SplitMember, {"parts": list(PARTS)}),
        "left_out": _query_rows(connection, "left_out", LeftOut),
        "completeness": _query_rows(connection, "completeness", Completeness),
        "provenance": plain_row(provenance),
    }


def _query_rows(connection: Connection, name: str, _row: type[T], parameters: Parameters | None = None) -> list[T]:
    """Run `sql/<name>.sql`, whose columns are the keys of a row type of `schemas.quality`."""
    return cast("list[T]", query(connection, name, parameters))


def _collect_starts(connection: Connection) -> Starts:
    """Gather how tracks begin, and how good repair windows are."""
    estimators = {"estimators": list(ESTIMATORS)}
    return {
        "subsets": _query_rows(connection, "starts", SubsetStarts),
        "positions": _query_rows(connection, "start_positions", StartPosition),
        "assessed": {
            "subsets": _query_rows(connection, "assessed_subsets", SubsetAssessment, estimators),
            "positions": _query_rows(connection, "assessed_positions", PositionAssessment, estimators),
        },
    }


def _collect_splits(connection: Connection) -> Splits:
    """Gather the splits: recipes, balance and leakage."""
    parts = {"parts": list(PARTS)}
    return {
        "recipes": _query_rows(connection, "split_recipes", SplitRecipe),
        "balance": _query_rows(connection, "split_balance", SplitBalance, parts),
        "members": _query_rows(connection, "split_members", SplitMember, parts),
        "leakage": _query_rows(connection, "split_leakage", SplitLeakage, parts),
        "context": _query_rows(connection, "split_context", SplitContext, parts),
        "shifts": _query_rows(connection, "split_shifts", SplitShift, {**parts, "quantities": list(QUANTITIES)}),
        "left_out": _query_rows(connection, "split_left_out", SplitLeftOut),
    }


def collect_rules(connection: Connection, rules: Sequence[Rule], thresholds: Mapping[str, float]) -> list[RuleFindings]:
    """Gather each rule's declaration and its findings in the whole lake, per dataset and per subset."""
    rows = query(connection, "findings", {"rules": [rule.name for rule in rules]})
    extremes = {rule.name: "least" if rule.extreme == "min" else "greatest" for rule in rules}
    found: dict[str, list[Row]] = {rule.name: [] for rule in rules}
    for row in rows:
        name = row.pop("rule")
        least_and_greatest = {"least": row.pop("least"), "greatest": row.pop("greatest")}
        found[name].append({**row, "worst": least_and_greatest[extremes[name]]})
    collected = []
    for declared in describe(rules, thresholds):
        own = found[declared["name"]]
        total = [_omit(row, "dataset", "subset") for row in own if row["dataset"] is None]
        datasets = [_omit(row, "subset") for row in own if row["dataset"] is not None and row["subset"] is None]
        subsets = [row for row in own if row["subset"] is not None]
        collected.append({**declared, "total": (total or [UNCHECKED])[0], "datasets": datasets, "subsets": subsets})
    return cast("list[RuleFindings]", collected)


def _omit(row: Row, *names: str) -> Row:
    """Return the row without some of its columns."""
    return {key: value for key, value in row.items() if key not in names}
