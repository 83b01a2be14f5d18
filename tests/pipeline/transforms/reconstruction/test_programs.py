import numpy as np
import pytest
from scipy.optimize import minimize

from tracklake.pipeline.transforms.reconstruction.programs import Rows, solve_programs
from tracklake.pipeline.transforms.reconstruction.smoothing import Series, make_penalty

RATE_HZ = 10.0


def make_dense(bands):
    """The symmetric matrix of lower diagonals, one by one."""
    count = bands.shape[1]
    dense = np.zeros((count, count))
    for offset in range(4):
        for column in range(count - offset):
            dense[column + offset, column] = dense[column, column + offset] = bands[offset, column]
    return dense


def write_out(rows, count):
    """The valid rows as a dense matrix and its right-hand sides."""
    matrix, bound = [], []
    for one in rows:
        for number in range(len(one.bound)):
            if one.valid[number]:
                line = np.zeros(count)
                first = number if one.at is None else one.at[number]
                line[first : first + len(one.coefficients)] = one.coefficients
                matrix.append(line)
                bound.append(one.bound[number])
    return np.array(matrix), np.array(bound)


def make_program(seed, sizes):
    random = np.random.default_rng(seed)
    series = Series(np.cumsum(sizes) - sizes, np.array(sizes), RATE_HZ)
    count = sum(sizes)
    bands = make_penalty(series, 1e-4)
    bands[0] += random.uniform(0.5, 1.0, count)
    wanted = random.normal(0, 0.2, count)
    within = series.lie_within(1)[:-1]
    return series, bands, wanted, within, random


@pytest.mark.parametrize("seed", range(3))
def test_solutions_are_those_of_a_general_solver(seed):
    series, bands, wanted, within, random = make_program(seed, [15, 8])
    count = len(wanted)
    rows = [
        Rows((1.0,), wanted, random.random(count) < 0.4, 1.0),
        Rows((RATE_HZ, -RATE_HZ), random.normal(0.3, 0.5, count - 1), within, 1.0),
        Rows((1.0, 0.0, -1.0), np.full(2, -0.1), np.ones(2, bool), 1.0, at=series.first),
    ]
    matrix, bound = write_out(rows, count)
    d, solved = solve_programs(bands, rows, series.first, series.size)
    assert solved.all()
    assert (matrix @ d <= bound + 1e-7).all()
    dense = make_dense(bands)
    slow = minimize(
        lambda v: v @ dense @ v / 2,
        np.zeros(count),
        jac=lambda v: dense @ v,
        method="SLSQP",
        constraints=[{"type": "ineq", "fun": lambda v: bound - matrix @ v, "jac": lambda _: -matrix}],
        options={"maxiter": 500, "ftol": 1e-13},
    )
    assert d @ dense @ d / 2 == pytest.approx(slow.fun, abs=1e-6)
    np.testing.assert_allclose(d, slow.x, atol=1e-3)


def test_rows_with_a_price_are_broken_where_others_forbid_them():
    series, bands, _, _, _ = make_program(0, [12])
    low = np.full(12, -5.0)
    rows = [
        Rows((1.0,), low, np.arange(12) == 6, 1.0, price=3.0),
        Rows((-1.0,), np.full(12, 1.0), np.arange(12) == 6, 1.0),
    ]
    d, solved = solve_programs(bands, rows, series.first, series.size)
    assert solved.all()
    dense = make_dense(bands)
    slow = minimize(
        lambda v: v[:12] @ dense @ v[:12] / 2 + 3.0 * v[12],
        np.zeros(13),
        method="SLSQP",
        bounds=[(-1.0, None) if place == 6 else (None, None) for place in range(12)] + [(0.0, None)],
        constraints=[{"type": "ineq", "fun": lambda v: v[12] - v[6] - 5.0}],
        options={"maxiter": 500, "ftol": 1e-13},
    )
    np.testing.assert_allclose(d, slow.x[:12], atol=1e-3)
    assert -1.0 - 1e-6 <= d[6] < 0


def test_without_broken_rows_nothing_moves():
    series, bands, _, within, _ = make_program(0, [10, 5])
    d, solved = solve_programs(bands, [Rows((1.0, -1.0), np.full(14, 2.0), within, 1.0)], series.first, series.size)
    assert solved.all()
    np.testing.assert_allclose(d, 0, atol=1e-4)
