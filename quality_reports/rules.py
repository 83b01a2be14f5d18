"""The rules that entries are judged by, each declared once: checks, findings, report rows and documentation follow."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import pandera.polars as pa
import polars as pl
from pandera.errors import SchemaErrors

Severity = Literal["error", "warning", "info"]


class ThresholdError(ValueError):
    """A threshold's name is unknown or its value is no number."""


@dataclass(frozen=True)
class Threshold:
    """A number that a rule compares with: a setting.

    Args:
        name: the setting's name, unit included.
        default: its value unless set.
        unit: SI symbol.
    """

    name: str
    default: float
    unit: str


@dataclass(frozen=True)
class Rule:
    """What is wrong with an entry, declared.

    Args:
        name: as in `findings.rule`.
        severity: error = cannot be, warning = hardly can, info = worth knowing.
        unit: SI symbol of `value`.
        thresholds: the settings it compares with.
        meaning: when an entry breaks it, in words.
        source: where the rule or its threshold comes from.
        breaks: thresholds by name -> boolean expression over `tracks`, true where an entry breaks the rule; false or
            null where it does not. A null operand breaks nothing.
        value: what is reported of a breaking entry, in `unit`.
        extreme: which end of `value` is the worst.
    """

    name: str
    severity: Severity
    unit: str
    thresholds: tuple[Threshold, ...]
    meaning: str
    source: str
    breaks: Callable[[Mapping[str, float]], pl.Expr]
    value: pl.Expr
    extreme: Literal["min", "max"]

    @property
    def defaults(self) -> dict[str, float]:
        """Threshold names and defaults."""
        return {threshold.name: threshold.default for threshold in self.thresholds}

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of `tracks` that it reads; where a source lacks one, the rule cannot be checked."""
        read = self.breaks(self.defaults).meta.root_names() + self.value.meta.root_names()
        return tuple(dict.fromkeys(read))

    def broken(self, thresholds: Mapping[str, float]) -> pl.Expr:
        """True where an entry breaks the rule, else false, never null.

        Args:
            thresholds: every threshold of the rule by name (see `resolve`).
        """
        return self.breaks(thresholds).fill_null(value=False)


def recorded(limit: float) -> pl.Expr:
    """A threshold as Float32, the dtype of recorded speeds and accelerations.

    They have two decimals at the source, so a value often is the threshold: it must equal it. As Float64 it would not:
    the Float32 next to 3.05 is less than 3.05 and the one next to 0.1 greater than 0.1.
    """
    return pl.lit(limit, dtype=pl.Float32)


RULES: tuple[Rule, ...] = (
    Rule(
        name="negative_headway",
        severity="error",
        unit="m",
        thresholds=(Threshold("negative_headway_m", 0.0, "m"),),
        meaning="the bumper-to-bumper gap to the leader, from positions, is below the threshold: two vehicles overlap",
        source="docs/DESIGN.md, section 5; found in NGSIM by Coifman and Li (2017)",
        breaks=lambda limits: pl.col("gap_m") < limits["negative_headway_m"],
        value=pl.col("gap_m"),
        extreme="min",
    ),
    Rule(
        name="high_acceleration",
        severity="warning",
        unit="m/s2",
        thresholds=(Threshold("high_acceleration_mps2", 3.05, "m/s2"),),
        meaning="the recorded acceleration exceeds the threshold (10 ft/s²)",
        source="docs/DESIGN.md, section 5; implausible accelerations in NGSIM: Punzo, Borzacchiello and Ciuffo (2011)",
        breaks=lambda limits: pl.col("accel_mps2") > recorded(limits["high_acceleration_mps2"]),
        value=pl.col("accel_mps2"),
        extreme="max",
    ),
    Rule(
        name="low_constant_speed",
        severity="warning",
        unit="m/s",
        thresholds=(Threshold("low_constant_speed_mps", 1.52, "m/s"),),
        meaning="the recorded speed is above zero and at most the threshold (5 ft/s) while the recorded acceleration "
        "is exactly zero: a frozen measurement rather than a crawling vehicle",
        source="docs/DESIGN.md, section 5",
        breaks=lambda limits: (
            (pl.col("speed_mps") > 0)
            & (pl.col("speed_mps") <= recorded(limits["low_constant_speed_mps"]))
            & (pl.col("accel_mps2") == 0)
        ),
        value=pl.col("speed_mps"),
        extreme="min",
    ),
    Rule(
        name="backward",
        severity="error",
        unit="m/s",
        thresholds=(Threshold("backward_mps", 0.0, "m/s"),),
        meaning="the recorded speed along the direction of travel is below the threshold: the vehicle reverses",
        source="docs/DESIGN.md, section 5; known of highD recordings 25, 26 and 36",
        breaks=lambda limits: pl.col("speed_mps") < recorded(limits["backward_mps"]),
        value=pl.col("speed_mps"),
        extreme="min",
    ),
)
"""The rules in use, in the order of the report."""


def resolve(rules: Sequence[Rule], overrides: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return every threshold of the rules by name: the default unless overridden.

    Raises:
        ThresholdError: an override's name is no threshold of these rules, or its value is not a finite number.
    """
    values = {name: default for rule in rules for name, default in rule.defaults.items()}
    for name, value in (overrides or {}).items():
        if name not in values:
            raise ThresholdError(f"thresholds: unknown name {name!r}; expected one of {', '.join(sorted(values))}")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ThresholdError(f"thresholds: {name} must be a finite number, got {value!r}")
        values[name] = float(value)
    return values


def as_schema(rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None) -> pa.DataFrameSchema:
    """Return the rules as a Pandera schema over a collected `tracks` frame: one custom check per rule.

    Validate a DataFrame with `lazy=True` to hear of every rule; a LazyFrame would be checked for dtypes only. The
    schema says whether entries break a rule; `quality_reports.findings.find` says which, from the same expressions.

    Raises:
        ThresholdError: see `resolve`.
    """
    limits = resolve(rules, thresholds)
    return pa.DataFrameSchema(
        checks=[_check(rule, rule.broken(limits)) for rule in rules],
        name="rules",
    )


def select_broken(
    tracks: pl.DataFrame, rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None
) -> tuple[Rule, ...]:
    """The rules that a subset's tracks break anywhere, by the Pandera checks.

    Raises:
        ThresholdError: see `resolve`.
    """
    try:
        as_schema(rules, thresholds).validate(tracks, lazy=True)
    except SchemaErrors as broken:
        names = {error.check.name for error in broken.schema_errors if error.check is not None}
        return tuple(rule for rule in rules if rule.name in names)
    return ()


def _check(rule: Rule, broken: pl.Expr) -> pa.Check:
    """One rule as a Pandera check: true where an entry does not break it."""
    return pa.Check(
        lambda data: data.lazyframe.select(~broken),
        name=rule.name,
        error=f"{rule.name} ({rule.severity}): {rule.meaning}",
        n_failure_cases=1,  # Polars counts and writes the entries; Pandera need not collect them
    )


def describe(rules: Sequence[Rule] = RULES, thresholds: Mapping[str, float] | None = None) -> list[dict[str, Any]]:
    """Rows of documentation, one per rule: name, severity, unit, thresholds, meaning, source, columns read.

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
