"""Models of drives: constant turn rate by hand, networks that learn from the training part alone, their runs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from drive_tables import make_drive, make_traffic

from tracklake.schemas.errors import TracklakeError, UsageError
from tracklake.schemas.run_config import StaleRunError
from tracklake.training.models.prediction import NotFiniteError
from tracklake.training.onboard.models import CTRV, make_forecaster, predict_straight, predict_turns
from tracklake.training.onboard.networks import RecursiveDecoder, StackedLstm
from tracklake.training.onboard.samples import FEATURE_NUMBER, build_samples, split_samples
from tracklake.training.onboard.training import describe_run, open_model, run_network, train_network
from tracklake.training.runs.config import TrainConfig
from tracklake.training.runs.run_folder import save_run

ONE_EPOCH = TrainConfig(epochs=1, seed=3)


@pytest.fixture(scope="module")
def parts():
    return split_samples(build_samples(*make_traffic(10, ticks=60)).samples, seed=0)


def test_straight_vehicles_are_predicted_exactly():
    samples = build_samples(*make_drive([{"speed": 27.0}, {"speed": 22.0, "lane": 1}], ticks=60)).samples
    np.testing.assert_allclose(predict_straight(samples, 20), samples.place_m, atol=1e-4)
    np.testing.assert_allclose(predict_turns(samples), samples.place_m, atol=1e-4)


def test_a_turning_vehicle_stays_on_its_circle():
    samples = build_samples(*make_drive([{}], ticks=41)).samples
    speed, turn = 20.0, 0.1  # m/s, rad/s to the right: a circle of 200 m
    feature = samples.feature.copy()
    feature[0, :, FEATURE_NUMBER["rel_heading_deg"]] = np.degrees(turn * (np.arange(20) - 19) / 10)
    feature[0, :, FEATURE_NUMBER["speed_mps"]] = speed
    feature[0, :, [FEATURE_NUMBER["rel_x_m"], FEATURE_NUMBER["rel_y_m"]]] = np.array([[30.0], [2.0]])
    turning = replace(samples, feature=feature, velocity_mps=np.array([[speed - 25.0, 0.0]], np.float32))
    place_m = predict_turns(turning)[0]
    for ahead in (1, 20):
        seconds = ahead / 10
        x_m = 30 + speed / turn * math.sin(turn * seconds) - 25 * seconds
        y_m = 2 + speed / turn * (1 - math.cos(turn * seconds))
        np.testing.assert_allclose(place_m[ahead - 1], [x_m, y_m], atol=2e-4)


def test_the_spread_of_errors_is_that_of_the_training_part(parts):
    model = make_forecaster("straight", lambda samples: predict_straight(samples, 20), parts.train)
    errors = predict_straight(parts.train, 20) - parts.train.place_m
    assert model.sigma_m.shape == (20, 2)
    assert model.sigma_m[7, 0] == pytest.approx(math.sqrt((errors[:, 7, 0].astype(float) ** 2).mean()))
    with pytest.raises(NotFiniteError, match="`bad` predicts positions"):
        make_forecaster("bad", lambda samples: samples.place_m * np.nan, parts.train)


def test_a_decoder_is_fed_with_its_own_output():
    torch.manual_seed(0)
    network = RecursiveDecoder(5, width=8).eval()
    feature = torch.randn(3, 20, 12)
    with torch.no_grad():
        _, states = network.encoder(torch.relu(network.embedding(feature)))
        place = torch.zeros(3, 1, 2)
        for tick in range(5):
            out, states = network.decoder(torch.relu(network.embedding_of_place(place)), states)
            place = network.place(torch.relu(network.output(out)))
            torch.testing.assert_close(network.decode(feature)[:, tick], place[:, 0])


def test_features_are_standardised_and_constants_become_0():
    network = StackedLstm(20, width=4)
    feature = torch.randn(30, 20, 12, generator=torch.Generator().manual_seed(0)) * 5 + 3
    feature[..., 2] = 0.75
    network.standardise(feature, torch.ones(30, 20, 2))
    scaled = (feature - network.mean) / network.scale
    assert (scaled[..., 2] == 0).all()
    torch.testing.assert_close(scaled[..., 3].mean(), torch.tensor(0.0), atol=1e-4, rtol=0)
    torch.testing.assert_close(scaled[..., 3].std(correction=0), torch.tensor(1.0))


@pytest.mark.parametrize("name", ["stacked-lstm", "lstm-encoder-decoder"])
def test_a_network_learns_from_the_training_part_alone(parts, name):
    epochs = []
    network = train_network(name, parts, ONE_EPOCH, lambda share, loss: epochs.append((share, loss)))
    assert [share for share, _ in epochs] == [1.0]
    # Nothing of the evaluation part reaches weights, means or scales.
    other = replace(parts.eval, feature=parts.eval.feature + 1e6, place_m=parts.eval.place_m * np.nan)
    again = train_network(name, parts._replace(eval=other), ONE_EPOCH)
    for own, theirs in zip(network.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(own, theirs)
    # Standardised by the training part with its copies: mirrored, so that the mean across the road is 0 but for shifts.
    assert float(network.mean[FEATURE_NUMBER["box_length_m"]]) == pytest.approx(4.6)
    leaked = train_network(name, parts._replace(train=parts.eval), ONE_EPOCH)
    assert not torch.equal(network.mean, leaked.mean)


def test_runs_are_read_again_for_the_same_split_only(parts, tmp_path):
    network = train_network("stacked-lstm", parts, ONE_EPOCH)
    out = tmp_path / "stacked-lstm"
    with pytest.raises(StaleRunError, match="no trained run; run `tracklake onboard train stacked-lstm`"):
        open_model("stacked-lstm", parts, tmp_path)
    save_run(out, describe_run("stacked-lstm", parts, ONE_EPOCH), {"evaluation": None}, network)
    model = open_model("stacked-lstm", parts, tmp_path)
    np.testing.assert_array_equal(model.predict(parts.eval), run_network(network, parts.eval))
    with pytest.raises(StaleRunError, match="trained on other drives"):
        open_model("stacked-lstm", parts._replace(digest="other"), tmp_path)
    (out / "weights.pt").write_bytes(b"no weights")
    with pytest.raises(StaleRunError, match="damaged"):
        open_model("stacked-lstm", parts, tmp_path)


def test_models_that_do_not_learn_or_exist_are_refused(parts, tmp_path):
    assert open_model(CTRV, parts, tmp_path).name == CTRV
    with pytest.raises(UsageError, match="expected one of stacked-lstm, lstm-encoder-decoder"):
        open_model("lstm", parts, tmp_path)
    with pytest.raises(UsageError, match="ctrv needs no training"):
        train_network(CTRV, parts, ONE_EPOCH)
    with pytest.raises(TracklakeError, match="learning rate below"):
        train_network("stacked-lstm", parts, TrainConfig(epochs=3, learning_rate=1e30))
