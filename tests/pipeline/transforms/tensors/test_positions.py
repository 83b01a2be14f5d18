"""Positions as they are stored: exact, or in whole steps with the error that is reported."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tensors.positions import store_positions
from tracklake.schemas.errors import TracklakeError

STEPS = {"int16-decimetres": 0.1, "int16-centimetres": 0.01}


def test_float32_is_kept_and_its_error_told():
    stored = store_positions(np.array([0.5, 2**24 + 1.0]), np.array([1.0, 2.0]), storage="float32", where="a")
    assert stored.steps.dtype == np.float32
    assert stored.steps.tolist() == [[0.5, 1], [2**24, 2]]
    assert (stored.centre_m, stored.max_error_m, stored.squared_error_m2) == ((0, 0), (1, 0), (1, 0))


def test_int16_by_hand():
    # The median of x is 100.04, which is 1000 steps of a decimetre and a bit: steps count from 100.0 m.
    stored = store_positions(
        np.array([90.0, 100.04, 110.07]), np.array([2.0, 3.0, 4.0004]), storage="int16-decimetres", where="a"
    )
    assert stored.steps.dtype == np.int16
    assert stored.steps.tolist() == [[-100, -1000], [0, 0], [101, 1000]]
    assert stored.centre_m == pytest.approx((100.0, 3.0))
    assert stored.max_error_m == pytest.approx((0.04, 0.0004), abs=1e-5)
    assert stored.squared_error_m2 == pytest.approx((0.04**2 + 0.03**2, 0.0004**2), abs=1e-6)


@given(x_m=st.lists(st.floats(0, 600), max_size=20), storage=st.sampled_from(list(STEPS)), y_m=st.floats(-5, 25))
def test_what_is_read_back_errs_by_half_a_step_at_most(x_m, y_m, storage):
    if storage == "int16-centimetres":
        x_m = [x / 2 for x in x_m]
    given_m = np.array([x_m, [y_m] * len(x_m)]).T.reshape(-1, 2)
    stored = store_positions(given_m[:, 0], given_m[:, 1], storage=storage, where="a")
    step = np.array([STEPS[storage], 0.001])
    error = np.abs(np.array(stored.centre_m) + stored.steps * step - given_m)
    assert (error <= step / 2 + 1e-9).all()
    np.testing.assert_allclose(stored.max_error_m, error.max(axis=0, initial=0), atol=1e-4)


def test_roads_that_centimetres_do_not_reach_are_refused():
    x_m = np.array([0.0, 400.0, 800.0])
    with pytest.raises(TracklakeError, match=r"a/b: positions along the road reach 400.00 m from the median; int16 in"):
        store_positions(x_m, np.zeros(3), storage="int16-centimetres", where="a/b")
    assert store_positions(x_m, np.zeros(3), storage="int16-decimetres", where="a/b").max_error_m == (0, 0)
    with pytest.raises(TracklakeError, match=r"positions across it reach 40.00 m .* of 0.001 m reaches 32.77 m"):
        store_positions(np.zeros(3), np.array([0.0, 0.0, 40.0]), storage="int16-decimetres", where="a/b")


def test_no_positions():
    stored = store_positions(np.empty(0), np.empty(0), storage="int16-decimetres", where="a")
    assert stored.steps.shape == (0, 2)
    assert stored.max_error_m == (0, 0)
