"""Levels of regions against Monte Carlo and SciPy, coverage and radii where the truth is known, traffic by hand."""

import math

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.stats import chi2, multivariate_normal
from tensor_tables import CLOCK, TINY, split_row, write

from tracklake.schemas.comparisons import CALIBRATION, CONFORMAL_RADII, DENSITY_ERRORS
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.comparison.bootstrap import bound_shares
from tracklake.training.comparison.calibration import find_levels, find_variance
from tracklake.training.comparison.record import SampleRecord
from tracklake.training.comparison.traffic_states import measure_densities
from tracklake.training.comparison.uncertainty import calibrate, find_radii, find_radius, score_by_density
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import measure_errors
from tracklake.training.models.prediction import Density, Prediction
from tracklake.training.runs.forecasters import Forecaster


def random_density(draw, *, samples, alternatives, ticks):
    """Alternatives of random weight, place, width and slant."""
    weight = draw.uniform(0.05, 1.0, (samples, alternatives))
    shape = (samples, alternatives, ticks)
    return Density(
        weight=(weight / weight.sum(axis=1, keepdims=True)).astype(np.float32),
        mean_m=draw.normal(0, 10, (*shape, 2)).astype(np.float32),
        sigma_m=draw.uniform(0.5, 5.0, (*shape, 2)).astype(np.float32),
        correlation=draw.uniform(-0.95, 0.95, shape).astype(np.float32),
    )


def draw_places(draw, density, sample, tick, count):
    """Places drawn from a mixture, and its density at any place, both by SciPy."""
    weight = density.weight[sample].astype(float)
    weight /= weight.sum()
    normals = []
    for mean, (along, across), slant in zip(
        density.mean_m[sample, :, tick],
        density.sigma_m[sample, :, tick],
        density.correlation[sample, :, tick],
        strict=True,
    ):
        between = float(slant) * float(along) * float(across)
        normals.append(multivariate_normal(mean, [[float(along) ** 2, between], [between, float(across) ** 2]]))
    own = draw.choice(len(weight), count, p=weight)
    drawn = np.stack([normal.rvs(count, random_state=draw) for normal in normals])[own, np.arange(count)]
    return drawn, lambda places: sum(w * normal.pdf(places) for w, normal in zip(weight, normals, strict=True))


@settings(max_examples=12)
@given(draw=st.integers(0, 10_000).map(np.random.default_rng), alternatives=st.integers(1, 6))
def test_levels_equal_monte_carlo(draw, alternatives):
    density = random_density(draw, samples=2, alternatives=alternatives, ticks=2)
    near = density.mean_m + draw.normal(0, 4, density.mean_m.shape).astype(np.float32)
    place = near[:, draw.integers(alternatives)]
    found = find_levels(density, place)
    for sample in range(2):
        for tick in range(2):
            drawn, height = draw_places(draw, density, sample, tick, 20_000)
            expected = (height(drawn) > height(place[sample, tick])).mean()
            assert found[sample, tick] == pytest.approx(expected, abs=0.02)


def test_levels_of_one_normal_density_are_those_of_scipy():
    draw = np.random.default_rng(1)
    density = random_density(draw, samples=30, alternatives=1, ticks=3)
    place = density.mean_m[:, 0] + draw.normal(0, 2, (30, 3, 2)).astype(np.float32)
    found = find_levels(density, place)
    for sample, tick in np.ndindex(found.shape):
        along, across = density.sigma_m[sample, 0, tick].astype(float)
        between = float(density.correlation[sample, 0, tick]) * along * across
        away = (place - density.mean_m[:, 0]).astype(float)[sample, tick]
        squared = away @ np.linalg.inv([[along**2, between], [between, across**2]]) @ away
        assert found[sample, tick] == pytest.approx(chi2.cdf(squared, 2), abs=2e-3)


def test_one_alternative_in_two_halves_has_the_level_of_the_whole():
    draw = np.random.default_rng(2)
    whole = random_density(draw, samples=50, alternatives=1, ticks=1)
    place = whole.mean_m[:, 0] + draw.normal(0, 2, (50, 1, 2)).astype(np.float32)
    halves = Density(
        np.full((50, 2), 0.5, np.float32),
        *(np.repeat(part, 2, 1) for part in (whole.mean_m, whole.sigma_m)),
        np.repeat(whole.correlation, 2, 1),
    )
    assert find_levels(halves, place) == pytest.approx(find_levels(whole, place), abs=0.005)
    assert find_variance(halves) == pytest.approx(find_variance(whole), rel=1e-5)


def test_variance_of_a_mixture_by_hand():
    density = Density(
        np.array([[0.25, 0.75]]), np.array([[[[0.0, 0.0]], [[4.0, 0.0]]]]), np.ones((1, 2, 1, 2)), np.zeros((1, 2, 1))
    )
    assert find_variance(density)[0, 0] == pytest.approx([1 + 0.25 * 9 + 0.75 * 1, 1])


