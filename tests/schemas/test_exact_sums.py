"""Sums without rounding: those of fractions, whatever the order and the parts."""

from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tracklake.schemas.arrays import SUM_BITS, divide_sum, sum_exactly

NUMBERS = st.lists(st.floats(-1e300, 1e300), max_size=30)


@given(NUMBERS, st.integers(0, 30))
def test_sums_are_those_of_fractions_and_parts_add_up(numbers, cut):
    total = sum_exactly(np.array(numbers, np.float64))
    assert Fraction(total, 2**SUM_BITS) == sum(map(Fraction, numbers))
    parts = numbers[cut:][::-1], numbers[:cut]
    assert sum(sum_exactly(np.array(part, np.float64)) for part in parts) == total


def test_quotients_are_the_nearest():
    assert divide_sum(sum_exactly(np.array([0.1] * 10)), 10) == 0.1
    assert divide_sum(sum_exactly(np.array([1e16, 1.0, -1e16])), 1) == 1.0
    assert divide_sum(sum_exactly(np.empty(0)), 3) == 0.0


def test_many_numbers_are_summed_in_blocks():
    numbers = np.full((1 << 20) + 5, 0.3)
    assert Fraction(sum_exactly(numbers), 2**SUM_BITS) == Fraction(0.3) * len(numbers)
