"""Differences between two lakes as plain values: figures, findings, sources, settings, scores."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tracklake.quality_reports.summaries import Connection, Row, plain, plain_row, query
from tracklake.schemas.columns import PARTS

COMPARISON_SCHEMA = "tracklake/comparison/1"
TOLERANCE = 1e-8
"""Relative difference below which two figures are the same; threads add in any order."""
COUNTED = ("findings", "vehicles", "entries")
"""Compared figures of a rule in a subset."""

Key = tuple[Any, ...]


@dataclass(frozen=True)
class Side:
    """One of two compared lakes.

    Args:
        connection: connection to the lake.
        facts: name, lake_id and the like, which are not compared.
        rules: names of the rules that validation used; none where it has not run.
        made_with: settings, thresholds and versions, nested by name.
        scores: results of evaluation, as `schemas.quality.ModelScores`.
    """

    connection: Connection
    facts: Mapping[str, Any]
    rules: Sequence[str] = ()
    made_with: Mapping[str, Any] = field(default_factory=dict)
    scores: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True)
class Section:
    """A statement whose rows are compared by key.

    Args:
        name: key in the result of `compare`.
        key: columns that identify a row; the other columns are figures.
        statement: name of `sql/<statement>.sql`.
        parameters: values of the statement's $names.
        left_out: columns that follow from other columns.
    """

    name: str
    key: tuple[str, ...]
    statement: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()


SUBSETS = Section("subsets", ("dataset", "subset"), "compared_subsets")
FILES = Section("files", ("dataset", "file"), "compared_files")
FIGURES = (
    Section(
        "completeness",
        ("dataset", "recording", "authority", "measure"),
        "completeness",
        left_out=("difference", "found_share"),
    ),
    Section("samples", ("protocol", "dataset", "subset"), "samples"),
    Section("sample_drops", ("protocol", "dataset", "reason"), "sample_drops"),
    Section("splits", ("split", "dataset", "subset"), "compared_parts", {"parts": list(PARTS)}),
    Section("split_balance", ("split", "dataset", "part"), "split_balance", {"parts": list(PARTS)}),
)


def compare(then: Side, now: Side) -> Row:
    """Compare the figures of two lakes.

    A change is {the key's columns, figure, then, now, difference}: difference is now - then, null unless both are
    numbers; then and now are null where there is no such row or the figure is unknown. Rows of subsets and recordings
    that only one lake holds are left out but in `subsets` and `files`. `same` counts the rows in which all is the same.

    Returns a mapping with the keys
        schema: "tracklake/comparison/1"; its number grows when a key changes meaning or goes.
        equal: whether nothing that is compared differs.
        then, now: each side's facts.
        headline: [{figure, then, now, difference}], every figure of headline.sql, over the whole lakes.
        made_with: [{name, then, now}], what differs of settings, thresholds and versions; null = not there.
        subsets: {only_then: [{dataset, subset}], only_now, changed, same}; figures of compared_subsets.sql.
        rules: {only_then: [names], only_now, totals, changed, same}; `changed` are rows {rule, dataset, subset,
            findings, vehicles, entries}, each of the three as {then, now, difference}, where any differs, of the
            subsets that both lakes hold; `totals` the same per rule, all rules, summed over those subsets.
        files: {only_then: [{dataset, file}], only_now, renamed: [{dataset, then, now}], changed, same}; figures of
            compared_files.sql. A file of another name but the same bytes is renamed.
        completeness, samples, sample_drops, splits, split_balance: {changed, same}; figures of the statements of
            FIGURES. Those of sample_drops and split_balance are over the whole lakes.
        evaluation: {changed, same}; RMSE and n per model, part and seconds.

    Args:
        then: lake to compare with.
        now: lake whose changes are shown.
    """
    sides = (then, now)
    subsets = [_query_section(side, SUBSETS) for side in sides]
    both = [_find_shared(subsets, name) for name in ("subset", "recording")]
    compared: Row = {
        "headline": _list_changes({}, *(query(side.connection, "headline")[0] for side in sides), keep_same=True),
        "made_with": _list_differing(*(dict(_leaves(plain(side.made_with))) for side in sides)),
        "subsets": _match_sides(subsets, SUBSETS.key),
        "rules": _compare_rules(then, now, both[0]),
        "files": _compare_files([_query_section(side, FILES) for side in sides]),
    }
    for section in FIGURES:
        rows = ([row for row in _query_section(side, section) if _is_shared(row, *both)] for side in sides)
        compared[section.name] = _match(section.key, *rows)
    compared["evaluation"] = _match(("model", "part", "seconds"), *map(_list_horizons, sides))
    facts = {"then": plain(then.facts), "now": plain(now.facts)}
    return {"schema": COMPARISON_SCHEMA, "equal": not any(map(_differs, compared.values())), **facts, **compared}


def _differs(part: list[Row] | Row) -> bool:
    """Tell whether a part of the comparison holds any change."""
    if isinstance(part, list):
        return any(not _is_same(row["then"], row["now"]) for row in part)
    return any(rows for name, rows in part.items() if name not in ("same", "totals"))


def _query_section(side: Side, section: Section) -> list[Row]:
    """Return a section's rows of one lake."""
    rows = query(side.connection, section.statement, section.parameters)
    return [{name: value for name, value in row.items() if name not in section.left_out} for row in rows]


def _find_shared(subsets: Sequence[list[Row]], name: str) -> set[Key]:
    """Return the pairs (dataset, subset) or (dataset, recording) that both lakes hold."""
    then, now = ({(row["dataset"], row[name]) for row in rows} for rows in subsets)
    return then & now


def _is_shared(row: Row, subsets: set[Key], recordings: set[Key]) -> bool:
    """Tell whether a row describes something that both lakes hold."""
    if "subset" in row:
        return (row["dataset"], row["subset"]) in subsets
    return "recording" not in row or (row["dataset"], row["recording"]) in recordings


def _index_rows(rows: Iterable[Row], key: Sequence[str]) -> dict[Key, Row]:
    """Return rows by the values of their key."""
    return {tuple(row[name] for name in key): row for row in rows}


def _match(key: Sequence[str], then: list[Row], now: list[Row]) -> Row:
    """Return the figures that differ, row by row, and the number of rows that are the same."""
    before, after = _index_rows(then, key), _index_rows(now, key)
    keys = dict.fromkeys((*before, *after))
    changed = [_list_changes(_name_values(key, each), before.get(each, {}), after.get(each, {})) for each in keys]
    return {"changed": [row for rows in changed for row in rows], "same": sum(not rows for rows in changed)}


def _match_sides(sides: Sequence[list[Row]], key: Sequence[str]) -> Row:
    """Match the rows that both sides have, and list the keys that only one side has."""
    then, now = (_index_rows(rows, key) for rows in sides)
    return {
        "only_then": [_name_values(key, each) for each in then if each not in now],
        "only_now": [_name_values(key, each) for each in now if each not in then],
        **_match(key, [then[each] for each in then if each in now], [now[each] for each in now if each in then]),
    }


def _name_values(key: Sequence[str], values: Key) -> Row:
    """Return the values of a key by column."""
    return dict(zip(key, values, strict=True))


def _list_changes(key: Row, then: Row, now: Row, *, keep_same: bool = False) -> list[Row]:
    """List the figures of a row that differ; with `keep_same` all of them."""
    return [
        {**key, "figure": name, **_pair(then.get(name), now.get(name))}
        for name in dict.fromkeys((*then, *now))
        if name not in key and (keep_same or not _is_same(then.get(name), now.get(name)))
    ]


def _pair(then: object, now: object) -> Row:
    """Return two figures and their difference, None unless both are numbers."""
    difference = None
    if isinstance(then, int | float) and isinstance(now, int | float) and bool not in (type(then), type(now)):
        difference = plain(now - then)
    return {"then": then, "now": now, "difference": difference}


def _is_same(then: object, now: object) -> bool:
    """Tell whether two figures are the same, fractions within TOLERANCE."""
    if isinstance(then, float) and isinstance(now, float):
        return math.isclose(then, now, rel_tol=TOLERANCE)
    return bool(then == now)


def _compare_rules(then: Side, now: Side, shared: set[Key]) -> Row:
    """Compare the findings of each rule in the subsets that both lakes hold."""
    key = ("rule", "dataset", "subset")
    before, after = (
        _index_rows(query(side.connection, "compared_rules", {"rules": list(side.rules)}), key) for side in (then, now)
    )
    rows = [
        _compare_counts(_name_values(key, each), [before.get(each, {})], [after.get(each, {})])
        for each in dict.fromkeys((*before, *after))
        if each[1:] in shared
    ]
    changed = [row for row in rows if any(not _is_same(row[name]["then"], row[name]["now"]) for name in COUNTED)]
    return {
        "only_then": [name for name in then.rules if name not in now.rules],
        "only_now": [name for name in now.rules if name not in then.rules],
        "totals": [
            _compare_counts(
                {"rule": name},
                *(
                    [row for each, row in found.items() if each[0] == name and each[1:] in shared]
                    for found in (before, after)
                ),
            )
            for name in dict.fromkeys((*then.rules, *now.rules))
        ],
        "changed": changed,
        "same": len(rows) - len(changed),
    }


def _compare_counts(key: Row, then: list[Row], now: list[Row]) -> Row:
    """Compare the sums of COUNTED; null where no subset was checked."""
    return {**key, **{name: _pair(_sum(then, name), _sum(now, name)) for name in COUNTED}}


def _sum(rows: list[Row], name: str) -> int | None:
    """Return the sum of a column, None where all values are null."""
    values = [row[name] for row in rows if row.get(name) is not None]
    return sum(values) if values else None


def _compare_files(sides: Sequence[list[Row]]) -> Row:
    """Compare source files; files with the same bytes but another name are renamed."""
    found = _match_sides(sides, FILES.key)
    then, now = (_index_rows(rows, FILES.key) for rows in sides)
    new_name = {(row["dataset"], now[row["dataset"], row["file"]]["sha256"]): row["file"] for row in found["only_now"]}
    renamed = []
    for row in found["only_then"]:
        bytes_of = (row["dataset"], then[row["dataset"], row["file"]]["sha256"])
        if bytes_of in new_name:
            renamed.append({"dataset": row["dataset"], "then": row["file"], "now": new_name.pop(bytes_of)})
    old_names, new_names = ({(row["dataset"], row[side]) for row in renamed} for side in ("then", "now"))
    return {
        **found,
        "only_then": [row for row in found["only_then"] if (row["dataset"], row["file"]) not in old_names],
        "only_now": [row for row in found["only_now"] if (row["dataset"], row["file"]) not in new_names],
        "renamed": renamed,
    }


def _list_horizons(side: Side) -> list[Row]:
    """Return a row per model, part and horizon."""
    return [
        {"model": score["model"], "part": score["part"], **plain_row(row)}
        for score in side.scores
        for row in score["rows"]
    ]


def _leaves(value: object, prefix: str = "") -> list[tuple[str, object]]:
    """Return (dotted name, value) of every value that is no mapping."""
    if not isinstance(value, Mapping):
        return [(prefix, value)]
    return [leaf for name, each in value.items() for leaf in _leaves(each, f"{prefix}.{name}" if prefix else name)]


def _list_differing(then: Row, now: Row) -> list[Row]:
    """List the names whose values differ, with both values."""
    return [
        {"name": name, "then": then.get(name), "now": now.get(name)}
        for name in dict.fromkeys((*then, *now))
        if not _is_same(then.get(name), now.get(name))
    ]
