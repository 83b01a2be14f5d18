"""Scores, the forest of maneuvers and warnings on drives, against loops and by hand."""

from dataclasses import replace

import numpy as np
import pytest
from drive_tables import LANE_M, make_drive, make_traffic
from scipy.stats import norm

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.lane_forest import ALL, STRATA
from tracklake.training.onboard.collisions import compare_overlaps, find_overlaps, score_warnings
from tracklake.training.onboard.maneuvers import CORRELATED, NAMES, correlate_pairs, find_cells, fit_forest
from tracklake.training.onboard.models import Forecaster, make_forecaster, predict_straight, predict_turns
from tracklake.training.onboard.samples import build_samples, split_samples
from tracklake.training.onboard.scores import (
    bootstrap_mean,
    count_confusion,
    learn_curve,
    list_published,
    score_forest,
    score_model,
)


@pytest.fixture(scope="module")
def parts():
    return split_samples(build_samples(*make_traffic(30, noise_m=0.1)).samples, seed=0)


@pytest.fixture(scope="module")
def forest(parts):
    return fit_forest(parts.train, seed=0)


@pytest.fixture(scope="module")
def ctrv(parts):
    return make_forecaster("ctrv", predict_turns, parts.train)


def test_errors_and_likelihoods_are_those_of_a_loop(parts, ctrv):
    rows = {(row.stratum, row.seconds): row for row in score_model(ctrv, parts.eval)}
    assert len(rows) == 5 * 4
    place_m = predict_turns(parts.eval).astype(float)
    for stratum, seconds, tick in ((ALL, 0.5, 4), (STRATA[1], 2.0, 19)):
        members = [sample for sample in range(len(parts.eval)) if stratum in (ALL, STRATA[parts.eval.stratum[sample]])]
        errors = [place_m[sample, tick] - parts.eval.place_m[sample, tick] for sample in members]
        distances = [np.hypot(*error) for error in errors]
        row = rows[stratum, seconds]
        assert row.n == len(members)
        assert row.mae_m == pytest.approx(np.mean(distances))
        assert row.rmse_m == pytest.approx(np.sqrt(np.mean(np.square(distances))))
        nll = [-norm.logpdf(error, scale=ctrv.sigma_m[tick]).sum() for error in errors]
        assert row.nll_nats == pytest.approx(np.mean(nll), rel=1e-4)
        assert row.mae_m_low < row.mae_m < row.mae_m_high
        assert row.cell_with_forest is None
    assert sum(rows[name, 1.0].n for name in STRATA) == rows[ALL, 1.0].n == len(parts.eval)
    assert rows[ALL, 1.0].trajectories == len(np.unique(parts.eval.trajectory))


def test_intervals_draw_trajectories_and_not_samples():
    values = np.repeat([[0.0], [1.0]], 50, axis=0)  # two trajectories: one always right, one always wrong
    low, high = bootstrap_mean(values, np.repeat([0, 1], 50))
    assert (low[0], high[0]) == (0, 1)
    low, high = bootstrap_mean(values, np.arange(100))
    assert 0.35 < low[0] < 0.45
    assert 0.55 < high[0] < 0.65


def test_the_truth_is_always_in_its_cell_unless_outside(parts):
    perfect = Forecaster("truth", lambda samples: samples.place_m, np.ones((20, 2)))
    last = score_model(perfect, parts.eval)[3]
    confusion = count_confusion(perfect, parts.eval)[3]
    assert (confusion == np.diag(np.diag(confusion))).all()
    assert confusion.sum() == last.n
    assert last.cell == pytest.approx(1 - confusion[9, 9] / last.n)


def test_cells_are_a_lane_wide_and_as_long_as_the_approach_in_a_second():
    samples = build_samples(*make_drive([{"speed": 29.0}], ticks=41)).samples  # 4 m/s: cells of 4 m
    place_m = samples.place_m.copy()
    assert find_cells(samples, place_m)[0, 3].tolist() == [0, 0]
    place_m[0, 19] += [2.1, -0.51 * LANE_M]
    assert find_cells(samples, place_m)[0, 3].tolist() == [-1, 1]
    place_m[0, 19] += [-8.2, 0]
    assert find_cells(samples, place_m)[0, 3].tolist() == [-1, -2]  # outside, behind


def test_the_majority_of_the_trees_decides(parts, forest):
    votes = forest.count_votes(parts.eval)
    assert (votes.sum(axis=-1) == 100).all()
    some = parts.eval.select(np.arange(5))
    given = np.concatenate([some.feature[:, -1], some.feature[:, -1] - some.feature[:, 0]], axis=1)[:, forest.chosen]
    for sample in range(5):
        counts = [0, 0, 0]
        for tree in forest.classifier.estimators_:
            counts[int(forest.classifier.classes_[0][int(tree.predict(given[sample : sample + 1])[0, 0])])] += 1
        assert counts == votes[sample, 0].tolist()
    assert forest.decide(parts.eval).tolist() == votes.argmax(axis=-1).tolist()
    assert forest.classifier.criterion == "entropy"
    assert {row.feature for row in forest.coefficients} == set(NAMES)
    again = fit_forest(parts.train, seed=0)
    np.testing.assert_array_equal(again.count_votes(parts.eval), votes)


