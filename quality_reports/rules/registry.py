"""Rules in use: their thresholds, Pandera checks and documentation."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import pandera.polars as pa
import polars as pl
from pandera.errors import SchemaErrors

from tracklake.quality_reports.rules.drive import DRIVE_RULES
from tracklake.quality_reports.rules.motion import MOTION_RULES
from tracklake.quality_reports.rules.place import PLACE_RULES
from tracklake.quality_reports.rules.rule import Rule, Severity, Threshold
from tracklake.quality_reports.rules.tracking import TRACKING_RULES
from tracklake.schemas.errors import UsageError
from tracklake.schemas.text import suggest_name

__all__ = [
    "ALL_RULES",
    "DRIVE_RULES",
    "RULES",
    "Rule",
    "Severity",
    "Threshold",
    "ThresholdError",
    "as_schema",
    "columns_needed",
    "columns_read",
    "describe",
    "find_threshold_faults",
    "resolve",
    "select_broken",
    "select_checkable",
    "select_thresholds",
]

RULES: tuple[Rule, ...] = (*MOTION_RULES, *PLACE_RULES, *TRACKING_RULES)
"""Rules over tracks, in the order of the report."""
ALL_RULES = (*RULES, *DRIVE_RULES)
"""Rules in use, those for drives last."""


class ThresholdError(UsageError):
    """A threshold's name is unknown or its value is no number."""


def select_checkable(rules: Sequence[Rule], lacking: Collection[str]) -> tuple[Rule, ...]:
    """Select the rules that can be checked where these columns, of the lake's tables or derived, are lacking."""
    return tuple(rule for rule in rules if not {*rule.columns, *rule.reads} & set(lacking))


def columns_needed(rules: Sequence[Rule]) -> tuple[str, ...]:
    """Return the columns of `tracks`, `vehicles` and `subsets` that the rules need."""
    return tuple(dict.fromkeys(name for rule in rules for name in rule.columns))


def columns_read(rules: Sequence[Rule]) -> tuple[str, ...]:
    """Return the columns of prepared entries that the rules name, derived ones included."""
    return tuple(dict.fromkeys(name for rule in rules for name in rule.reads))


def resolve(rules: Sequence[Rule], overrides: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return every threshold of the rules by name: the default unless overridden.

    Raises:
        ThresholdError: an override's name is no threshold of these rules, or its value is not allowed.
    """
    for name, fault in find_threshold_faults(rules, overrides or {}).items():
        raise ThresholdError(f"thresholds: {name}: {fault}, got {(overrides or {})[name]!r}")
    defaults = {name: default for rule in rules for name, default in rule.defaults.items()}
    return defaults | {name: float(value) for name, value in (overrides or {}).items()}


def select_thresholds(rules: Sequence[Rule], overrides: Mapping[str, float]) -> dict[str, float]:
    """Select the overrides of thresholds that these rules have."""
    known = {name for rule in rules for name in rule.defaults}
    return {name: value for name, value in overrides.items() if name in known}


def find_threshold_faults(rules: Sequence[Rule], overrides: Mapping[str, Any]) -> dict[str, str]:
    """Return what is wrong with overrides of thresholds, by name: what was expected."""
    known = {threshold.name: threshold for rule in rules for threshold in rule.thresholds}
    faults = {}
    for name, value in overrides.items():
        if name not in known:
            faults[name] = f"unknown name; {suggest_name(name, known)}"
        elif isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            faults[name] = "expected a finite number"
        elif not known[name].allows(value):
            faults[name] = f"expected {known[name].range} ({known[name].unit})"
    values = {name: threshold.default for name, threshold in known.items()} | {**overrides}
    for name in () if faults else overrides:
        low, high = name.replace("_max_", "_min_"), name.replace("_min_", "_max_")
        if values[low] > values[high]:
            faults[name] = f"expected {low} to be no more than {high}, which are {values[low]:g} and {values[high]:g}"
    return faults


def as_schema(rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None) -> pa.DataFrameSchema:
    """Return the rules as a Pandera schema over a collected frame of prepared entries: one custom check per rule.

    Validate a DataFrame with `lazy=True` to check every rule; a LazyFrame would be checked for dtypes only. The
    schema tells whether entries break a rule; `quality_reports.rules.findings.find` finds which, by the same
    expressions.

    Raises:
        ThresholdError: see `resolve`.
    """
    limits = resolve(rules, thresholds)
    return pa.DataFrameSchema(
        checks=[_check(rule, rule.broken(limits)) for rule in rules],
        name="rules",
    )


def select_broken(
    entries: pl.DataFrame, rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None
) -> tuple[Rule, ...]:
    """Select the rules that any of a subset's prepared entries breaks, by the Pandera checks.

    Pandera makes a pass per rule: a single pass over all of them leaves it the few that are broken.

    Raises:
        ThresholdError: see `resolve`.
    """
    limits = resolve(rules, thresholds)
    passed = entries.select(~rule.broken(limits).any().alias(rule.name) for rule in rules).to_dicts()
    doubtful = tuple(rule for rule in rules if not passed[0][rule.name])
    own = {name: limits[name] for rule in doubtful for name in rule.defaults}
    try:
        as_schema(doubtful, own).validate(entries, lazy=True)
    except SchemaErrors as broken:
        names = {error.check.name for error in broken.schema_errors if error.check is not None}
        return tuple(rule for rule in rules if rule.name in names)
    return ()


def _check(rule: Rule, broken: pl.Expr) -> pa.Check:
    """Return a rule as a Pandera check, true where an entry does not break it."""
    return pa.Check(
        lambda data: data.lazyframe.select(~broken),
        name=rule.name,
        error=f"{rule.name} ({rule.severity}): {rule.meaning}",
        n_failure_cases=1,  # Polars counts and writes the entries; Pandera need not collect them
    )


def describe(rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """Describe each rule in a row: name, severity, unit, thresholds, meaning, source, columns read.

    Raises:
        ThresholdError: see `resolve`.
    """
    limits = resolve(rules, thresholds)
    return [
        {
            "name": rule.name,
            "severity": rule.severity,
            "unit": rule.unit,
            "thresholds": [
                {"name": each.name, "value": limits[each.name], "default": each.default, "unit": each.unit}
                for each in rule.thresholds
            ],
            "meaning": rule.meaning,
            "source": rule.source,
            "columns": list(rule.columns),
        }
        for rule in rules
    ]
