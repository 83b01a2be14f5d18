"""Notes of a run: each once, and many that say the same of many recordings as one."""

from tracklake.pipeline.cli.summary import join_notes


def test_notes_alike_are_printed_once():
    many = [f"{number:02d}: {number} rows had no leader" for number in range(1, 31)]
    other = "split csp-2018 leaks: 5 of 7"
    assert join_notes([*many, other, other]) == [other, "01: 1 rows had no leader (and 29 alike)"]


def test_a_few_notes_are_printed_one_by_one():
    few = ["01: 3 rows", "02: 4 rows", "us-101: 5 rows"]
    assert join_notes(few) == few
    assert join_notes([]) == []
