"""Declaration of a rule, from which checks, findings, report rows and documentation follow."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import polars as pl

from tracklake.quality_reports.rules.derived import trace
from tracklake.schemas import references

Severity = Literal["error", "warning", "info"]
Limits = Mapping[str, float]
"""Values of thresholds by name."""

DESIGN = "docs/DESIGN.md, section 5"
STUDY, COIFMAN, PUNZO = references.HAMALAINEN.name, references.COIFMAN.name, references.PUNZO.name
RAKHA, RAJAMANI, DAGANZO = references.RAKHA.name, references.RAJAMANI.name, references.DAGANZO.name
"""Sources that several rules cite."""


@dataclass(frozen=True)
class Threshold:
    """A setting that a rule compares values with.

    Args:
        name: the setting's name, unit included.
        default: its value unless set.
        unit: SI symbol.
        least: least value allowed; None: any.
        greatest: greatest value allowed; None: any.
    """

    name: str
    default: float
    unit: str
    least: float | None = 0.0
    greatest: float | None = None

    @property
    def range(self) -> str:
        """Values that are allowed, in words."""
        if self.least is not None and self.greatest is not None:
            return f"{self.least:g} to {self.greatest:g}"
        return f"{self.least:g} or more" if self.least is not None else f"{self.greatest:g} or less"

    def allows(self, value: float) -> bool:
        """Return whether a value lies within the bounds."""
        return (self.least is None or value >= self.least) and (self.greatest is None or value <= self.greatest)


@dataclass(frozen=True)
class Case:
    """Entries just beyond a rule's thresholds and just within: its example and its test.

    Args:
        entries: values by column of `tracks` and `vehicles`, one per entry. By default each entry belongs to
            another vehicle (a car, 4 m x 2 m) in frame 1, in lane 1, at x = y = 0, 20 m/s, without acceleration;
            other columns are null. Of a rule for drives, values of `bsm`, or of ticks with placed messages, one per
            message or tick: by default all are of one vehicle, at 0 degrees latitude and longitude, and none is lost.
        breaks: indices of the entries that break the rule.
        frame_rate_hz: frame rate of the source.
        lane_markings_m: y_m of the lane markings, leftmost first.
        lanes: number of main lanes.
        last_frame: the recording's last frame; its first one is 1.
    """

    entries: Mapping[str, Sequence[Any]]
    breaks: tuple[int, ...]
    frame_rate_hz: float = 25.0
    lane_markings_m: tuple[float, ...] | None = None
    lanes: int | None = None
    last_frame: int | None = None


@dataclass(frozen=True)
class Rule:
    """A rule that entries should not break.

    Args:
        name: as in `findings.rule`.
        severity: error = cannot be, warning = hardly can, info = worth knowing.
        unit: of `value`: an SI symbol, or what is counted.
        thresholds: the settings it compares with.
        meaning: when an entry breaks it, in words.
        source: where the rule or its threshold comes from.
        breaks: thresholds by name -> boolean expression over prepared entries
            (`quality_reports.rules.derived.prepare`): the columns of `tracks` and the derived ones. True where an
            entry breaks the rule; false or null where it does not. A null operand breaks nothing.
        value: what is reported of a breaking entry, in `unit`; never null where the rule is broken. An expression, or
            thresholds by name -> expression where it depends on them.
        extreme: which end of `value` is the worst.
        compared: how exactly, in words: what equals a threshold in the source's decimals must not exceed it.
        case: its example.
        over: what it judges: entries of tracks, or a drive's messages or ticks, for which "entry" above stands too.
    """

    name: str
    severity: Severity
    unit: str
    thresholds: tuple[Threshold, ...]
    meaning: str
    source: str
    breaks: Callable[[Limits], pl.Expr]
    value: pl.Expr | Callable[[Limits], pl.Expr]
    extreme: Literal["min", "max"]
    compared: str
    case: Case
    over: Literal["entries", "messages", "ticks"] = "entries"

    @property
    def defaults(self) -> dict[str, float]:
        """Defaults of the thresholds by name."""
        return {threshold.name: threshold.default for threshold in self.thresholds}

    @cached_property
    def reads(self) -> tuple[str, ...]:
        """Columns of prepared entries that its expressions name, derived ones included."""
        names = self.breaks(self.defaults).meta.root_names() + self.measure(self.defaults).meta.root_names()
        return tuple(dict.fromkeys(names))

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Columns of `tracks`, `vehicles` and `subsets` that it needs; without one of them it is not checked."""
        return trace(self.reads)

    def broken(self, thresholds: Limits) -> pl.Expr:
        """Return an expression: true where an entry breaks the rule, else false, never null."""
        return self.breaks(thresholds).fill_null(value=False)

    def measure(self, thresholds: Limits) -> pl.Expr:
        """Return the expression of the rule's value, in its unit."""
        return self.value(thresholds) if callable(self.value) else self.value


def recorded(limit: float) -> pl.Expr:
    """Return a threshold as Float32, the dtype of recorded speeds, accelerations and sizes.

    They have two decimals at the source, so a value often is the threshold: it must equal it. As Float64 it would not:
    the Float32 next to 3.05 is less than 3.05 and the one next to 0.1 greater than 0.1.
    """
    return pl.lit(limit, dtype=pl.Float32)
