"""Cells by hand; and scores of models of which it is known where they are right."""

import json
import re
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lane_tracks import CODES, SHORT, open_tracks, track
from sklearn.ensemble import RandomForestClassifier

from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.lane_forest import LEFT_OUT, STRATA
from tracklake.schemas.run_config import StaleRunError
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.observed import FutureInputError
from tracklake.training.lane_changes.cells import find_columns, find_rows, measure_rows, number_cells
from tracklake.training.lane_changes.examples import LaneForestSettings, label_samples
from tracklake.training.lane_changes.forest import LaneForest, fit_lane_forest
from tracklake.training.lane_changes.scores import evaluate_grid, learn_curve
from tracklake.training.models.motion import ConstantVelocity
from tracklake.training.models.prediction import Prediction
from tracklake.training.runs.forecasters import Forecaster

LANES = np.array([[[-3.5, 3.0, 1], [0.5, 4.0, 1], [4.5, 4.0, 1]]], np.float32)
"""The own lane reaches from -1.5 to 2.5 m; so one lane's width to the left ends at -5.5 m, to the right at 6.5 m."""


def test_columns_by_hand():
    side = np.array([[-5.51, -5.5, -1.51, -1.5, 0.0, 2.49, 2.5, 6.49, 6.5, 99.0]])
    assert find_columns(side, LANES).tolist() == [[-2, -1, -1, 0, 0, 0, 1, 1, 2, 2]]
    assert find_columns(side[:, 0], LANES).tolist() == [-2], "one place of each"
    unknown = np.zeros((1, 3, 3), np.float32)
    half = NOMINAL_LANE_M / 2
    around = np.array([[-half - 0.01, -half + 0.01, half - 0.01, half + 0.01]])
    assert find_columns(around, unknown).tolist() == [[-1, 0, 0, 1]]


def test_rows_by_hand():
    """Rows of 4 m around 50 m, of 1 m around -3 m."""
    along = np.array([[43.9, 44.1, 47.9, 48.0, 51.9, 52.1, 55.9, 56.1], [-4.6, -4.4, -3.6, -3.5, -2.6, -2.4, -1.6, 9]])
    middle = np.repeat([[50.0], [-3.0]], 8, axis=1)
    rows = find_rows(along, middle, np.array([4, 1], np.float32))
    assert rows.tolist() == [[-2, -1, -1, 0, 0, 1, 1, 2]] * 2


def test_a_row_is_what_the_relative_speed_makes_in_a_second():
    speed, ego = np.array([0.3, 7.0, -7.0, 7.0], np.float32), np.array([1, 1, 1, 0])
    assert measure_rows(speed, ego).tolist() == [1, 7, 7, 1]


@given(st.integers(-2, 2), st.integers(-2, 2))
def test_cells_are_numbered_lane_by_lane(column, row):
    names = [(c, r) for c in (-1, 0, 1) for r in (-1, 0, 1)]
    expected = names.index((column, row)) if (column, row) in names else -1
    assert number_cells(np.array([column], np.int8), np.array([row], np.int8)).tolist() == [expected]


def constant_forest(*codes, horizons_s=(0.5, 1.0, 2.0), start_s=2.0):
    """A forest of one leaf: for every target the same maneuver, and the same lane at each horizon."""
    classifier = RandomForestClassifier(n_estimators=1, random_state=0)
    classifier.fit(np.zeros((2, 1)), [[CODES[code] for code in codes]] * 2)
    facts = {
        "settings": {"start_s": start_s, "tolerance_m": 0.1},
        "blocks": [],
        "train_subsets": ["highd/another"],
    }
    return LaneForest(classifier, ("speed_mps",), 2, horizons_s, facts)


STRAIGHT = Forecaster("straight", ConstantVelocity(SHORT))


class Says:
    """A model that says the same of everyone: so far along and across at each of the ticks."""

    def __init__(self, along_m, across_m):
        self.place_m = np.stack(np.broadcast_arrays(along_m, across_m), axis=-1).astype(np.float32)

    def predict(self, observed):
        return Prediction(np.repeat(self.place_m[None], len(observed.history), axis=0))


