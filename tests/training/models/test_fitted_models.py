"""Models fitted on the training part: sums against a loop over samples, and known parameters found again."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lone_vehicles import TWO_SECONDS, observe, reveal, seeds, wander
from tensor_tables import TINY, split_row
from test_motion_models import draw_tracks, name_noise
from tiny_network import write_tiny

from tracklake.schemas.protocols import CSP
from tracklake.schemas.run_config import StaleRunError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import MODELS
from tracklake.training.models.fitting import fit_model, search, sum_moments
from tracklake.training.models.motion import DampedVelocity, KalmanConstantVelocity, count_velocity_ticks
from tracklake.training.runs.forecasters import open_forecaster
from tracklake.training.train import train

FITTED = [name for name, model in MODELS.items() if model.fitted]


class Samples:
    """Histories (S, H, 2) and their truth, gathered by number like those of a tensor folder."""

    def __init__(self, history, truth, protocol=CSP):
        self.history, self.truth, self.protocol = history, truth, protocol

    def gather(self, samples):
        chosen = self.truth.each(lambda values: values[samples])
        return mock.Mock(history=self.history[samples], future=chosen.future, future_mask=chosen.future_mask)


def sum_errors(predicted, truth):
    """A loop over samples and ticks: counts (F,) and sums of squared errors (F, 2)."""
    count, squares = np.zeros(predicted.shape[1]), np.zeros(predicted.shape[1:])
    for position, future, known in zip(predicted, truth.future, truth.future_mask, strict=True):
        for tick in np.flatnonzero(known):
            count[tick] += 1
            squares[tick] += (position[tick].astype(float) - future[tick]) ** 2
    return count, squares


@settings(max_examples=20)
@given(seeds, st.integers(1, 9), st.sampled_from([CSP, TWO_SECONDS]), st.sampled_from([1, 4, 100]))
def test_sums_give_the_errors_of_a_loop_over_samples(seed, samples, protocol, batch):
    draw = np.random.default_rng(seed)
    history, future = wander(draw, protocol, samples)
    truth = reveal(future, draw, known=0.5)
    with mock.patch("tracklake.training.models.fitting.BATCH", batch):
        order = draw.permutation(samples)
        moments = sum_moments(Samples(history, truth, protocol), order)
    ticks, steps = count_velocity_ticks(protocol), np.arange(1, protocol.horizon_ticks + 1)
    weights = np.zeros((1, len(steps), protocol.history_ticks))
    weights[0, :, -1], weights[0, :, -1 - ticks] = steps / ticks, -steps / ticks
    count, squares = sum_errors(MODELS["constant-velocity"].build(protocol).predict(observe(history)).position_m, truth)
    np.testing.assert_array_equal(moments.count, count)
    for axis in range(2):
        found = moments.sum_squared_errors(axis, weights)[0]
        np.testing.assert_allclose(found, squares[:, axis], rtol=1e-4, atol=1e-3)


@settings(max_examples=10)
@given(seeds, st.floats(0.2, 5.0))
def test_a_known_decay_is_found_again_and_no_other_is_better(seed, decay_s):
    """Lateral positions that follow the formula; then, with noise on them, the best of a plain list of times."""
    draw = np.random.default_rng(seed)
    history, future = wander(draw, CSP, 30)
    future = MODELS["damped-velocity"].build(CSP, decay_s=decay_s).predict(observe(history)).position_m
    known = reveal(future, draw)
    found = DampedVelocity.fit(CSP, sum_moments(Samples(history, known), np.arange(30)), {})
    assert found["decay_s"] == pytest.approx(decay_s, rel=0.01)
    noisy = replace(known, future=future + draw.normal(0, 0.3, future.shape).astype(np.float32))
    best = DampedVelocity.fit(CSP, sum_moments(Samples(history, noisy), np.arange(30)), {})["decay_s"]

    def measure(time_s):
        said = MODELS["damped-velocity"].build(CSP, decay_s=time_s).predict(observe(history)).position_m
        return sum_errors(said, noisy)[1][:, 1].sum()

    assert measure(best) <= min(map(measure, np.geomspace(0.01, 1000, 60).tolist())) * (1 + 1e-5)


def test_known_noise_is_found_again():
    """Tracks of 6,000 vehicles drawn from the filter's own model, whose noise is not the default."""
    noise = name_noise((0.5, 0.2), (0.3, 0.1))
    tracks = draw_tracks(np.random.default_rng(1), 6000, (0.5, 0.2), (0.3, 0.1)).astype(np.float32)
    past = CSP.history_ticks
    truth = reveal(tracks[:, past:], np.random.default_rng(2))
    moments = sum_moments(Samples(tracks[:, :past], truth), np.arange(len(tracks)))
    found = KalmanConstantVelocity.fit(CSP, moments, {})
    assert found == pytest.approx(noise, rel=0.15)
    part = KalmanConstantVelocity.fit(CSP, moments, {"measurement_lateral_m": 0.2})
    assert sorted(part) == sorted(set(noise) - {"measurement_lateral_m"}), "what is given is not fitted"
    assert part["acceleration_lateral_m2ps3"] == pytest.approx(0.1, rel=0.1)


