"""The rules as Markdown, derived from their declarations: see `make docs`."""

import sys
from collections.abc import Iterator

from tracklake.quality_reports.rules.registry import RULES, Rule
from tracklake.quality_reports.rules.rule import Case

HEAD = """# Rules

Derived from `quality_reports/`; do not edit (`make docs` writes it).

A finding is a run of consecutive entries of one vehicle that breaks one rule. Findings flag; nothing is deleted. Errors
cannot be, warnings hardly can, infos are worth knowing. Thresholds are settings: `[thresholds]` in `tracklake.toml`.
A rule is not checked where the source lacks a column that it reads, and the report says so. What equals a threshold in
the source's decimals does not exceed it; how exactly values are compared stands with each rule.

In the examples a line is an entry, at the default thresholds. What they do not say: each entry is of a vehicle of its
own, a car of 4 m x 2 m, in frame 1 of 25 Hz, in lane 1, at x = y = 0, at 20 m/s and no acceleration. An empty cell is
null.
"""


def write_rules() -> str:
    """The whole page."""
    return "\n".join([HEAD, *_table(), "", *(line for rule in RULES for line in _section(rule))])


def _table() -> Iterator[str]:
    yield "| rule | severity | unit | worst |"
    yield "| --- | --- | --- | --- |"
    for rule in RULES:
        worst = "the least" if rule.extreme == "min" else "the greatest"
        yield f"| [{rule.name}](#{rule.name}) | {rule.severity} | {rule.unit} | {worst} |"


def _section(rule: Rule) -> Iterator[str]:
    thresholds = (f"`{each.name}` = {each.default:g} {each.unit}" for each in rule.thresholds)
    yield f"## {rule.name}"
    yield ""
    yield f"An entry breaks it when {rule.meaning}."
    yield ""
    yield f"- Thresholds: {', '.join(thresholds)}"
    yield f"- Reads: {', '.join(f'`{name}`' for name in rule.columns)}"
    yield f"- Compared: {rule.compared}"
    yield f"- Source: {rule.source}"
    yield ""
    yield from _example(rule.case)
    yield ""


def _example(case: Case) -> Iterator[str]:
    facts = [f"{case.frame_rate_hz:g} Hz"] if case.frame_rate_hz != Case.frame_rate_hz else []
    if case.lane_markings_m is not None:
        facts.append(f"lane markings at {' m, '.join(map('{:g}'.format, case.lane_markings_m))} m")
    if facts:
        yield f"Example, {', '.join(facts)}:"
        yield ""
    yield f"| {' | '.join(case.entries)} | breaks it |"
    yield "| --- " * (len(case.entries) + 1) + "|"
    for place, values in enumerate(zip(*case.entries.values(), strict=True)):
        shown = ("" if value is None else f"{value:g}" if isinstance(value, float) else str(value) for value in values)
        yield f"| {' | '.join(shown)} | {'yes' if place in case.breaks else ''} |"


if __name__ == "__main__":
    sys.stdout.write(write_rules())
