"""Tables in a terminal, as aligned lines of text that are never cut off."""

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from textwrap import wrap

from tracklake.pipeline.cli.console import Terminal
from tracklake.schemas.text import make_visible

GAP = 2
"""Space between two columns, in characters; 1 where the terminal is too narrow."""
UNBROKEN = "\N{NO-BREAK SPACE}"
"""Space at which first cells are not broken; it is printed as a plain one."""
MIN_NAME_CHARS = 12
"""Least width of the first column of a folded table, in characters."""


def print_table(
    terminal: Terminal,
    headings: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    title: str = "",
    right: Sequence[bool] | None = None,
    styles: Sequence[str] = (),
    indent: int = 0,
    fold: bool = False,
) -> None:
    """Print a table for people.

    Args:
        terminal: terminal of the command.
        headings: one per column.
        rows: cells as text; a row may end early.
        title: line above the table.
        right: whether a column is aligned to the right, by column; by default all but the first.
        styles: style of each row; plain where the sequence ends early.
        indent: spaces before each line of the table.
        fold: whether, where the terminal is too narrow, headings are broken at spaces and first cells into lines.
    """
    if not terminal.verbose:
        return
    aligned = right if right is not None else [False, *[True] * (len(headings) - 1)]
    headings = [make_visible(heading) for heading in headings]
    body = [[*(make_visible(cell, keep="\n") for cell in row), *[""] * (len(headings) - len(row))] for row in rows]
    head, gap = [list(headings)], GAP
    widths = _measure([*head, *body])
    if fold and sum(widths) + gap * len(widths) > terminal.out.width:
        gap = 1
        head = [list(line) for line in zip(*_break_headings(headings), strict=True)]
        widths = _measure([*head, *body])
        rest = terminal.out.width - sum(widths[1:]) - gap * len(widths)
        widths[0] = min(widths[0], max(MIN_NAME_CHARS, rest))
    if title:
        terminal.print_line(title, style="bold")
    lines = [(row, "bold") for row in head]
    for row, style in zip_longest(body, styles[: len(body)], fillvalue=""):
        name, *continued = (wrap(row[0], widths[0]) or [""]) if fold else [row[0]]
        lines += [([name, *row[1:]], str(style)), *(([part], str(style)) for part in continued)]
    lines = [([cells[0].replace(UNBROKEN, " "), *cells[1:]], style) for cells, style in lines]
    for cells, style in lines:
        shown = [
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(cells, widths, aligned, strict=False)
        ]
        terminal.print_line(" " * indent + (" " * gap).join(shown).rstrip(), style=style)


def cut_text(text: str, chars: int) -> str:
    """Shorten a text to a number of characters, the last of them an ellipsis."""
    return text if len(text) <= chars else text[: chars - 1] + "…"


def format_number(value: float | None, digits: int = 2, scale: float = 1.0) -> str:
    """Write a number with fixed decimals, never as -0.0, and a missing one as `-`."""
    return "-" if value is None else f"{scale * value:z.{digits}f}"


def _measure(lines: Sequence[Sequence[str]]) -> list[int]:
    return [max(map(len, column)) for column in zip(*lines, strict=True)]


def _break_headings(headings: Sequence[str]) -> list[list[str]]:
    """Break headings at spaces into equally many lines each, the last ones filled."""
    parts = [heading.split(" ") for heading in headings]
    height = max(map(len, parts))
    return [[""] * (height - len(words)) + words for words in parts]