@pytest.fixture
def one_change(tmp_path):
    """A vehicle at 20 m/s that changes to the right; the one who follows it keeps its lane at 18 m/s.

    The samples of the first: ticks 2 to 6, for the horizon of four ticks, T_d, and its ten rows. It crosses the
    marking at tick 5. One sample of the second stands beside each.
    """
    leader = track(1, [2, 2, 2, 2, 3, 5, 6, 6, 6, 6, 6], x_m=[30 + 10 * tick for tick in range(11)])
    follower = track(2, [2] * 11, x_m=[9 * tick for tick in range(11)])
    return open_tracks(tmp_path / "t", {"a": leader + follower}, parts={"a": "eval"})


def by_key(scores, **key):
    (found,) = [row for row in scores.cells if all(getattr(row, name) == value for name, value in key.items())]
    return found


def test_scores_by_hand(one_change):
    """At 0.5, 1 and 2 s, which are 1, 2 and 4 ticks.

    The leader's true columns, seen from its lane at ticks 2 to 6: own own right own own; own right right own own; right
    right right own own. Constant velocity goes on with the last step across, 0 0 1 2 1 m: to 2 2 4 7 7 m, of which 4 m
    is the right lane's already: all five right; to 2 2 5 9 8 m: two right; to 2 2 7 13 10 m: one, and 13 m is outside.
    The forest says own, right, right: of the leader 4, 2 and 3 are so, of the follower 5, 0 and 0.

    Along the road everybody keeps his speed, so that the true row is the middle one. The leader is at 10, 20 and 40 m,
    in rows of 2 m (20 less 18 m/s); the follower at 9, 18 and 36 m, in rows of 1 m, for it has no follower.
    """
    models = [STRAIGHT, Forecaster("short", Says([9.2, 17.2, 27, 36], 0.0))]
    scores = evaluate_grid(one_change, models, constant_forest("r", "k", "r", "r"))
    assert scores.left_out == 2 * 3, "ticks 7, 8 and 9"
    assert scores.left_out_by_reason == dict(zip(LEFT_OUT, (0, 6, 0, 0), strict=True))
    assert len(scores.cells) == 2 * 2 * 3 * 5
    own_columns, forest_columns = {0.5: 5 + 5, 1.0: 2 + 5, 2.0: 1 + 5}, {0.5: 4 + 5, 1.0: 2, 2.0: 3}
    short_rows = {0.5: 5 + 5, 1.0: 0, 2.0: 5}
    for seconds in (0.5, 1.0, 2.0):
        row = by_key(scores, model="straight", column="place", seconds=seconds, stratum="all")
        assert (row.n, row.row, row.lane, row.outside) == (10, 1.0, own_columns[seconds] / 10, 0.0)
        assert row.cell == row.lane
        row = by_key(scores, model="straight", column="forest", seconds=seconds, stratum="all")
        assert (row.row, row.lane, row.cell) == (1.0, *[forest_columns[seconds] / 10] * 2)
        row = by_key(scores, model="short", column="forest", seconds=seconds, stratum="all")
        assert (row.row, row.lane) == (short_rows[seconds] / 10, forest_columns[seconds] / 10)
    row = by_key(scores, model="short", column="forest", seconds=2.0, stratum="all")
    assert row.cell == 0, "the follower's row is right, his column is not; the leader's the other way round"
    row = by_key(scores, model="straight", column="place", seconds=2.0, stratum="all")
    assert (row.majority, row.own_lane) == (0.7, 0.7), "own lane, middle row: two of the leader's, five others"

    # The label: the centre is reached at tick 6, T_d is four ticks: all samples of the leader; the forest says right.
    everyone = scores.maneuvers[0]
    assert (everyone.n, everyone.accuracy, everyone.balanced, everyone.majority) == (10, 0.5, 0.5, 0.5)
    assert everyone.recall == {"keep": 0.0, "left": None, "right": 1.0}
    counts = dict(zip(("all", *STRATA), (10, 5, 5, 0, 0), strict=True))
    assert {row.stratum: row.n for row in scores.maneuvers} == counts
    empty = by_key(scores, model="straight", column="place", seconds=2.0, stratum="decelerating, changing")
    assert (empty.n, empty.cell, empty.majority) == (0, None, None)
    json.dumps(asdict(scores), allow_nan=False)


