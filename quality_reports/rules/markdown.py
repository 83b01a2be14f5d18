"""Page of the rules as Markdown, derived from their declarations: see `make docs`."""

import sys
from collections.abc import Iterator, Sequence

from tracklake.quality_reports.rules.registry import DRIVE_RULES, RULES, Rule
from tracklake.quality_reports.rules.rule import Case
from tracklake.schemas.markdown import format_table
from tracklake.schemas.references import link_references

NOUNS = {"entries": "An entry", "messages": "A message", "ticks": "A tick"}
"""What breaks a rule, by what it judges."""
HEAD = """# Rules

Derived from `quality_reports/`; do not edit (`make docs` writes it).

A finding is a run of consecutive entries of one vehicle that breaks one rule. Findings flag; nothing is deleted. Errors
cannot be, warnings hardly can, infos are worth knowing. Thresholds are settings: `[thresholds]` in `tracklake.toml`.
A rule is not checked where the source lacks a column that it reads, and the report says so. What equals a threshold in
the source's decimals does not exceed it; each rule says how values are compared.

In the examples a line is an entry, at the default thresholds. By default each entry belongs to another vehicle,
a car of 4 m x 2 m, in frame 1 of 25 Hz, in lane 1, at x = y = 0, at 20 m/s and no acceleration. An empty cell is
null.
"""

DRIVES = """## Rules for drives

A drive's findings (`drive_findings`) are runs of consecutive messages of one station, or of adjacent ticks of one
vehicle, that break one rule; `drive_checks` counts what each rule was checked on. In the
examples a line is a message or a tick of one vehicle, which stands at 0 degrees latitude and longitude.
"""


def write_rules() -> str:
    """Write the whole page."""
    lines = [HEAD, *_write_overview(RULES), *(line for rule in RULES for line in _write_section(rule))]
    lines += [DRIVES, *_write_overview(DRIVE_RULES), *(line for rule in DRIVE_RULES for line in _write_section(rule))]
    return "\n".join(lines)


def _write_overview(rules: Sequence[Rule]) -> list[str]:
    """Return the lines of a table of rules."""
    return [*format_table(("rule", "severity", "unit", "worst"), map(_summarise, rules)), ""]


def _summarise(rule: Rule) -> tuple[str, ...]:
    """Return the cells of a rule's row in the overview."""
    worst = "the least" if rule.extreme == "min" else "the greatest"
    return f"[{rule.name}](#{rule.name})", rule.severity, rule.unit, worst


def _write_section(rule: Rule) -> Iterator[str]:
    """Yield the lines of a rule's section."""
    thresholds = (f"`{each.name}` = {each.default:g} {each.unit} ({each.range})" for each in rule.thresholds)
    yield f"## {rule.name}"
    yield ""
    yield f"{NOUNS[rule.over]} breaks it when {rule.meaning}."
    yield ""
    yield f"- Thresholds: {', '.join(thresholds)}"
    yield f"- Reads: {', '.join(f'`{name}`' for name in rule.columns)}"
    yield f"- Compared: {rule.compared}"
    yield f"- Source: {link_references(rule.source)}"
    yield ""
    yield from _write_example(rule.case)
    yield ""


def _write_example(case: Case) -> Iterator[str]:
    """Yield the lines of a rule's example."""
    facts = [f"{case.frame_rate_hz:g} Hz"] if case.frame_rate_hz != Case.frame_rate_hz else []
    if case.lane_markings_m is not None:
        facts.append(f"lane markings at {' m, '.join(map('{:g}'.format, case.lane_markings_m))} m")
    if facts:
        yield f"Example, {', '.join(facts)}:"
        yield ""
    rows = (
        (*map(_format_value, values), "yes" if place in case.breaks else "")
        for place, values in enumerate(zip(*case.entries.values(), strict=True))
    )
    yield from format_table((*case.entries, "breaks it"), rows)


def _format_value(value: object) -> str:
    """Return the text of a value; nothing for null."""
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.stdout.write(write_rules())
