"""Pictures against numbers known by hand; and what models get before the future is read."""

import json

import numpy as np
import pytest
from drawn_moment import FAR, FAR_SAMPLE, NEAR, OWN, OWN_SAMPLE, PLACES, SIZES_M, open_moment, sure
from lane_tracks import open_tracks, track

from tracklake.pipeline.cli.sample_choice import measure_last_distance
from tracklake.training.data.observed import FutureInputError, ObservedScene
from tracklake.training.models.prediction import Density, NotFiniteError, Prediction
from tracklake.training.plots.picture import forecast_samples, forecast_scene, take_picture
from tracklake.training.plots.picture_drawing import describe_marks, draw_picture
from tracklake.training.plots.picture_rows import choose_view, list_errors
from tracklake.training.runs.forecasters import Forecaster, UnknownRunError, open_forecaster


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return open_moment(tmp_path_factory.mktemp("moment"))


def places(vehicle, *ticks):
    return [list(map(float, PLACES[vehicle][tick])) for tick in ticks]


def test_a_picture_holds_what_stood_on_the_road(folder):
    picture = take_picture(folder, OWN_SAMPLE, {})
    assert (picture.dataset, picture.subset, picture.time_s, picture.rate_hz) == ("highd", "b", 1.0, 2)
    assert (picture.sample, picture.part, picture.split) == (0, "eval", "mine")
    assert (picture.lateral, picture.longitudinal) == ("left", "normal")
    assert (picture.markings_m, picture.marked) == ((0.0, 4.0, 8.0), True)
    assert [(one.vehicle_id, one.role, one.sample) for one in picture.vehicles] == [
        (OWN, "own", OWN_SAMPLE),
        (NEAR, "neighbor", -1),
        (FAR, "other", FAR_SAMPLE),
    ]
    own, near, far = picture.vehicles
    assert own.history_m.tolist() == places(OWN, 0, 1, 2)
    assert own.future_m.tolist() == places(OWN, 3, 4, 5, 6)
    assert near.history_m.tolist() == places(NEAR, 1, 2), "its track began later"
    assert near.future_m.tolist() == places(NEAR, 3, 4), "its track ended before the horizon"
    assert far.future_m.tolist() == places(FAR, 3)
    for one in (own, near):
        assert (one.length_m, one.width_m) == pytest.approx(SIZES_M[one.vehicle_id])
    assert np.isnan([far.length_m, far.width_m]).all()


def test_the_sample_drawn_comes_first_and_neighbors_are_its_own(folder):
    picture = take_picture(folder, FAR_SAMPLE, {})
    assert [(one.vehicle_id, one.role) for one in picture.vehicles] == [(FAR, "own"), (OWN, "other"), (NEAR, "other")]
    assert picture.longitudinal == "brake"


def test_rounded_positions_are_drawn_where_they_were(folder, tmp_path):
    exact = take_picture(folder, OWN_SAMPLE, {})
    rounded = take_picture(open_moment(tmp_path, storage="int16-decimetres"), OWN_SAMPLE, {})
    for one, other in zip(exact.vehicles, rounded.vehicles, strict=True):
        np.testing.assert_allclose(one.history_m, other.history_m, atol=0.051)
        np.testing.assert_allclose(one.future_m, other.future_m, atol=0.051)


def test_lanes_without_markings_are_nominal(tmp_path):
    picture = take_picture(open_moment(tmp_path, markings=None), OWN_SAMPLE, {})
    assert picture.markings_m == pytest.approx((0.0, 12 * 0.3048, 24 * 0.3048))
    assert not picture.marked


