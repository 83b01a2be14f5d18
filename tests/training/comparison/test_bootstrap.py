"""Differences with intervals: against a slow loop with the same draws, and their coverage where the truth is known."""

import math
import statistics

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tracklake.schemas.comparisons import COMPARED_FIGURES, VEHICLE_ERRORS
from tracklake.schemas.errors import UsageError
from tracklake.training.comparison import bootstrap
from tracklake.training.comparison.bootstrap import (
    SamplesDifferError,
    compare_errors,
    draw_counts,
    estimate_differences,
    find_quantile,
)


def table(sums, *, n=None, seeds=None, run="mine", seconds=(1.0, 2.0)):
    """Rows of (S, V, T) squared longitudinal errors; the other sums are 2, 3 and -4 times as large."""
    count, vehicles, horizons = sums.shape
    n = np.ones((vehicles, horizons), dtype=int) if n is None else n
    rows = [
        (
            f"{run}-{s}",
            run,
            s if seeds is None else seeds[s],
            "highd",
            "01-upper",
            v + 1,
            seconds[t],
            int(n[v, t]),
            *(factor * float(sums[s, v, t]) for factor in (1, 2, 3, -4)),
        )
        for s in range(count)
        for v in range(vehicles)
        for t in range(horizons)
        if n[v, t] > 0
    ]
    frame = pl.DataFrame(rows, schema=VEHICLE_ERRORS.dtypes, orient="row").sort(VEHICLE_ERRORS.key)
    return VEHICLE_ERRORS.validate(frame, where="test")


def figure_of(rows, figure):
    """A figure of rows that count several times: (row, times)."""
    total = sum(times * sum(row[name] for name in COMPARED_FIGURES[figure]) for row, times in rows)
    n = sum(times * row["n"] for row, times in rows)
    if n == 0:
        return math.nan
    return math.sqrt(total / n) if figure.startswith("rmse") else total / n


def loop(a, b, figure, resamples):
    """Every resample and horizon for itself, row by row, with the draws of `compare_errors`."""
    rows = [one.to_dicts() for one in (a, b)]
    ids = sorted({row["vehicle_id"] for row in rows[0]})
    seeds = [sorted({row["seed"] for row in own}) for own in rows]
    draws = [
        draw_counts(np.random.default_rng((0, number)), size, resamples)
        for number, size in enumerate((len(ids), len(seeds[0]), len(seeds[1])))
    ]
    found = {}
    for seconds in (1.0, 2.0):
        differences = []
        vehicles = len({row["vehicle_id"] for row in rows[0] if row["seconds"] == seconds})
        for r in range(resamples):
            values = []
            for own, names, counts in zip(rows, seeds, draws[1:], strict=True):
                drawn = [name for name, times in zip(names, counts[r], strict=True) for _ in range(times)]
                of_seed = [
                    figure_of(
                        [
                            (row, draws[0][r][ids.index(row["vehicle_id"])])
                            for row in own
                            if row["seed"] == name and row["seconds"] == seconds
                        ],
                        figure,
                    )
                    for name in drawn
                ]
                values.append(sum(of_seed) / len(of_seed))
            differences.append(values[0] - values[1])
        parts, estimates = [], []
        for own, names in zip(rows, seeds, strict=True):
            by_seed = [
                figure_of([(row, 1) for row in own if row["seed"] == name and row["seconds"] == seconds], figure)
                for name in names
            ]
            estimates.append(statistics.mean(by_seed))
            if len(names) > 1:
                parts.append((statistics.variance(by_seed) / len(names), len(names) - 1))
        known = [one for one in differences if not math.isnan(one)]
        rest = max(statistics.pvariance(known) - sum(part for part, _ in parts), 0)
        parts.append((rest, vehicles - 1))
        total = sum(part for part, _ in parts)
        freedom = total**2 / sum(part**2 / own for part, own in parts)
        half = stats.t.ppf(0.975, freedom) * math.sqrt(total)
        middle = estimates[0] - estimates[1]
        found[seconds] = (middle - half, middle + half)
    return found


@settings(max_examples=12)
@given(
    draw=st.integers(0, 10_000).map(np.random.default_rng),
    vehicles=st.integers(2, 5),
    seeds=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    figure=st.sampled_from(list(COMPARED_FIGURES)),
)
def test_intervals_equal_a_slow_loop_with_the_same_draws(draw, vehicles, seeds, figure):
    n = draw.integers(0, 4, (vehicles, 2))
    n[:2] += 1
    a, b = (table(draw.uniform(0, 9, (count, vehicles, 2)), n=n) for count in seeds)
    found = compare_errors(a, b, figure, resamples=40)
    expected = loop(a, b, figure, 40)
    for row in found.iter_rows(named=True):
        assert (row["low"], row["high"]) == pytest.approx(expected[row["seconds"]], rel=1e-4, abs=1e-4)
        at = a.filter(seconds=row["seconds"])
        assert (row["n"], row["vehicles"]) == (int(n[:, int(row["seconds"]) - 1].sum()), at["vehicle_id"].n_unique())


