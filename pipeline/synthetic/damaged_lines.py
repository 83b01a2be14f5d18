"""Damaged lines: exact duplicates, and extra lines that no reader can use.

Every malformed line is an extra one (a damaged copy of a real line, or an empty line), so no vehicle loses an entry.
"""

from dataclasses import dataclass

import numpy as np

DUPLICATES = 6
"""Number of exact duplicates in a damaged file."""


@dataclass(frozen=True)
class LineDefect:
    """One line inserted into a file.

    `name` is duplicate_row, truncated_line, word_in_number, wrong_field_count, empty_line, nul_byte, repeated_header or
    open_quote; `line` is the line's number in the file, from 1.
    """

    name: str
    line: int
    text: str


@dataclass(frozen=True)
class Dialect:
    """The dialect of a file that is damaged; a separator of None means runs of blanks.

    `number_field` is the index of a field that must be a number; with `quotes` a line can end inside a quote.
    """

    header: bool
    separator: str | None
    number_field: int
    quotes: bool = False


def damage_lines(lines: list[str], dialect: Dialect, random: np.random.Generator) -> tuple[list[str], list[LineDefect]]:
    """Insert duplicates and malformed lines at random after the first data line; also return the inserted lines."""
    first = 1 if dialect.header else 0
    if len(lines) - first < 2:
        return lines, []
    kinds = ["duplicate_row"] * DUPLICATES
    kinds += ["truncated_line", "word_in_number", "wrong_field_count", "empty_line", "nul_byte"]
    kinds += ["repeated_header"] * dialect.header + ["open_quote"] * dialect.quotes
    inserted: dict[int, list[tuple[str, str]]] = {}
    for kind in kinds:
        place = int(random.integers(first, len(lines)))
        inserted.setdefault(place, []).append((kind, lines[place]))
    damaged: list[str] = []
    defects: list[LineDefect] = []
    for place, line in enumerate(lines):
        damaged.append(line)
        for kind, text in inserted.get(place, ()):
            damaged.append(_make_line(kind, text, lines[0], dialect))
            defects.append(LineDefect(kind, len(damaged), text))
    return damaged, defects


def _make_line(kind: str, line: str, first_line: str, dialect: Dialect) -> str:
    blank = dialect.separator is None
    fields = line.split() if blank else line.split(dialect.separator)
    glue = " " if blank else str(dialect.separator)
    place = dialect.number_field
    if kind == "duplicate_row":
        return line
    if kind == "truncated_line":
        return line[: len(line) * 2 // 5]
    if kind == "word_in_number":
        return glue.join([*fields[:place], "fast", *fields[place + 1 :]])
    if kind == "wrong_field_count":
        return glue.join([*fields, "0"])
    if kind == "nul_byte":
        return glue.join([*fields[:place], fields[place] + "\0", *fields[place + 1 :]])
    if kind == "repeated_header":
        return first_line
    if kind == "open_quote":
        return glue.join([*fields[:place], '"' + fields[place], *fields[place + 1 :]])
    return ""