def test_errors_across_the_road_are_unknown_where_lateral_positions_are_lane_centres(tmp_path):
    folder = open_moment(tmp_path)
    for subset in folder.index["subsets"]:
        subset["lateral_positions"] = "lane centres"
    model = sure()
    found = forecast_samples(folder, [OWN_SAMPLE], [model])
    picture = take_picture(folder, OWN_SAMPLE, {OWN: found[OWN_SAMPLE]})
    assert picture.to_dict()["lane_centred"]
    truth = [x for x, _ in places(OWN, 3, 4, 5, 6)]
    rows = list_errors(picture)
    assert [row["along_m"] for row in rows] == [x - true for x, true in zip((31, 42, 53, 64), truth, strict=True)]
    assert all(row[name] is None for row in rows for name in ("distance_m", "across_m", "across_sigma_m"))
    assert "lateral positions are lane centres" in describe_marks(picture, choose_view(picture))[0]
    drawn = draw_picture(picture).render(".svg").decode()
    assert "true, along the road (m)" in drawn
    assert not any(text in drawn for text in ("true, across the road (m)", "distance from the truth (m)"))
    (far,) = measure_last_distance(folder, np.array([OWN_SAMPLE]), model)
    assert far == abs(64 - truth[-1])


def test_forecasts_stand_on_the_carriageway(folder):
    """Constant velocity goes on 10 m a tick along lane 2; the other mixes two alternatives, the likelier first."""
    straight = open_forecaster("constant-velocity", folder, folder.path, frozenset({"eval"}))
    found = forecast_samples(folder, [OWN_SAMPLE], [straight, sure()])[OWN_SAMPLE]
    assert [forecasts.model for forecasts in found] == ["constant-velocity", "sure"]
    assert found[0].position_m.tolist() == [[30, 6], [40, 6], [50, 6], [60, 6]]
    assert (found[0].alternatives, found[0].lateral) == ((), None)
    assert found[1].position_m.tolist() == [[31, 6], [42, 6], [53, 6], [64, 6]]
    goes, stays = found[1].alternatives
    assert (goes.probability, stays.probability) == (0.75, 0.25)
    assert goes.mean_m.tolist() == found[1].position_m.tolist()
    assert stays.mean_m.tolist() == [[20, 6]] * 4
    assert goes.sigma_m.tolist() == [[2, 1]] * 4
    assert goes.correlation == pytest.approx([0.6] * 4)
    assert found[1].lateral == {"keep": 0.5, "left": 0.375, "right": 0.125}
    assert found[1].longitudinal == {"normal": 0.75, "brake": 0.25}


def test_every_sample_of_the_moment_is_predicted_in_one_batch(folder):
    model = sure()
    found = forecast_scene(folder, OWN_SAMPLE, [model])
    assert {vehicle: forecasts[0].position_m.tolist()[0] for vehicle, forecasts in found.items()} == {
        OWN: [31, 6],
        FAR: [111, 2],
    }
    assert [len(observed.history) for observed in model.predictor.seen] == [2]
    picture = take_picture(folder, OWN_SAMPLE, found)
    assert [len(one.forecasts) for one in picture.vehicles] == [1, 0, 1]
    assert picture.models == ("sure",)


class SceneModel:
    """A model of scenes: every vehicle moves 7 m a tick; variances 4 and 9 m2, covariance 3 m2."""

    def __init__(self):
        self.seen = []

    def limit(self, observed):
        return observed

    def predict_vehicles(self, observed):
        assert type(observed) is ObservedScene
        self.seen.append(observed)
        last = observed.history[observed.vehicle_mask][:, -1:]
        moved = np.zeros((len(last), 4, 2), np.float32)
        moved[..., 0] = 7 * np.arange(1, 5)
        sigma = np.broadcast_to(np.float32([2, 3]), (len(last), 1, 4, 2))
        density = Density(np.ones((len(last), 1)), (last + moved)[:, None], sigma, np.full((len(last), 1, 4), 0.5))
        return Prediction(last + moved, density)