def test_a_difference_by_hand():
    # Seeds of a: RMSE sqrt((4 + 12) / 4) = 2 and sqrt((36 + 28) / 4) = 4, mean 3; of b: sqrt(4 / 4) = 1.
    n = np.array([[1, 1], [3, 3]])
    a = table(np.array([[[4, 4], [12, 12]], [[36, 36], [28, 28]]]), n=n)
    b = table(np.array([[[1, 1], [3, 3]]]), n=n)
    found = compare_errors(a, b, "rmse_longitudinal_m")
    assert found["a_value"].to_list() == pytest.approx([3, 3])
    assert found["difference"].to_list() == pytest.approx([2, 2])
    assert found.select("n", "vehicles", "a_seeds", "b_seeds").row(0) == (4, 2, 2, 1)
    assert compare_errors(b, a, "rmse_longitudinal_m")["difference"].to_list() == pytest.approx([-2, -2])


def test_the_same_errors_differ_by_nothing():
    own = table(np.random.default_rng(0).uniform(0, 9, (1, 20, 2)))
    found = compare_errors(own, own)
    assert found.select("difference", "low", "high").rows() == [(0, 0, 0)] * 2


def test_chunks_of_draws_and_the_order_of_rows_change_nothing(monkeypatch):
    draw = np.random.default_rng(1)
    a, b = (table(draw.uniform(0, 9, (2, 7, 2))) for _ in range(2))
    expected = compare_errors(a, b, resamples=50)
    monkeypatch.setattr(bootstrap, "MAX_DRAWS", 7 * 8)
    assert compare_errors(a.sample(fraction=1, shuffle=True, seed=3), b, resamples=50).equals(expected)


def test_pieces_of_one_seed_are_summed():
    draw = np.random.default_rng(2)
    sums = draw.uniform(0, 9, (2, 6, 2))
    whole, other = table(sums), table(draw.uniform(0, 9, (1, 6, 2)))
    pieces = pl.concat(
        whole.filter(pl.col("vehicle_id").is_in(ids)).with_columns(pl.col("run") + name)
        for name, ids in (("-block-1", [1, 2]), ("-block-2", [3, 4, 5, 6]))
    )
    assert compare_errors(pieces, other, resamples=50).equals(compare_errors(whole, other, resamples=50))


def test_one_vehicle_has_no_interval():
    n = np.array([[1, 1], [1, 0]])
    own = table(np.ones((1, 2, 2)), n=n)
    assert compare_errors(own, own)["low"].to_list() == [0, None]


def test_models_without_a_seed_can_be_compared():
    own = table(np.ones((1, 3, 2)), seeds=[None])
    assert compare_errors(own, table(4 * np.ones((2, 3, 2))), "rmse_longitudinal_m")["difference"].to_list() == [-1, -1]


def test_other_samples_are_refused():
    n = np.array([[1, 1], [2, 1], [1, 1]])
    own, other = table(np.ones((1, 3, 2))), table(np.ones((1, 3, 2)), n=n)
    with pytest.raises(
        SamplesDifferError, match=r"0 vehicles are in a only, 0 in b only, and 6 samples stand against 7"
    ):
        compare_errors(own, other)
    with pytest.raises(SamplesDifferError, match="1 vehicles are in a only, 0 in b only"):
        compare_errors(own, own.filter(pl.col("vehicle_id") < 3))
    with pytest.raises(SamplesDifferError, match="other samples for one seed"):
        compare_errors(pl.concat([own, other.with_columns(seed=pl.lit(1, pl.Int64))]), own)
    with pytest.raises(SamplesDifferError, match=r"a has \[1.0, 2.0\] s, b has \[1.0\] s"):
        compare_errors(own, own.filter(seconds=1.0))


def test_figures_that_a_table_lacks_are_refused():
    own = table(np.ones((1, 3, 2)))
    with pytest.raises(UsageError, match="no figure `fde_m` to compare: expected one of rmse_m"):
        compare_errors(own, own, "fde_m")
    lanes_only = own.with_columns(pl.lit(None, pl.Float64).alias("squared_lateral_m2"))
    with pytest.raises(UsageError, match="b has no `rmse_lateral_m` of every vehicle"):
        compare_errors(own, lanes_only, "rmse_lateral_m")


