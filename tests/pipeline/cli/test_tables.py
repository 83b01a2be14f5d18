"""Tables of the terminal: alignment, folding, and silence with --quiet."""

from io import StringIO

import pytest
from rich.console import Console

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.tables import cut_text, format_number, print_table


@pytest.fixture
def terminal():
    own = Terminal()
    own.out = Console(width=40, file=StringIO(), soft_wrap=True)
    return own


def read(terminal: Terminal) -> list[str]:
    return terminal.out.file.getvalue().splitlines()


def test_names_are_left_and_figures_right(terminal):
    print_table(terminal, ["name", "n"], [["a", "1"], ["bcdef", "1,000"]], title="counts", indent=1)
    assert read(terminal) == ["counts", " name       n", " a          1", " bcdef  1,000"]


def test_columns_are_aligned_as_asked_and_rows_may_end_early(terminal):
    print_table(terminal, ["n", "name"], [["1", "abc"], ["10"]], right=[True, False])
    assert read(terminal) == [" n  name", " 1  abc", "10"]


def test_brackets_are_text(terminal):
    print_table(terminal, ["[bold]"], [["[1] a"]])
    assert read(terminal) == ["[bold]", "[1] a"]


def test_a_wide_table_is_not_cut_unless_it_is_folded(terminal):
    rows = [["a-model-of-a-very-long-name", "1.25", "2.25"], ["", "3.25", "4.25"]]
    print_table(terminal, ["", "an error, m", "another error, m"], rows)
    assert max(map(len, read(terminal))) > 40
    terminal.out.file.truncate(0)
    terminal.out.file.seek(0)
    print_table(terminal, ["", "an error, m", "another error, m"], rows, fold=True)
    lines = read(terminal)
    assert max(map(len, lines)) <= 40
    assert [line.split() for line in lines[:3]] == [["an", "another"], ["error,", "error,"], ["m", "m"]]
    assert [line.split()[-2:] for line in lines if ".25" in line] == [["1.25", "2.25"], ["3.25", "4.25"]]


def test_a_quiet_terminal_prints_no_table(terminal):
    terminal.verbose = False
    print_table(terminal, ["a"], [["b"]])
    assert read(terminal) == []


def test_long_texts_are_cut_and_missing_numbers_dashes():
    assert [cut_text("abcdef", 6), cut_text("abcdefg", 6)] == ["abcdef", "abcde…"]
    assert [format_number(None), format_number(0.125), format_number(0.5, 1, 100)] == ["-", "0.12", "50.0"]


def test_escape_sequences_are_shown_and_counted_as_what_is_shown(terminal):
    print_table(terminal, ["a\x1b[31m", "b"], [["x\x9b\u202ey", "1"]])
    assert read(terminal) == ["a\\x1b[31m     b", "x\\x9b\\u202ey  1"]
    terminal.print_problem("\x1b]0;owned\x07 [bold]", label="refused")
    assert read(terminal)[-1] == "x\\x9b\\u202ey  1"
