"""Verdicts: whether a subset and a dataset can be used, and why, from findings, completeness and exclusions."""

from collections.abc import Mapping, Sequence
from typing import Any

from tracklake.schemas.quality_tracks import RuleFindings, Verdict

GOOD, CARE, BAD, UNKNOWN = "usable", "usable with care", "not usable", "not checked"
VERDICTS = (BAD, CARE, GOOD, UNKNOWN)
"""Possible verdicts, the worst first."""
CARE_ERROR_SHARE, BAD_ERROR_SHARE = 0.01, 0.1
"""Shares of a subset's entries with an error from which on it is usable with care, and not usable."""
CARE_WARNING_SHARE = 0.1
"""Share of a subset's entries that break one rule of severity warning from which on it is usable with care."""
CARE_MISSING_SHARE = 0.01
"""Share of the announced vehicles or entries that are missing from which on a recording is usable with care."""

SHARE_DIGITS = 9
"""Decimals of shares: the last ones depend on how a sum was rounded."""
SEVERITIES = ("error", "warning", "info")
"""Severities of rules, the gravest first."""
LIMITS = {
    "care_errors": CARE_ERROR_SHARE,
    "bad_errors": BAD_ERROR_SHARE,
    "care_warnings": CARE_WARNING_SHARE,
    "care_missing": CARE_MISSING_SHARE,
}
"""Limits of the verdicts, as the report shows them."""

Row = Mapping[str, Any]
Reason = tuple[str, str]
"""A verdict that holds at best, and why."""


def judge(
    subsets: Sequence[Row], scores: Sequence[Row], rules: Sequence[Row], completeness: Sequence[Row]
) -> list[Verdict]:
    """Judge every subset and then every dataset (subset null); the reasons that weigh most come first.

    Rules of severity info never count. From rows of subsets.sql, of subset_scores.sql and of completeness.sql, and the
    rules with their findings.
    """
    scored = {(row["dataset"], row["subset"]): row for row in scores}
    found: dict[tuple[str, str], list[Row]] = {}
    for rule in rules:
        named = {"rule": rule["name"], "severity": rule["severity"]}
        for row in rule["subsets"]:
            found.setdefault((row["dataset"], row["subset"]), []).append({**row, **named})
    counted: dict[tuple[str, str], list[Row]] = {}
    for row in completeness:
        counted.setdefault((row["dataset"], row["recording"]), []).append(row)
    verdicts = []
    for subset in subsets:
        key = subset["dataset"], subset["subset"]
        reasons = [
            *_judge_exclusion(subset),
            *_judge_findings(scored.get(key), found.get(key, [])),
            *_judge_completeness(counted.get((subset["dataset"], subset["recording"]), [])),
        ]
        verdicts.append(_sum_up(*key, subset["entries"], reasons, scored.get(key)))
    return [*verdicts, *_judge_datasets(verdicts)]


def _judge_exclusion(subset: Row) -> list[Reason]:
    """Return the reasons that validation itself gives."""
    if subset["excluded"] is None:
        return [(UNKNOWN, "validation has not run")]
    return [(BAD, f"excluded: {subset['excluded_reason']}")] if subset["excluded"] else []


def _judge_findings(scores: Row | None, found: Sequence[Row]) -> list[Reason]:
    """Return the reasons that errors and warnings give, the rule with most entries named."""
    reasons = []
    errors = _sort([row for row in found if row["severity"] == "error" and row["entries"]])
    share = _find_error_share(scores) or 0.0
    if share >= CARE_ERROR_SHARE:
        named = ", ".join(f"{row['rule']} {row['entry_share']:.1%}" for row in errors[:2])
        level = BAD if share >= BAD_ERROR_SHARE else CARE
        reasons.append((level, f"{share:.1%} of the entries have an error" + (f" ({named})" if named else "")))
    common = [row for row in found if (row["entry_share"] or 0) >= CARE_WARNING_SHARE]
    warnings = [row for row in common if row["severity"] == "warning"]
    reasons += [(CARE, f"{row['entry_share']:.1%} of the entries break {row['rule']}") for row in _sort(warnings)]
    return reasons


def _find_error_share(scores: Row | None) -> float | None:
    """Return the share of a subset's entries with an error; None before validation."""
    return round(1 - scores["share_without_error"], SHARE_DIGITS) if scores else None


def _sort(rows: Sequence[Row]) -> list[Row]:
    """Return findings with those of most entries first."""
    return sorted(rows, key=lambda row: (-row["entries"], row["rule"]))


def _judge_completeness(counted: Sequence[Row]) -> list[Reason]:
    """Return the reason that missing vehicles or entries give: the greatest share that is missing."""
    shares = [
        (1 - row["found_share"], row)
        for row in counted
        if row["measure"] in ("vehicles", "entries") and row["found_share"] is not None
    ]
    share, row = max(shares, key=lambda pair: pair[0], default=(0.0, {}))
    if share < CARE_MISSING_SHARE:
        return []
    text = f"{row['found']:,} of {row['expected']:,} announced {row['measure']} are there"
    return [(CARE, text)]


def _sum_up(dataset: str, subset: str | None, entries: int, reasons: Sequence[Reason], scores: Row | None) -> Verdict:
    """Return the verdict of a subset: the worst that any reason allows."""
    levels = [level for level, _ in reasons]
    verdict = next((level for level in (BAD, CARE, UNKNOWN) if level in levels), GOOD)
    ordered = sorted(reasons, key=lambda reason: VERDICTS.index(reason[0]))
    return {
        "dataset": dataset,
        "subset": subset,
        "verdict": verdict,
        "entries": entries,
        "error_share": _find_error_share(scores),
        "reasons": [text for _, text in ordered],
    }


def _judge_datasets(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Judge datasets by their subsets: usable where all are, not usable where none is, else usable with care."""
    judged: list[Verdict] = []
    for dataset in dict.fromkeys(each["dataset"] for each in verdicts):
        own = [each for each in verdicts if each["dataset"] == dataset]
        levels = [each["verdict"] for each in own]
        entries = sum(each["entries"] for each in own)
        known = [each for each in own if each["error_share"] is not None]
        of_known = sum(each["entries"] for each in known)
        wrong = sum(each["entries"] * (each["error_share"] or 0) for each in known)
        judged.append(
            {
                "dataset": dataset,
                "subset": None,
                "verdict": levels[0] if len(set(levels)) == 1 else CARE,
                "entries": entries,
                "error_share": round(wrong / of_known, SHARE_DIGITS) if of_known else None,
                "reasons": [
                    f"{levels.count(level)} of {len(own)} subsets {'is' if levels.count(level) == 1 else 'are'} {level}"
                    for level in (GOOD, CARE, BAD, UNKNOWN)
                    if level in levels
                ],
            }
        )
    return judged


def rank_rules(rules: Sequence[RuleFindings]) -> list[RuleFindings]:
    """Return rules with their findings, the gravest severity first and within it the rule that most entries break."""
    return sorted(rules, key=lambda rule: (SEVERITIES.index(rule["severity"]), -(rule["total"]["entries"] or 0)))


def rank_verdicts(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """Return the verdicts on subsets, the worst first and within them those with most errors."""
    subsets = [row for row in verdicts if row["subset"] is not None]
    return sorted(subsets, key=lambda row: (VERDICTS.index(row["verdict"]), -(row["error_share"] or 0)))