def test_a_true_place_outside_is_never_right(tmp_path):
    """It brakes after tick 2 so hard that it is far behind; a model that says so is right along, and in no cell."""
    x_m = [0, 10, 20, 21, 22, 23, 24, 25, 26, 27, 28]
    folder = open_tracks(tmp_path / "t", {"a": track(1, [2] * 11, x_m=x_m)}, parts={"a": "eval"})
    judged = label_samples(folder, "eval", LaneForestSettings(start_s=2.0))
    assert len(judged.sample) == 5
    scores = evaluate_grid(folder, [Forecaster("knows", Says([1, 2, 3, 4], 0.0))], constant_forest("k", "k", "k", "k"))
    for seconds in (0.5, 1.0, 2.0):
        row = by_key(scores, model="knows", column="place", seconds=seconds, stratum="all")
        # Of five samples the first is outside; the later ones have 2 m a tick, or one, and are where they are said.
        assert (row.outside, row.cell, row.row, row.lane) == (0.2, 0.8, 0.8, 1.0)
        assert row.cell_clipped == 1.0, "behind, were that row without end"
        assert row.majority == 0.8


class SaysNothing:
    def predict(self, observed):
        return Prediction(np.full((len(observed.history), 4, 2), np.nan, np.float32))


class Short:
    def predict(self, observed):
        return Prediction(np.zeros((len(observed.history), 3, 2), np.float32))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (SaysNothing(), r"`wrong`.* not finite numbers"),
        (Says([9, 18, 27, np.inf], 0.0), r"`wrong`.* not finite numbers"),
        (Short(), r"expected places of shape \(10, 4, 2\), got \(10, 3, 2\)"),
    ],
)
def test_places_that_are_none_are_refused_or_their_model_is_skipped(one_change, model, message):
    """A cell of NaN would be the middle one."""
    forest, wrong = constant_forest("k", "k", "k", "k"), Forecaster("wrong", model)
    with pytest.raises(TracklakeError, match=message):
        evaluate_grid(one_change, [wrong], forest)
    reported = []
    scores = evaluate_grid(
        one_change, [wrong, STRAIGHT], forest, on_skip=lambda name, why: reported.append((name, why))
    )
    [(name, why)] = reported
    assert (name, re.search(message, why) is not None) == ("wrong", True)
    assert scores == evaluate_grid(one_change, [STRAIGHT], forest)


def test_who_sees_the_future_is_found_out(one_change):
    class Peeks:
        def predict(self, observed):
            return Prediction(np.zeros((len(observed.history), 4, 2), np.float32) + one_change.position_m[-1, 0])

    reported = {}
    scores = evaluate_grid(
        one_change, [Forecaster("peeks", Peeks())], constant_forest(*"kkkk"), on_skip=reported.__setitem__
    )
    assert (scores.cells, list(reported)) == ([], ["peeks"])
    assert "`peeks` sees the future" in reported["peeks"]
    with pytest.raises(FutureInputError, match="`peeks` sees the future"):
        evaluate_grid(one_change, [Forecaster("peeks", Peeks())], constant_forest("k", "k", "k", "k"))


def test_a_forest_that_sees_the_future_is_found_out(one_change):
    class Peeks(LaneForest):
        def predict_proba(self, described):
            return super().predict_proba(described) + np.float32(one_change.position_m[-1, 0])

    with pytest.raises(FutureInputError, match="`lane-forest` sees the future"):
        evaluate_grid(one_change, [], Peeks(**vars(constant_forest("k", "k", "k", "k"))))


