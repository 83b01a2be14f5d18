"""The rules as Markdown, derived from their declarations: `python -m quality_reports.markdown > docs/rules.md`."""

from collections.abc import Iterator

from quality_reports.rules import RULES, Rule

HEAD = """# Rules

Derived from `quality_reports/`; do not edit (`make docs` writes it).

A finding is a run of consecutive entries of one vehicle that breaks one rule. Findings flag; nothing is deleted. Errors
cannot be, warnings hardly can, infos are worth knowing. Thresholds are settings: `[thresholds]` in `tracklake.toml`.
A rule is not checked where the source lacks a column that it reads, and the report says so. Values that are compared
with a threshold are rounded first (lengths to 1 mm, speeds to 0.1 mm/s, jerk to 1 mm/s3), so that what equals it in the
source's decimals does not exceed it.
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
    yield f"- Source: {rule.source}"
    yield ""


if __name__ == "__main__":
    print(write_rules(), end="")  # noqa: T201 - it is what the module is for