def test_the_search_reaches_the_least_value_within_its_bounds():
    def measure(candidates):
        return (np.log(candidates / [0.3, 70.0]) ** 2).sum(axis=1)

    np.testing.assert_allclose(search(measure, (0.01, 0.01), (100, 100)), (0.3, 70.0), rtol=1e-4)
    np.testing.assert_allclose(search(measure, (0.01, 5.0), (0.1, 5.0)), (0.1, 5.0))


@pytest.mark.parametrize("name", FITTED)
def test_vehicles_that_stand_still_are_predicted_all_the_same(name):
    still = np.zeros((3, CSP.history_ticks + CSP.horizon_ticks, 2), dtype=np.float32)
    history, truth = still[:, : CSP.history_ticks], reveal(still[:, CSP.history_ticks :], np.random.default_rng(0))
    fit = fit_model(MODELS[name], Samples(history, truth), np.arange(3), {})
    said = MODELS[name].build(CSP, **fit.parameters).predict(observe(history))
    np.testing.assert_array_equal(said.position_m, 0.0)
    assert said.density is None or (said.density.sigma_m > 0).all()


def test_a_value_at_the_bound_of_the_search_is_marked():
    """Vehicles with one speed and no noise at all: the least noise that was searched is the best."""
    tracks = np.zeros((9, CSP.history_ticks + CSP.horizon_ticks, 2), dtype=np.float32)
    tracks[..., 0] = np.arange(tracks.shape[1])
    samples = Samples(tracks[:, : CSP.history_ticks], reveal(tracks[:, CSP.history_ticks :], np.random.default_rng(0)))
    fit = fit_model(MODELS["kalman-cv"], samples, np.arange(9), {"measurement_lateral_m": 0.2})
    assert fit.at_bounds == [
        "acceleration_lateral_m2ps3",
        "acceleration_longitudinal_m2ps3",
        "measurement_longitudinal_m",
    ]
    assert fit.parameters["measurement_longitudinal_m"] == pytest.approx(0.001)
    assert (fit.parameters["measurement_lateral_m"], list(fit.given)) == (0.2, ["measurement_lateral_m"])
    assert fit.to_dict()["at_bounds"] == fit.at_bounds


# Runs


@pytest.mark.parametrize("name", FITTED)
def test_a_run_holds_what_a_model_is_fitted_to_on_the_fly(name, tmp_path):
    tensors = write_tiny(tmp_path / "tensors")
    folder, parts = TensorFolder.open(tensors), frozenset({"eval"})
    opened = open_forecaster(name, folder, tmp_path, parts)
    metrics = train(name, tensors, tmp_path / name)
    assert metrics["fit"] == opened.fit.to_dict()
    assert metrics["fit"]["samples"] == len(folder.samples_of("train"))
    assert set(metrics["fit"]["parameters"]) == set(MODELS[name].parameters)
    from_run = open_forecaster(name, folder, tmp_path, parts)
    assert from_run.fit is None
    batch = observe(folder.gather(folder.samples_of("eval")).history)
    stored, fitted = (own.predictor.predict(batch).position_m for own in (from_run, opened))
    np.testing.assert_array_equal(stored, fitted)


def test_only_the_training_part_is_fitted_on(tmp_path):
    """Where `train` and `val` change places, other noise is fitted, and no run of the one is scored on the other."""
    tensors = write_tiny(tmp_path / "tensors")
    folder = TensorFolder.open(tensors)
    swapped = np.array([1, 0, 2], dtype=folder.sample_part.dtype)[folder.sample_part]
    other = replace(folder, arrays={**folder.arrays, "sample_part": swapped})
    fits = [open_forecaster("kalman-cv", own, tmp_path, frozenset({"eval"})).fit for own in (folder, other)]
    assert fits[0].parameters != fits[1].parameters
    train("damped-velocity", tensors, tmp_path / "run")
    moved = replace(other, index=other.index | {"blocks": []})
    with pytest.raises(StaleRunError, match="trained on another allocation of the split"):
        open_forecaster("run", moved, tmp_path, frozenset({"val"}))


def test_without_a_training_part_the_defaults_hold(tmp_path):
    folder = TensorFolder.open(write_tiny(tmp_path / "tensors", split_row("b", "eval"), subsets="b"))
    fit = open_forecaster("damped-velocity", folder, tmp_path, frozenset({"eval"})).fit
    assert (fit.samples, fit.parameters) == (0, {"decay_s": 1.0})
    assert TINY.name == folder.protocol.name
