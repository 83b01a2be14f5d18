"""Feasibility of hand-made scenes, with counts worked out by hand, and of the truth itself."""

import numpy as np
import polars as pl
import pytest
from tensor_tables import CLOCK, TINY, split_row, write

from tracklake.schemas.comparisons import FEASIBILITY
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.training.comparison import feasibility
from tracklake.training.comparison.feasibility import measure_feasibility
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models.motion import ConstantVelocity
from tracklake.training.models.prediction import Prediction
from tracklake.training.runs.forecasters import Forecaster

MARKINGS = (0.0, 4.0, 8.0)
"""Two lanes, their centres at 2 and 6 m."""


def make_folder(path, vehicles):
    """Subset b at 2 Hz: vehicles by id with places (x, y) at ticks 0 to 6, each a sample at tick 2.

    Of the helper's sizes, vehicle k is 4 + k / 10 m long and 1.5 + k / 100 m wide, and of unknown size where k is a
    multiple of 5.
    """
    rows = [
        (vehicle, tick, 1 + 5 * tick, x_m, y_m, 1, 20.0, vehicle)
        for vehicle, places in vehicles.items()
        for tick, (x_m, y_m) in enumerate(places)
    ]
    samples = [("tiny", "highd", "b", vehicle, 2, 11, 1, "keep", "normal", None) for vehicle in vehicles]
    clock = pl.DataFrame(rows, schema=CLOCK, orient="row")
    nothing = ("a", pl.DataFrame(schema=CLOCK), SAMPLES.empty(), NEIGHBORS.empty())
    own = ("b", clock, pl.DataFrame(samples, schema=SAMPLES.dtypes, orient="row"), NEIGHBORS.empty())
    splits = pl.concat([split_row("a", "train"), split_row("b", "eval")])
    return TensorFolder.open(write(path, [nothing, own], splits, markings=list(MARKINGS)))


def drive(x_m, y_m, *, step_m=10.0, ticks=7, aside_m=0.0):
    """Places at constant velocity; it drifts aside from tick 2 on."""
    return [(x_m + step_m * tick, y_m + aside_m * max(tick - 2, 0)) for tick in range(ticks)]


class Says:
    """Predicts given places (S, F, 2), relative to the last one, for the samples in their order."""

    def __init__(self, places):
        self.places = np.asarray(places, dtype=np.float32)

    def predict(self, observed):
        return Prediction(self.places[: len(observed.history)])


def shares(folder, predictor, seconds=2.0):
    table = FEASIBILITY.validate(
        measure_feasibility(Forecaster("mine", predictor, "grid"), folder, "eval"), where="here"
    )
    rows = table.filter(seconds=seconds).to_dicts()
    return {row["rule"]: row for row in rows}


def along(*steps_m, y_m=0.0):
    """Places at four ticks after so many metres each."""
    return [(float(x), y_m) for x in np.cumsum(steps_m)]


def test_vehicles_that_keep_their_velocity_break_nothing(tmp_path):
    folder = make_folder(tmp_path, {1: drive(0, 2), 2: drive(50, 2), 3: drive(0, 6)})
    found = shares(folder, ConstantVelocity(TINY))
    assert [
        (row["share"], row["true_share"], row["scene_share"], row["true_scene_share"]) for row in found.values()
    ] == [(0, 0, 0, 0)] * 5
    assert {(row["n"], row["scenes"], round(row["rmse_m"], 6)) for row in found.values()} == {(3, 1, 0.0)}


def test_a_predicted_collision_by_hand(tmp_path):
    # 2 is 15 m ahead of 1 (length 4.2 m: a gap of 10.8 m). It is predicted to drive 5, 5, 10 and 10 m a tick, 1 to
    # drive 10 m: gaps of 5.8, 0.8, 0.8 and 0.8 m. With 4 m less in the last tick the gap is -3.2 m:
    # both overlap, 1 follows.
    folder = make_folder(tmp_path, {1: drive(0, 2), 2: drive(15, 2), 3: drive(0, 6)})
    straight = along(10, 10, 10, 10)
    near = shares(folder, Says([straight, along(5, 5, 10, 10), straight]))
    assert (near["overlap"]["share"], near["negative_headway"]["share"]) == (0, 0)
    hit = shares(folder, Says([straight, along(5, 5, 10, 6), straight]))
    assert hit["overlap"]["share"] == pytest.approx(2 / 3)
    assert hit["negative_headway"]["share"] == pytest.approx(1 / 3)
    assert (hit["overlap"]["scene_share"], hit["overlap"]["true_share"]) == (1, 0)
    assert hit["any"]["share"] == pytest.approx(2 / 3)
    before = shares(folder, Says([straight, along(5, 5, 10, 6), straight]), seconds=1.0)
    assert before["overlap"]["share"] == 0, "the last tick is 2 s ahead"