@pytest.mark.parametrize(("seeds", "of_seeds"), [((8, 8), 0.1), ((5, 5), 0.3), ((3, 8), 0.3)])
def test_intervals_hold_the_known_difference_in_95_of_100_cases(seeds, of_seeds):
    # Mean errors 5.0 and 5.3 of seeds and vehicles that differ, which both models share: the difference is -0.3.
    draw = np.random.default_rng(4)
    cases = 150  # as many horizons of one comparison, which know nothing of each other
    common = draw.normal(0, 0.5, (1, 40, cases))
    a, b = (
        table(
            mean + common + draw.normal(0, of_seeds, (count, 1, cases)) + draw.normal(0, 0.2, (count, 40, cases)),
            seconds=np.arange(1.0, cases + 1).tolist(),
        )
        for mean, count in zip((5.0, 5.3), seeds, strict=True)
    )
    found = compare_errors(a, b, "mae_m", resamples=400)
    held = [row["low"] <= 3 * -0.3 <= row["high"] for row in found.iter_rows(named=True)]
    assert len(held) == cases
    assert 0.90 <= sum(held) / cases <= 0.99


def test_quantiles_are_those_of_scipy():
    for freedom in (1.0, 1.7, 4.0, 11.5, 300.0, 1e7):
        assert find_quantile(freedom) == pytest.approx(stats.t.ppf(0.975, freedom), rel=2e-4)


def test_vehicles_of_successive_numbers_are_drawn_together_within_their_subset():
    """30 vehicles, so that three are drawn together: 25 in groups of 2 and 3, and 5 of another subset in 3 and 2."""
    own = table(np.arange(60.0).reshape(1, 30, 2))
    other = pl.when(pl.col("vehicle_id") > 25).then(pl.lit("02-lower")).otherwise("subset")
    errors = bootstrap.arrange_errors(own.with_columns(subset=other), "rmse_longitudinal_m")
    joined = bootstrap.join_neighbors(errors)
    sizes = joined.n[:, 0].astype(int).tolist()
    assert (len(sizes), sum(sizes[:-2]), sum(sizes[-2:]), set(sizes)) == (11, 25, 5, {2, 3})
    assert joined.total.sum() == errors.total.sum()
    assert len(bootstrap.join_neighbors(bootstrap.arrange_errors(own.head(38), "mae_m")).n) == 19  # too few to join


def test_intervals_hold_the_difference_of_vehicles_that_share_a_jam():
    """Twelve in a row share what they differ by: taken for independent, 48 of 100 intervals hold the difference."""
    draw = np.random.default_rng(6)
    cases = 100  # as many horizons
    jams = [np.repeat(draw.normal(0, 1, 26), 12)[draw.integers(0, 12) :][:300] for _ in range(cases)]
    sums = 100 + np.stack(jams, axis=-1) + draw.normal(0, 0.3, (300, cases))
    a, b = (table(own[None], seconds=np.arange(1.0, cases + 1).tolist()) for own in (sums, np.full_like(sums, 100.0)))
    found = compare_errors(a, b, "mae_m", resamples=200)
    held = [row["low"] <= 0 <= row["high"] for row in found.iter_rows(named=True)]
    assert (len(held), sum(held) >= 85) == (cases, True)


def test_intervals_of_shares_count_vehicles_of_one_jam_together():
    """200 vehicles, of which 20 in a row are alike, are as good as 10 groups: a t interval of their ten means."""
    hits = np.repeat([1.0, 0, 0, 1, 0, 1, 1, 0, 0, 0], 20)[:, None]
    low, high = bootstrap.bound_shares(hits, np.ones((200, 1)))
    half = stats.t.ppf(0.975, 9) * np.std(hits[::20], ddof=1) / 10**0.5
    assert (low[0], high[0]) == pytest.approx((0.4 - half, 0.4 + half), rel=1e-3)


def test_the_mean_of_differences_has_the_interval_of_sums_over_groups():
    """Three vehicles with 2, 1 and 3 samples, by the formula of a ratio of sums, one vehicle after the other."""
    vehicle = np.array([5, 5, 9, 7, 7, 7])
    difference = np.array([1.0, 0.0, -1.0, 1.0, 1.0, 0.0])
    mean, low, high = estimate_differences(difference[:, None], vehicle)
    assert mean[0] == pytest.approx(2 / 6)
    squares = sum(
        (difference[vehicle == own].sum() - 2 / 6 * (vehicle == own).sum()) ** 2 for own in np.unique(vehicle)
    )
    half = stats.t.ppf(0.975, 2) * math.sqrt(squares * 3 / 2) / 6
    assert (low[0], high[0]) == pytest.approx((2 / 6 - half, 2 / 6 + half), rel=1e-3)
