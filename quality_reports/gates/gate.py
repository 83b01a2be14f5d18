"""Quality gates: conditions on metrics, read from text without evaluating it, and judged on a lake's metrics."""

import math
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from tracklake.quality_reports.gates.metrics import LABEL, METRIC_BY_NAME, SCOPES, SHARE, Metric, Row
from tracklake.schemas.errors import UsageError
from tracklake.schemas.text import suggest_name

COMPARISONS: dict[str, Callable[[Any, Any], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
"""Comparisons by sign, the longer ones first."""
CONDITION = re.compile(
    rf"""\s*(?P<name>[A-Za-z_][\w.]*)\s*(?P<sign>{"|".join(COMPARISONS)})\s*"""
    r"""(?P<value>"[^"]*"|'[^']*'|[^\s"'<>=!]+(\s*%)?)"""
)
NEXT = re.compile(r"\s*(?P<word>and\b|per\s+(?P<scope>\w+)\s*$|$)")
HOW = "for instance `error_share > 0.05`, `overlap.entries > 0 and dataset == highd` or `dropped_share > 1% per lake`"
WHERE = "`tracklake check --list-metrics` lists all"

State = Literal["passed", "failed", "unknown"]


class GateError(UsageError):
    """A gate cannot be read; the message says what was expected."""


@dataclass(frozen=True)
class Condition:
    """One comparison of a metric with a value."""

    metric: Metric
    sign: str
    value: float | str

    def holds(self, row: Row) -> bool | None:
        """Return whether it holds in a row of metrics; None: the metric's value is not known there."""
        found = row.get(self.metric.name)
        if found is None:  # a rule that no entry breaks has no worst value
            return False if row.get(f"{self.metric.name.removesuffix('.worst')}.entries") == 0 else None
        return COMPARISONS[self.sign](found, self.value)


@dataclass(frozen=True)
class Gate:
    """Conditions at which a check fails, if all hold in one place.

    Args:
        text: as it was given.
        conditions: comparisons of metrics.
        scope: what is judged one by one: subsets, recordings, drives, datasets, or the lake.
    """

    text: str
    conditions: tuple[Condition, ...]
    scope: str


@dataclass(frozen=True)
class Judged:
    """The judgement of a gate on one subset, recording, dataset or the lake, with the values that were compared."""

    name: str
    state: State
    values: dict[str, Any]
    reason: str


@dataclass(frozen=True)
class GateResult:
    """The judgement of a gate: passed only where something was judged and all of it passed."""

    gate: Gate
    judged: list[Judged] = field(default_factory=list)
    problem: str = ""

    @property
    def state(self) -> State:
        """The worst of all judgements; unknown where nothing was judged."""
        states = {each.state for each in self.judged} or {"unknown"}
        return next(state for state in ("failed", "unknown", "passed") if state in states)


def parse_gate(text: str) -> Gate:
    """Read a gate: conditions joined by `and`, and at the end `per` and a scope where it is not the smallest.

    Raises:
        GateError: it cannot be read, or names what there is not.
    """
    conditions, place, scope = [], 0, None
    while True:
        found = CONDITION.match(text, place)
        following = found and NEXT.match(text, found.end())
        if not found or not following:
            raise GateError(f"--fail-on {text!r}: cannot be read from {text[place:].strip()!r} on; expected {HOW}")
        conditions.append(_read_condition(text, found["name"], found["sign"], found["value"]))
        place, scope = following.end(), following["scope"]
        if following["word"] != "and":
            break
    metrics = [condition.metric for condition in conditions]
    if all(metric.selects for metric in metrics):
        raise GateError(f"--fail-on {text!r}: selects a part of the lake and compares nothing in it; expected {HOW}")
    common = [each for each in SCOPES if all(each in metric.scopes for metric in metrics)]
    if not common or scope not in (None, *common):
        known = "; ".join(f"{metric.name} per {' or '.join(metric.scopes)}" for metric in metrics)
        raise GateError(
            f"--fail-on {text!r}: no values of these{'' if scope is None else f' per {scope}'}; there are {known}"
        )
    return Gate(text, tuple(conditions), scope or common[0])


def _read_condition(text: str, name: str, sign: str, value: str) -> Condition:
    """Make a condition of its parts; the value is a number, or a text for metrics that are one."""
    metric = METRIC_BY_NAME.get(name)
    if metric is None:
        hint = suggest_name(name, METRIC_BY_NAME)
        hint = f"{hint} " if hint.endswith("?") else ""
        raise GateError(f"--fail-on {text!r}: no metric is called {name}; {hint}{WHERE}")
    plain = value[1:-1] if value[0] in "\"'" else value
    if metric.unit == LABEL:
        if sign not in ("==", "!="):
            raise GateError(f"--fail-on {text!r}: {name} is a text; expected == or !=, got {sign}")
        if metric.choices and plain not in metric.choices:
            choices = ", ".join(map(repr, metric.choices))
            raise GateError(f"--fail-on {text!r}: {name} is one of {choices}; got {plain!r}")
        return Condition(metric, sign, plain)
    try:
        number = float(plain.removesuffix("%")) / (100 if plain.endswith("%") else 1)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise GateError(f"--fail-on {text!r}: {name} is compared with a number (0.05 or 5%), got {plain!r}")
    if metric.unit == SHARE and not 0 <= number <= 1:
        raise GateError(f"--fail-on {text!r}: {name} is a share; expected 0 to 1 (0.05 or 5%), got {plain}")
    return Condition(metric, sign, number)


def judge_gate(gate: Gate, rows: Sequence[Row]) -> GateResult:
    """Judge a gate on the metrics of a lake, as `metrics.collect_metrics` returns them."""
    there = [row for row in rows if row["scope"] == gate.scope]
    for condition in gate.conditions:
        if condition.metric.selects:
            known = sorted({str(row[condition.metric.name]) for row in there})
            there = [row for row in there if condition.holds(row)]
            if not there:
                problem = f"nothing is judged: there is no {condition.metric.name} {condition.sign} {condition.value}"
                return GateResult(gate, problem=f"{problem}; {suggest_name(str(condition.value), known)}")
    if not any(row["entries"] or row.get("drives") for row in there):
        what = "drives" if gate.scope == "drive" else "recordings"
        return GateResult(gate, problem=f"nothing is judged: the lake holds no {what}")
    return GateResult(gate, [_judge_row(gate, row) for row in there])


def _judge_row(gate: Gate, row: Row) -> Judged:
    conditions = [condition for condition in gate.conditions if not condition.metric.selects]
    held = [condition.holds(row) for condition in conditions]
    values = {condition.metric.name: row.get(condition.metric.name) for condition in conditions}
    state: State = "passed" if False in held else "unknown" if None in held else "failed"
    reason = _explain_unknown(conditions, held) if state == "unknown" else _write_values(values)
    place = (row["dataset"], row["recording"] if gate.scope == "recording" else row["subset"])
    return Judged("/".join(part for part in place if part) or "the lake", state, values, reason)


def _explain_unknown(conditions: Sequence[Condition], held: Iterable[bool | None]) -> str:
    unknown = (condition.metric for condition, holds in zip(conditions, held, strict=True) if holds is None)
    return "; ".join(f"{metric.name} is not known: it needs {metric.needs}" for metric in unknown)


def _write_values(values: dict[str, Any]) -> str:
    return ", ".join(
        f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}" for name, value in values.items()
    )
