"""Verdicts of the study's pages, and the intervals beside them."""

import re

INTERVAL = re.compile(r"(better|worse) (?:\()?([+-][\d.]+)[^()]*?\(?(?:95 % interval )?([+-][\d.]+) to ([+-][\d.]+)")


def check_verdicts(text):
    """Every verdict stands beside an interval that excludes zero, on the side that it says; returns their number."""
    found = INTERVAL.findall(text)
    assert len(found) == len(re.findall(r"(?:better|worse) (?:\()?[+-]", text))
    for says, *numbers in found:
        _, low, high = map(float, numbers)
        assert low <= high
        assert high <= 0 if says == "better" else low >= 0
    return len(found)