def test_the_correlation_matrix_is_that_of_numpy(parts, forest):
    part = parts.train
    maneuvers = [part.maneuver == number for number in range(3)]
    columns = np.column_stack([part.feature[:, -1], part.feature[:, -1] - part.feature[:, 0], *maneuvers]).astype(float)
    varies = columns.std(axis=0) > 1e-6
    matrix = correlate_pairs(part)
    assert matrix.shape == forest.matrix.shape == (27, 27) == (len(CORRELATED), len(CORRELATED))
    expected = np.corrcoef(columns[:, varies], rowvar=False)
    np.testing.assert_allclose(matrix[np.ix_(varies, varies)], expected, atol=1e-6)
    assert not matrix[~varies].any()
    assert 10 < varies.sum() < 27  # the height of a box does not vary


def test_the_forest_gives_the_column_and_the_model_the_row(parts, forest, ctrv):
    joined = score_model(ctrv, parts.eval, forest)
    assert all(row.cell_with_forest is not None for row in joined if row.n)
    assert joined[3].cell_with_forest > joined[3].cell  # CTRV alone knows of no lane change
    scored = score_forest(forest, parts.eval)
    assert scored[0].n == len(parts.eval)
    assert scored[0].accuracy > scored[0].majority


def test_a_learning_curve_has_both_scores(parts):
    points = learn_curve(parts, seed=0, sizes=(40, 80))
    assert [point.drawn for point in points] == [40, 80]
    assert all((point.train_n, point.eval_n) == (len(parts.train), len(parts.eval)) for point in points)
    assert points[-1].train_accuracy > 0.8


def test_a_forest_needs_lane_changes():
    samples = build_samples(*make_drive([{"x_m": 10.0 * own} for own in range(4)])).samples
    with pytest.raises(TracklakeError, match=r"some that change it; got \[64, 0, 0\].*4 trajectories"):
        fit_forest(samples, seed=0)


def test_published_figures_are_those_of_the_publication():
    rows = {(row.model, row.seconds): row for row in list_published()}
    assert rows["ctrv", 2.0].mae_m == 2.11
    assert rows["ctrv", 0.5].cell == 0.8721
    assert rows["lstm-encoder-decoder", 1.5].cell_with_forest == 0.9183
    assert len(rows) == 12


def test_cells_overlap_where_bodies_are_closer_than_the_approach_in_a_second():
    # 5 m/s slower than the ego, 30 m ahead at first; bodies of (4.6 + 4.4) / 2 = 4.5 m between the centres.
    samples = build_samples(*make_drive([{"speed": 20.0, "x_m": 30.0}], ticks=61)).samples
    assert samples.tick.tolist() == [20, 25, 30, 35, 40]
    # 30 - 0.5 t - 4.5 < 5 first at tick 42: then 30 - 21 - 4.5 = 4.5 m.
    expected = [0, 17, 12, 7, 2]
    assert find_overlaps(samples, samples.place_m).tolist() == expected
    aside = samples.place_m + np.array([0, LANE_M / 2 + 0.01])
    assert find_overlaps(samples, aside).tolist() == [0] * 5
    leaving = replace(samples, velocity_mps=-samples.velocity_mps)  # cells of 1 m: 4.5 + 1 > 30 - 0.5 t at tick 50
    assert find_overlaps(leaving, samples.place_m).tolist() == [0, 0, 20, 15, 10]


def test_warnings_are_counted_by_hand():
    samples = build_samples(*make_drive([{"speed": 20.0, "x_m": 30.0}, {"lane": 1}], ticks=61)).samples
    true = np.array([0, 17, 12, 7, 2, 0, 0, 0, 0, 0])
    own = np.array([0, 0, 14, 0, 3, 0, 5, 6, 0, 0])
    score = compare_overlaps("mine", samples, own, true)
    assert (score.n, score.trajectories, score.warned, score.true) == (10, 2, 4, 4)
    assert (score.hits, score.missed, score.false) == (2, 2, 2)
    assert score.warnings == 3
    assert score.warnings_per_hour == pytest.approx(3 / (10 * 0.5 / 3600))
    assert score.median_time_s == pytest.approx(0.55)
    assert score.median_lead_s == pytest.approx(1.2)  # first hit at tick 30, overlap at 42
    perfect = make_forecaster("straight", lambda given: predict_straight(given, 20), samples)
    assert (score_warnings(perfect, samples).missed, score_warnings(perfect, samples).false) == (0, 0)
    nothing = compare_overlaps("mine", samples.select(true < 0), own[:0], true[:0])
    assert (nothing.n, nothing.warnings_per_hour, nothing.median_lead_s) == (0, None, None)