def test_vehicles_beside_each_other_have_no_headway(tmp_path):
    folder = make_folder(tmp_path, {1: drive(0, 2), 3: drive(0, 6)})
    found = shares(folder, Says([along(10, 10, 10, 10), along(10, 10, 10, 10, y_m=-2.1)]))
    # 3 moves to 3.9 m: in lane 1 beside 1, whose side is at 2.755 m; the side of 3 is at 3.9 - 0.765 = 3.135 m.
    assert found["overlap"]["share"] == 0
    assert found["negative_headway"]["share"] == pytest.approx(1 / 2), "abreast in one lane"


def test_leaving_the_road_by_hand(tmp_path):
    folder = make_folder(tmp_path, {1: drive(0, 2, aside_m=-1.0), 3: drive(0, 6), 4: drive(100, 6)})
    # True: 1 is at 1, 0, -1 and -2 m: beside the road from the third tick (1.5 s) on.
    straight = along(10, 10, 10, 10)
    found = shares(folder, Says([straight, along(10, 10, 10, 10, y_m=2.01), along(10, 10, 10, 10, y_m=2.0)]))
    assert (found["off_road"]["share"], found["off_road"]["true_share"]) == (pytest.approx(1 / 3), pytest.approx(1 / 3))
    assert shares(folder, Says([straight] * 3), seconds=1.0)["off_road"]["true_share"] == 0


@pytest.mark.parametrize(("step_m", "broken"), [(11.87, 0), (11.88, 1)])
def test_jerk_where_a_prediction_begins(tmp_path, step_m, broken):
    # At 2 Hz a step of 10 + d m after steps of 10 m is a jerk of 8 d m/s3 at the first tick: 14.96 and 15.04.
    # The steps that follow grow by d each, so that later jerks are 0.
    folder = make_folder(tmp_path, {1: drive(0, 2)})
    more = step_m - 10
    found = shares(folder, Says([along(*(10 + more * tick for tick in range(1, 5)))]))
    assert found["high_jerk"]["share"] == broken
    assert (found["high_jerk"]["low"], found["high_jerk"]["true_share"]) == (None, 0)


def test_nothing_leaves_the_road_where_lateral_positions_are_lane_centres(tmp_path):
    folder = make_folder(tmp_path, {1: drive(0, 6)})
    folder.index["subsets"][1]["lateral_positions"] = "lane centres"
    found = shares(folder, Says([np.column_stack([10.0 * np.arange(1, 5), np.full(4, 3.0)])]))
    assert set(found) == {"overlap", "negative_headway", "high_jerk", "any"}
    assert (found["any"]["share"], found["any"]["rmse_m"]) == (0, None)


def test_only_known_ticks_are_judged(tmp_path):
    folder = make_folder(tmp_path, {1: drive(0, 2), 2: drive(15, 2, ticks=5)})
    found = shares(folder, Says([along(10, 10, 10, 10), along(10, 10, -40, 10)]))
    assert (found["overlap"]["share"], found["high_jerk"]["share"]) == (0, 0)


def test_batches_change_nothing(tmp_path, monkeypatch):
    vehicles = {number: drive(12.0 * number, 2 + 4 * (number % 2), aside_m=0.3 * number) for number in range(1, 9)}
    folder = make_folder(tmp_path, vehicles)
    model = Forecaster("mine", ConstantVelocity(TINY), "grid")
    expected = measure_feasibility(model, folder, "eval")
    assert expected["true_share"].max() > 0
    monkeypatch.setattr(feasibility, "BATCH_SIZE", 1)
    assert measure_feasibility(model, folder, "eval").equals(expected)