def record(error_m, *, known=None, vehicle=None, sigma_m=1.0, seconds=(1.0,)):
    """A record of errors (S, T, 2) of a density around the prediction with the same sigma everywhere."""
    own = object.__new__(SampleRecord)
    count, ticks, _ = error_m.shape
    own.samples, own.seconds = np.arange(count), list(seconds)
    own.vehicle = np.arange(count) if vehicle is None else vehicle
    own.known = np.ones((count, ticks), dtype=bool) if known is None else known
    own.error_m = np.where(own.known[..., None], error_m, np.nan).astype(np.float32)
    own.sigma_m = np.full(error_m.shape, sigma_m, dtype=np.float32)
    own.level = np.where(own.known, -np.expm1(-(error_m**2).sum(axis=-1) / sigma_m**2 / 2), np.nan).astype(np.float32)
    return own


def test_coverage_where_the_true_sigma_is_known():
    draw = np.random.default_rng(3)
    found = calibrate("right", record(draw.normal(0, 1, (4000, 1, 2))))
    CALIBRATION.validate(found, where="here")
    assert found["coverage"].to_list() == pytest.approx(found["level"].to_list(), abs=0.02)
    # A true sigma twice the predicted one: 1 - 0.1 ** (1 / 4) of the places lie in the 90 % region.
    (row,) = calibrate("bold", record(draw.normal(0, 2, (4000, 1, 2)))).filter(level=0.9).to_dicts()
    assert row["coverage"] == pytest.approx(1 - 0.1**0.25, abs=0.02)
    assert row["low"] < row["coverage"] < row["high"]
    assert (row["n"], row["vehicles"], row["seconds"]) == (4000, 4000, 1.0)


def test_places_that_are_not_known_and_models_without_density_are_left_out():
    known = np.array([[True, True], [True, False], [False, False]])
    own = record(np.zeros((3, 2, 2)), known=known, seconds=(1.0, 2.0))
    assert calibrate("a", own).filter(level=0.5)["n"].to_list() == [2, 1]
    own.level[:] = np.nan
    own.sigma_m[:] = np.nan
    assert calibrate("a", own).is_empty()
    table = DENSITY_ERRORS.validate(score_by_density("a", own, np.array([5.0, 30.0, np.nan])), where="here")
    assert table.select("density", "seconds", "n", "mean_density_vpkm").rows() == [
        ("0 to 7", 1.0, 1, 5.0),
        ("0 to 7", 2.0, 1, 5.0),
        ("28 or more", 1.0, 1, 30.0),
        ("all", 1.0, 2, 17.5),
        ("all", 2.0, 1, 5.0),
    ]
    assert table["sigma_lateral_m"].null_count() == table.height


def test_sigma_beside_the_error_by_hand():
    own = record(np.array([[[3.0, 1.0]], [[4.0, 1.0]], [[0.0, 2.0]]]), sigma_m=2.0)
    table = score_by_density("a", own, np.array([7.0, 10.9, 11.0]))
    row = table.filter(density="7 to 11").row(0, named=True)
    assert row["rmse_longitudinal_m"] == pytest.approx(math.sqrt((9 + 16) / 2))
    assert (row["rmse_lateral_m"], row["sigma_longitudinal_m"]) == (pytest.approx(1.0), pytest.approx(2.0))
    assert table.filter(density="11 to 16")["n"].to_list() == [1]


@pytest.mark.parametrize(("level", "radius"), [(0.5, 5.0), (0.9, 9.0), (0.91, None), (0.1, 1.0)])
def test_radius_of_nine_distances(level, radius):
    # Of 9 distances number ceil(10 p) counts: there is none above the ninth.
    assert find_radius(np.array([9, 1, 8, 2, 7, 3, 6, 4, 5.0]), level) == radius


def test_radii_hold_their_share_in_every_class():
    draw = np.random.default_rng(5)
    dense = draw.random(3000) < 0.5
    error = draw.normal(0, 1, (3000, 1, 2)) * np.where(dense, 3, 1)[:, None, None]
    table = CONFORMAL_RADII.validate(find_radii("a", record(error), np.where(dense, 25.0, 3.0)), where="here")
    for row in table.iter_rows(named=True):
        assert row["coverage"] == pytest.approx(row["level"], abs=0.05)
        assert row["low"] < row["level"] + 0.03
        assert row["high"] > row["level"] - 0.03
    at = {row["density"]: row["radius_m"] for row in table.filter(level=0.9).iter_rows(named=True)}
    assert at["22 to 28"] == pytest.approx(3 * math.sqrt(-2 * math.log(0.1)), rel=0.1)
    assert at["0 to 7"] == pytest.approx(math.sqrt(-2 * math.log(0.1)), rel=0.1)
    assert at["0 to 7"] < at["all"] < at["22 to 28"]


def test_no_vehicle_gives_a_radius_and_judges_it():
    draw = np.random.default_rng(6)
    vehicle = np.repeat(np.arange(10), 4)
    table = find_radii("a", record(draw.normal(0, 1, (40, 1, 2)), vehicle=vehicle), np.full(40, 5.0))
    assert table.select("calibration_n", "n", "vehicles").unique().rows() == [(20, 20, 5)]