def test_a_forest_for_others_is_refused(one_change):
    with pytest.raises(TracklakeError, match=r"fitted at 2 Hz for horizons of \(0.5, 1.0, 3.0\) s; .* Fit it again"):
        evaluate_grid(one_change, [], constant_forest("k", "k", "k", "k", horizons_s=(0.5, 1.0, 3.0)))
    knows = constant_forest("k", "k", "k", "k")
    knows.facts["train_subsets"] = ["highd/a"]
    with pytest.raises(StaleRunError, match=r"highd/a\) were in its training part"):
        evaluate_grid(one_change, [], knows)


def test_a_part_without_samples_has_no_scores(one_change):
    scores = evaluate_grid(one_change, [STRAIGHT], constant_forest(*"kkkk"), part="train")
    assert (scores.cells, scores.left_out) == ([], 0)
    assert scores.maneuvers[0].n == 0
    assert scores.maneuvers[0].accuracy is None


@pytest.fixture(scope="module")
def busy(tmp_path_factory):
    """Two recordings in which some change lanes, at a random moment."""
    draw = np.random.default_rng(2)
    subsets = {}
    for name in ("a", "b"):
        subsets[name] = []
        for vehicle_id in range(12):
            way = np.clip((np.arange(24) - draw.integers(5, 12)) / 6, 0, 1) * (vehicle_id % 3 - 1)
            y_m = 6 + 4 * np.sign(way) * (3 - 2 * np.abs(way)) * way**2 + draw.normal(scale=0.03, size=24)
            subsets[name] += track(vehicle_id, y_m.tolist(), speed_mps=draw.uniform(10, 20))
    return open_tracks(tmp_path_factory.mktemp("busy") / "t", subsets, parts={"b": "eval"})


SMALL = LaneForestSettings(start_s=3.0, trees=6, leaf=3)


def test_a_drawn_part_is_scored_in_part(busy):
    forest = fit_lane_forest(busy, 0, SMALL)
    everything = evaluate_grid(busy, [], forest)
    drawn = [evaluate_grid(busy, [], forest, most=20, seed=seed).maneuvers[0] for seed in (1, 1, 2)]
    assert everything.maneuvers[0].n > 50
    assert [score.n for score in drawn] == [20] * 3
    assert drawn[0] == drawn[1]


def test_the_learning_curve(busy):
    points = learn_curve(busy, sizes=(20, 60, 10**6), seeds=(0, 1), settings=SMALL)
    counts = label_samples(busy, "train", SMALL).count_strata()
    assert (counts[:2] > 0).tolist() == [True, True], "everybody keeps his speed: two of the strata are empty"
    assert not counts[2:].any()
    pool = 2 * min(counts[:2])
    assert 60 < pool < sum(counts)
    truth = label_samples(busy, "eval", SMALL)
    sizes = sorted({(point.drawn, point.augmented, point.seed) for point in points})
    assert sizes == [(size, more, seed) for size in (20, 60, pool) for more in (False, True) for seed in (0, 1)]
    assert {point.n for point in points} == {len(truth.sample)}
    assert {point.majority for point in points} == {np.bincount(truth.maneuver).max() / len(truth.sample)}
    largest = [point.accuracy for point in points if point.drawn == pool]
    assert min(largest) > points[0].majority
    assert learn_curve(busy, sizes=(20, 60, 10**6), seeds=(0, 1), settings=SMALL) == points
    never = replace(SMALL, augmentation=())
    assert {point.augmented for point in learn_curve(busy, sizes=(60,), seeds=(0,), settings=never)} == {False}


def test_no_curve_without_an_evaluation_part(tmp_path):
    folder = open_tracks(tmp_path / "t", {"a": track(1, [2.0] * 20)})
    with pytest.raises(
        TracklakeError, match=r"split `mine` has no samples in `eval` \(samples: train .*; add recordings, or"
    ):
        learn_curve(folder, settings=SMALL)
    brief = {"a": track(1, [2.0] * 20), "b": track(1, [2.0] * 5)}
    folder = open_tracks(tmp_path / "brief", brief, parts={"b": "eval"})
    with pytest.raises(TracklakeError, match=r"no sample of eval has a lane and a track"):
        learn_curve(folder, settings=SMALL)
