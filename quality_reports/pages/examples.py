"""Worst findings of every rule in a subset: facts, the moment that is shown of each, and their SQL."""

from collections.abc import Sequence

from tracklake.quality_reports.rules.rule import Rule
from tracklake.quality_reports.summaries import Row

AROUND_S = 5.0
"""Time shown before and after a finding, and the longest shown part of the finding itself, in seconds."""
EXAMPLES = 2
"""Findings shown per rule, each of another vehicle."""
LEADING = {"gap_m", "recorded_gap_m", "leader_id", "leader_ahead_m"}
"""Columns by which a rule compares a vehicle with its leader."""


def declare_rule(rule: Rule, unit: str) -> Row:
    """Return what examples of a rule need: name, unit, extreme, and `partner`, the other vehicle that it is about.

    Args:
        rule: rule that validation used.
        unit: unit of the rule's value, as the page prints it.
    """
    partner = "overlap" if "overlap_m" in rule.reads else "leader" if LEADING & set(rule.reads) else None
    return {"name": rule.name, "unit": unit, "extreme": rule.extreme, "partner": partner}


def ask_for_examples(rules: Sequence[Row]) -> Row:
    """Return the parameters of subset_worst.sql; `rules` are rows of `declare_rule`, the gravest first."""
    return {
        "rules": [rule["name"] for rule in rules],
        "extremes": [rule["extreme"] for rule in rules],
        "examples": EXAMPLES,
    }


def describe_examples(worst: Sequence[Row], rules: Sequence[Row], rate_hz: float) -> list[Row]:
    """Add `unit`, `partner`, `moment` and `sql` to rows of subset_worst.sql.

    Args:
        worst: rows of one subset.
        rules: rows of `declare_rule`.
        rate_hz: frame rate of the subset.
    """
    about = {rule["name"]: rule for rule in rules}
    return [
        {
            **row,
            "unit": about[row["rule"]]["unit"],
            "partner": about[row["rule"]]["partner"],
            "moment": choose_moment(row, round(AROUND_S * rate_hz)),
            "sql": write_sql(row),
        }
        for row in worst
    ]


def choose_moment(finding: Row, longest: int) -> int:
    """Choose the frame that is shown of a finding: its middle, or the first where frames may be missing in between.

    Args:
        finding: first_frame, last_frame, entries.
        longest: number of frames after the first; what comes later is left out.
    """
    first, last = finding["first_frame"], finding["last_frame"]
    return int((first + min(last, first + longest)) // 2 if finding["entries"] == last - first + 1 else first)


def write_sql(finding: Row) -> str:
    """Return the statement that shows a finding's entries."""
    dataset, subset = (_quote(finding[name]) for name in ("dataset", "subset"))
    return (
        f"SELECT * FROM track({subset}, {finding['vehicle_id']})\n"
        f"WHERE dataset = {dataset} AND frame BETWEEN {finding['first_frame']} AND {finding['last_frame']}"
    )


def _quote(text: str) -> str:
    """Return a SQL string literal."""
    return "'" + text.replace("'", "''") + "'"