def test_a_model_of_scenes_predicts_all_vehicles_at_once(folder):
    model = SceneModel()
    found = forecast_scene(folder, OWN_SAMPLE, [Forecaster("scene-model", model, "scene"), sure()])
    assert len(model.seen) == 1
    assert {vehicle: [one.model for one in forecasts] for vehicle, forecasts in found.items()} == {
        OWN: ["scene-model", "sure"],
        NEAR: ["scene-model"],
        FAR: ["scene-model", "sure"],
    }
    for vehicle, (x_m, y_m) in ((OWN, (20, 6)), (NEAR, (25, 2)), (FAR, (100, 2))):
        forecasts = found[vehicle][0]
        assert forecasts.position_m.tolist() == [[x_m + 7 * tick, y_m] for tick in range(1, 5)]
        [only] = forecasts.alternatives
        assert only.sigma_m.tolist() == [[2, 3]] * 4
        assert only.correlation == pytest.approx([0.5] * 4)


def test_a_model_of_scenes_predicts_the_whole_scene(tmp_path):
    """Vehicles 0 to 13, each 7 m behind the one before, more than a model of scenes gets in training."""
    rows = [row for number in range(14) for row in track(number, [2.0] * 8, x_m=[90 - 7 * number] * 8)]
    crowd, model = open_tracks(tmp_path / "t", {"a": rows}), SceneModel()
    found = forecast_scene(crowd, 0, [Forecaster("scene-model", model, "scene")])
    assert {vehicle: forecasts[0].position_m[0].tolist() for vehicle, forecasts in found.items()} == {
        number: [90 - 7 * number + 7, 2] for number in range(14)
    }
    assert model.seen[0].vehicle_mask.tolist() == [[True] * 14]


class FutureReader:
    def predict(self, observed):
        return Prediction(observed.future)


class NotFinite:
    def predict(self, observed):
        return Prediction(np.full((len(observed.history), 4, 2), np.nan, np.float32))


def test_models_do_not_get_the_future(folder):
    with pytest.raises(FutureInputError, match="`future` is not known when a model predicts"):
        forecast_samples(folder, [OWN_SAMPLE], [Forecaster("curious", FutureReader(), "grid")])


def test_places_that_are_no_numbers_are_refused(folder):
    with pytest.raises(NotFiniteError, match="`nan` predicts positions that are not finite numbers"):
        forecast_samples(folder, [OWN_SAMPLE], [Forecaster("nan", NotFinite(), "grid")])


def test_the_numbers_drawn_are_plain(folder):
    forecasts = forecast_samples(folder, [OWN_SAMPLE], [sure()])
    table = json.loads(
        json.dumps(take_picture(folder, OWN_SAMPLE, {OWN: forecasts[OWN_SAMPLE]}).to_dict(), allow_nan=False)
    )
    own, near, far = table["vehicles"]
    assert (table["sample"], table["time_s"], table["markings_m"]) == (OWN_SAMPLE, 1.0, [0, 4, 8])
    assert own["truth_m"] == places(OWN, 3, 4, 5, 6)
    assert own["predictions"][0]["alternatives"][1]["mean_m"] == [[20, 6]] * 4
    assert own["predictions"][0]["alternatives"][0]["sigma_m"] == [[2, 1]] * 4
    assert (near["sample"], near["predictions"]) == (None, [])
    assert (far["length_m"], far["width_m"]) == (None, None)


@pytest.mark.parametrize("number", [-1, 2])
def test_numbers_of_no_sample_are_refused(folder, number):
    with pytest.raises(IndexError, match=f"samples are numbered 0 to 1, got {number}"):
        take_picture(folder, number, {})


def test_unknown_names_are_answered_with_the_known_ones(folder, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "config.json").touch()
    with pytest.raises(
        UnknownRunError,
        match=r"no run or model `cv` .did you mean ctrv.*: expected one of the runs mine, or of .*constant-velocity",
    ):
        open_forecaster("cv", folder, tmp_path, frozenset({"eval"}))
    with pytest.raises(UnknownRunError, match="run `tracklake train lstm` first"):
        open_forecaster("lstm", folder, tmp_path, frozenset({"eval"}))