def test_intervals_of_shares_equal_a_loop():
    hits, n = np.array([[2.0], [0.0], [3.0], [0.0]]), np.array([[4.0], [1.0], [3.0], [0.0]])
    share = 5 / 8
    squares = sum((h - share * c) ** 2 for h, c in ((2, 4), (0, 1), (3, 3)))
    half = 4.302653 * math.sqrt(squares * 3 / 2) / 8  # Student's t of two degrees of freedom
    low, high = bound_shares(hits, n)
    assert (low[0], high[0]) == (max(share - half, 0), min(share + half, 1))


def test_none_and_all_have_exact_bounds():
    # With 4 vehicles none is right with a probability of 2.5 % where each is with 1 - 0.025 ** (1 / 4).
    n = np.full((4, 2), 3.0)
    low, high = bound_shares(np.column_stack([np.zeros(4), np.full(4, 3.0)]), n)
    assert (low.tolist(), high.tolist()) == ([0, 0.025**0.25], [1 - 0.025**0.25, 1])
    assert stats.binom.pmf(0, 4, high[0]) == pytest.approx(0.025)


def road(folder):
    """Subset b: scenes at ticks 2 to 4 with three, three and two vehicles, on 1,000 m of lane 1 and 500 m of lane 2."""
    rows = [
        (vehicle, tick, 1 + 5 * tick, x_m, 2.0 * lane, lane, 20.0, vehicle)
        for vehicle, lane, places in (
            (1, 1, (0.0, 250.0, 500.0, 750.0, 1000.0, 1000.0)),
            (2, 2, (100.0, 300.0, 500.0, 600.0, 600.0)),
            (3, 1, (0.0, 10.0, 20.0, 30.0)),
        )
        for tick, x_m in enumerate(places)
    ]
    samples = [
        ("tiny", "highd", "b", v, t, 1 + 5 * t, 1, "keep", "normal", None) for v, t in ((1, 2), (1, 3), (1, 4), (2, 2))
    ]
    clock = pl.DataFrame(rows, schema=CLOCK, orient="row")
    nothing = ("a", pl.DataFrame(schema=CLOCK), SAMPLES.empty(), NEIGHBORS.empty())
    own = ("b", clock, pl.DataFrame(samples, schema=SAMPLES.dtypes, orient="row"), NEIGHBORS.empty())
    return TensorFolder.open(
        write(folder, [nothing, own], pl.concat([split_row("a", "train"), split_row("b", "eval")]))
    )


class Sure:
    """Predicts that no vehicle moves, with a sigma of 100 m."""

    def predict(self, observed):
        shape = (len(observed.history), 1, TINY.horizon_ticks)
        zeros = np.zeros((*shape, 2), np.float32)
        return Prediction(zeros[:, 0], Density(np.ones(shape[:2], np.float32), zeros, zeros + 100, zeros[..., 0]))


def test_density_of_traffic_and_records_by_hand(tmp_path):
    folder = road(tmp_path)
    own = SampleRecord(folder, "eval")
    # Samples by vehicle and tick: 3 and 3, then 2 and 1 vehicles on 1.5 km of lane.
    assert measure_densities(folder, own.samples) == pytest.approx([3 / 1.5, 3 / 1.5, 2 / 1.5, 3 / 1.5])
    measure_errors(Forecaster("sure", Sure()), folder, "eval", observe=own.observe)
    assert own.seconds == [1.0, 2.0]
    assert own.known.tolist() == [[True, False], [True, False], [False, False], [True, False]]
    # Vehicle 1 moves 500 m in the second after tick 2, 250 m after tick 3; vehicle 2 moves 100 m.
    assert own.error_m[[0, 1, 3], 0].tolist() == [[-500, 0], [-250, 0], [-100, 0]]
    assert own.level[[0, 1, 3], 0] == pytest.approx([chi2.cdf(25, 2), chi2.cdf(6.25, 2), chi2.cdf(1, 2)], abs=1e-5)
    assert own.sigma_m[0, 0] == pytest.approx([100, 100])
    assert own.vehicle.tolist() == [0, 0, 0, 1]


def test_lane_centres_have_no_lateral_figures(tmp_path):
    folder = road(tmp_path)
    folder.index["subsets"][1]["lateral_positions"] = "lane centres"
    own = SampleRecord(folder, "eval")
    measure_errors(Forecaster("sure", Sure()), folder, "eval", observe=own.observe)
    assert calibrate("sure", own).is_empty()
    (row,) = score_by_density("sure", own, np.full(4, 5.0)).filter(density="all").to_dicts()
    assert (row["rmse_lateral_m"], row["sigma_lateral_m"]) == (None, None)
    assert row["rmse_longitudinal_m"] == pytest.approx(math.sqrt((500**2 + 250**2 + 100**2) / 3))
    assert find_radii("sure", own, np.full(4, 5.0))["radius_m"].null_count() == 12
