"""Choi et al. (2021) as published on overhead tracks: samples by hand and by a loop, both grids, both forests."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from grid_tracks import GRID, RATE_HZ, drive_track, open_busy_road
from lane_tracks import open_tracks, track
from typer.testing import CliRunner

from tracklake.pipeline.cli.app import app
from tracklake.schemas.errors import TracklakeError
from tracklake.training.lane_changes.cells import OUTSIDE
from tracklake.training.lane_changes.examples import LaneForestSettings, label_samples
from tracklake.training.lane_changes.scores import score_cells
from tracklake.training.onboard.as_published import (
    CONSTANT,
    DECODER,
    DIFFERENCE,
    GRIDS,
    OURS,
    PUBLISHED,
    number_vehicles,
    score_published,
)
from tracklake.training.onboard.maneuvers import fit_forest
from tracklake.training.onboard.models import predict_straight, predict_turns
from tracklake.training.onboard.networks import RecursiveDecoder
from tracklake.training.onboard.overhead import build_overhead, find_road_cells
from tracklake.training.onboard.samples import FEATURE_NUMBER, FEATURES, split_samples
from tracklake.training.onboard.training import Watch, run_network, train_network
from tracklake.training.runs.config import TrainConfig

SETTINGS = LaneForestSettings(start_s=1.0, examples=200, trees=5, leaf=3)


def build(folder):
    return build_overhead(folder, label_samples(folder, None, SETTINGS))


@pytest.fixture(scope="module")
def busy(tmp_path_factory):
    return open_busy_road(tmp_path_factory.mktemp("grid") / "t")


@pytest.fixture(scope="module")
def road(busy):
    return build(busy)


def of(samples, name):
    return samples.feature[:, :, FEATURE_NUMBER[name]]


def test_a_vehicle_as_the_one_behind_sees_it(tmp_path):
    """30 m ahead at 20 m/s, followed at 18 m/s; who has none behind is left out."""
    rows = drive_track(1, 30.0, 20.0, 2) + drive_track(2, 0.0, 18.0, 2)
    made = build(open_tracks(tmp_path / "t", {"a": rows}, protocol=GRID))
    samples = made.samples
    assert set(samples.vehicle_id) == {1}
    assert made.without_ego == len(samples) == 70 - 20 - 20, "ticks 20 to 49 of each vehicle"
    assert samples.tick.tolist() == list(range(20, 50))
    assert (samples.subset[0], samples.vehicle[0]) == ("highd/a", "highd/a/1")
    apart = (samples.size_m[0, 0] - samples.ego_size_m[0, 0]) / 2  # of the centres, less than of the fronts
    now_s = samples.tick[:, None] / RATE_HZ
    before_s = now_s + np.arange(-19, 1) / RATE_HZ
    np.testing.assert_allclose(of(samples, "rel_x_m"), 30 + 2 * before_s - apart, atol=1e-4)
    after_s = now_s + np.arange(1, 21) / RATE_HZ
    np.testing.assert_allclose(samples.place_m[..., 0], 30 + 2 * after_s - apart, atol=1e-4)
    for name, expected in {"speed_mps": 20, "rel_y_m": 0, "accel_mps2": 0, "rel_heading_deg": 0, "box_z_m": 0}.items():
        np.testing.assert_allclose(of(samples, name), expected, atol=1e-3)
    np.testing.assert_allclose(samples.velocity_mps, [[2, 0]] * 30, atol=1e-4)
    np.testing.assert_allclose(predict_turns(samples), samples.place_m, atol=2e-3)


def test_rows_lie_around_the_place_now_or_around_constant_velocity(tmp_path):
    """2 m/s apart make rows of 2 m: relative to the follower the leader is 1, 2, 3 and 4 m further."""
    rows = drive_track(1, 30.0, 20.0, 2, change=(40, 10, 1)) + drive_track(2, 0.0, 18.0, 2)
    made = build(open_tracks(tmp_path / "t", {"a": rows}, protocol=GRID))
    samples = made.samples
    nudged = samples.place_m + np.float32([0.01, 0])  # off the border between two rows
    now, straight = (find_road_cells(made, nudged, around_now=own)[20:25, :, 1] for own in (True, False))
    assert now.tolist() == [[1, 1, 2, 2]] * 5
    assert straight.tolist() == [[0, 0, 0, 0]] * 5
    columns = find_road_cells(made, samples.place_m, around_now=True)[..., 0]
    when = samples.tick[:, None] + [5, 10, 15, 20]
    crossed = when > 45  # the marking is in the middle of the change
    certain = (np.abs(when - 45) > 1) & (samples.tick[:, None] < 40)
    assert (columns[certain] == crossed[certain]).all()


def test_features_are_those_of_a_loop_over_what_is_past(road, busy):
    """Least squares over the last second; the first of the 20 ticks know two positions."""
    samples = road.samples
    for number in range(0, len(samples), max(1, len(samples) // 7)):
        row = busy.sample_row[road.number[number]]
        past = busy.position_m[row - 20 : row + 1].astype(float)
        for tick in (0, 1, 6, 19):
            known = past[: tick + 2][-11:]
            time_s = np.arange(1 - len(known), 1) / RATE_HZ
            fits = [np.polyfit(time_s, known[:, axis], min(2, len(known) - 1))[::-1] for axis in (0, 1)]
            (speed, accel), (side, side_accel) = ((own[1], 2 * own[2] if len(own) > 2 else 0.0) for own in fits)
            yaw = (speed * side_accel - side * accel) / (speed**2 + side**2)
            steering = np.degrees(np.arctan(0.6 * samples.size_m[number, 0] * yaw / speed))
            expected = {"speed_mps": np.hypot(speed, side), "accel_mps2": accel, "steering_angle_deg": steering}
            expected["rel_heading_deg"] = np.degrees(np.arctan2(side, speed))
            for name, value in expected.items():
                assert of(samples, name)[number, tick] == pytest.approx(value, abs=2e-2), (name, tick)


def test_no_feature_reads_the_future(tmp_path):
    lead = drive_track(1, 30.0, 20.0, 2)
    follow = drive_track(2, 0.0, 18.0, 2)
    first = build(open_tracks(tmp_path / "a", {"a": lead + follow}, protocol=GRID))
    moved = [[(*row[:3], row[3] + 5 * (row[1] > 30), *row[4:]) for row in rows] for rows in (lead, follow)]
    second = build(open_tracks(tmp_path / "b", {"a": moved[0] + moved[1]}, protocol=GRID))
    until = first.samples.tick <= 30
    np.testing.assert_array_equal(first.samples.feature[until], second.samples.feature[until])
    np.testing.assert_array_equal(first.ego_velocity_mps[until], second.ego_velocity_mps[until])
    assert not np.array_equal(first.samples.place_m[until], second.samples.place_m[until])


def test_a_track_alone_makes_no_sample(tmp_path):
    folder = open_tracks(tmp_path / "t", {"a": track(1, [2.0] * 70)}, protocol=GRID)
    made = build(folder)
    assert (len(made.samples), made.without_ego) == (0, 30)
    assert made.samples.feature.shape == (0, 20, len(FEATURES))


def test_one_cell_against_the_rest_is_that_of_a_loop():
    draw = np.random.default_rng(0)
    true, own = (draw.integers(-OUTSIDE, OUTSIDE + 1, (40, 2, 2)).astype(np.int8) for _ in range(2))
    true[:15] = own[:15]
    scores = list(score_cells("m", "place", own, true, (0.5, 1.0), {"all": np.ones(40, np.bool_)}))
    for horizon, score in enumerate(scores):
        shares = []
        for cell in [(column, row) for column in (-1, 0, 1) for row in (-1, 0, 1)]:
            said = [tuple(own[sample, horizon]) == cell for sample in range(40)]
            truly = [tuple(true[sample, horizon]) == cell for sample in range(40)]
            shares.append(np.mean([a == b for a, b in zip(said, truly, strict=True)]))
        assert score.one_against_rest == pytest.approx(np.mean(shares))
        assert score.one_against_rest > score.cell


def test_the_forest_as_published_votes_on_the_maneuver_alone(road):
    parts = split_samples(road.samples, seed=0)
    forest = fit_forest(parts.train, 0, 200, maneuver_alone=True)
    votes = forest.count_votes(parts.eval)
    assert votes.shape == (len(parts.eval), 1, 3)
    assert (votes.sum(axis=-1) == 100).all()
    assert (forest.classifier.criterion, forest.classifier.n_outputs_) == ("entropy", 1)
    assert forest.decide(parts.eval).tolist() == votes.argmax(axis=-1).tolist()


def test_places_as_published_do_not_hang_on_constant_velocity(road):
    """Trained for an epoch: other velocities change nothing, and outputs are standardised places."""
    parts = split_samples(road.samples.select(np.arange(0, len(road.samples), 8)), seed=0)
    network = train_network(DECODER, parts, TrainConfig(epochs=1, seed=1), anchored=False)
    other = replace(parts.eval, velocity_mps=parts.eval.velocity_mps + 9)
    np.testing.assert_array_equal(run_network(network, other), run_network(network, parts.eval))
    assert not np.array_equal(predict_straight(other, 20), predict_straight(parts.eval, 20))
    train_m = parts.train.place_m.mean(axis=0)
    shift_m = network.mean_m.numpy() - train_m  # a third of the part is mirrored, a third shifted by up to 5 m
    assert np.abs(shift_m[:, 0]).max() < 5 / 3
    np.testing.assert_allclose(network.mean_m.numpy()[:, 1], train_m[:, 1] / 3, atol=1e-3)


def test_the_decoder_starts_from_the_place_now():
    torch.manual_seed(0)
    network = RecursiveDecoder(3, width=8, anchored=False)
    feature = torch.randn(4, 20, len(FEATURES))
    _, states = network.encoder(torch.relu(network.embedding(feature)))
    place, expected = feature[:, -1:, [FEATURE_NUMBER["rel_x_m"], FEATURE_NUMBER["rel_y_m"]]], []
    for _ in range(3):
        decoded, states = network.decoder(torch.relu(network.embedding_of_place(place)), states)
        place = network.place(torch.relu(network.output(decoded)))
        expected.append(place[:, 0])
    torch.testing.assert_close(network.decode(feature), torch.stack(expected, dim=1))
    assert "mean_m" not in network.state_dict(), "stored runs, all anchored, stay as they are"


@pytest.fixture(scope="module")
def scores(busy):
    return score_published(busy, SETTINGS, seed=0, epochs=1, with_curve=True)


def test_both_forests_are_scored_on_the_same_vehicles(scores, road):
    parts = split_samples(road.samples, seed=0)
    assert not set(parts.train.vehicle) & set(parts.eval.vehicle)
    assert scores.samples == {"train": len(parts.train), "eval": len(parts.eval)}
    assert scores.vehicles["train"] / sum(scores.vehicles.values()) == pytest.approx(0.7, abs=0.03)
    assert set(scores.cells) == set(GRIDS)
    lines = {(own.model, own.column) for own in scores.cells["around the place now"]}
    forests = [f"forest {name}" for name in (PUBLISHED, OURS)]
    assert lines == {(model, column) for model in ("ctrv", DECODER) for column in ("place", *forests)}
    assert {own.n for cells in scores.cells.values() for own in cells if own.stratum == "all"} == {len(parts.eval)}
    for name in (PUBLISHED, OURS):
        everyone = scores.maneuvers[name][0]
        assert everyone.n == len(parts.eval)
        assert everyone.balanced > 0.5, "one of three would be a third"
    errors = {(own.model, own.seconds): own.mae_m for own in scores.errors}
    error = predict_turns(parts.eval)[:, 19] - parts.eval.place_m[:, 19]
    assert errors["ctrv", 2.0] == pytest.approx(np.hypot(*error.T.astype(float)).mean(), rel=1e-5)
    assert [own.drawn for own in scores.learning_curve][:1] == [250]
    assert all(own.train_accuracy >= own.eval_accuracy - 0.05 for own in scores.learning_curve)
    assert (len(scores.decoder.losses), len(scores.decoder.validation_losses), scores.decoder.best) == (1, 1, 0)
    assert not scores.decoder.converged
    json.dumps(asdict(scores), allow_nan=False)


def test_as_published_the_maneuver_is_the_column_at_every_horizon(scores, road):
    parts = split_samples(road.samples, seed=0)
    forest = fit_forest(parts.train, 0, SETTINGS.examples, maneuver_alone=True)
    held_out = road.select(np.flatnonzero(np.isin(road.samples.vehicle, np.unique(parts.eval.vehicle))))
    true = find_road_cells(held_out, held_out.samples.place_m, around_now=True)
    decided = np.array([0, -1, 1])[forest.decide(parts.eval)[:, 0]]
    for at, seconds in enumerate((0.5, 1.0, 1.5, 2.0)):
        (score,) = [
            own
            for own in scores.cells["around the place now"]
            if (own.model, own.column, own.seconds, own.stratum) == ("ctrv", f"forest {PUBLISHED}", seconds, "all")
        ]
        assert score.lane == pytest.approx((true[:, at, 0] == decided).mean())


def test_shares_have_intervals_over_vehicles_and_those_of_cells_are_the_scores(scores):
    shares = {(own.figure, own.model, own.grid, own.seconds, own.forest): own for own in scores.shares}
    everyone = {name: shares["maneuver", None, None, None, name] for name in (PUBLISHED, OURS, DIFFERENCE, CONSTANT)}
    for name in (PUBLISHED, OURS):
        assert everyone[name].value == pytest.approx(scores.maneuvers[name][0].accuracy)
        assert shares["left", None, None, None, name].value == pytest.approx(scores.maneuvers[name][0].recall["left"])
    assert everyone[CONSTANT].value == pytest.approx(scores.maneuvers[OURS][0].majority)
    assert everyone[DIFFERENCE].value == pytest.approx(everyone[PUBLISHED].value - everyone[OURS].value)
    assert everyone[OURS].vehicles == scores.vehicles["eval"]
    assert sum(shares[name, None, None, None, OURS].n for name in ("keep", "left", "right")) == scores.samples["eval"]
    for grid, cells in scores.cells.items():
        for own in cells:
            if own.stratum == "all" and own.column != "place":
                key = (own.model, grid, own.seconds, own.column.removeprefix("forest "))
                assert shares["cell", *key].value == pytest.approx(own.cell)
                assert shares["cell_clipped", *key].value == pytest.approx(own.cell_clipped)
                assert shares["one_against_rest", *key].value == pytest.approx(own.one_against_rest)
                assert shares["cell", *key[:-1], CONSTANT].value == pytest.approx(own.majority)
    for own in scores.shares:
        assert own.low is None or own.low <= own.value <= own.high


def test_vehicles_of_successive_numbers_stand_together(road):
    number = number_vehicles(road.samples)
    assert len(np.unique(number)) == len(np.unique(road.samples.vehicle))
    order = np.argsort(number, kind="stable")
    for subset in np.unique(road.samples.subset):
        of = order[road.samples.subset[order] == subset]
        assert (np.diff(road.samples.vehicle_id[of]) >= 0).all()


def test_the_decoder_trains_until_the_loss_on_vehicles_held_back_falls_no_more(road, monkeypatch):
    """Losses of 3, 1, 2 and 2: two epochs without a smaller one end it, and the weights of the second are kept."""
    parts = split_samples(road.samples.select(np.arange(0, len(road.samples), 16)), seed=0)
    said = iter((3.0, 1.0, 2.0, 2.0))
    with monkeypatch.context() as patch:
        patch.setattr("tracklake.training.onboard.training._measure_loss", lambda *_: next(said))
        watch = Watch(parts.eval, patience=2)
        network = train_network("stacked-lstm", parts, TrainConfig(epochs=9), anchored=False, watch=watch)
    assert ([own for _, own in watch.losses], watch.best, watch.is_over) == ([3.0, 1.0, 2.0, 2.0], 1, True)
    second = train_network("stacked-lstm", parts, TrainConfig(epochs=2), anchored=False)
    for one, other in zip(network.parameters(), second.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    watch = Watch(parts.eval, patience=2)
    network = train_network("stacked-lstm", parts, TrainConfig(epochs=1), anchored=False, watch=watch)
    error = (run_network(network, parts.eval) - parts.eval.place_m) / network.scale_m.numpy()
    assert watch.losses[0][1] == pytest.approx(float(np.square(error).mean()), rel=1e-4)
    assert not watch.is_over


def ask(folder, monkeypatch, tmp_path, *options):
    monkeypatch.setattr("tracklake.pipeline.cli.lane_forest.load", lambda root: root)
    monkeypatch.setattr("tracklake.pipeline.cli.lane_forest.tensor_folder", lambda *_: folder.path)
    monkeypatch.setattr("tracklake.pipeline.cli.lane_forest.print_comparability", lambda *_, **__: False)
    settings = [part for own in ("trees=5", "leaf=3", "start_s=1") for part in ("--set", own)]
    asked = ["lane-forest", "--lake", str(tmp_path / "lake"), "--protocol", "grid-2021", "--examples", "200"]
    return CliRunner().invoke(app, [*asked, *settings, *options], catch_exceptions=False)


def test_the_command_shows_and_stores_it(busy, monkeypatch, tmp_path):
    done = ask(busy, monkeypatch, tmp_path, "--as-published")
    assert done.exit_code == 0, done.stderr
    stored = json.loads((tmp_path / "lake" / "models" / "lane-forest" / "lane_forest.json").read_text())
    assert set(stored["as_published"]["cells"]) == set(GRIDS)
    assert stored["as_published"]["learning_curve"] == []
    assert "as published (Choi et al. 2021): 70:30 by vehicle, train " in done.stdout
    for title in ("right cell, %; rows around the place now", "one cell against the rest, mean, %; rows around"):
        assert title in done.stdout
    assert "ctrv + forest as published" in done.stdout
    assert "ctrv + forest ours" in done.stdout
    assert "lstm-encoder-decoder  " not in done.stdout, "it was not trained"


def test_what_the_command_refuses(busy, monkeypatch, tmp_path):
    alone = ask(busy, monkeypatch, tmp_path, "--epochs", "2")
    assert alone.exit_code == 2
    assert "--epochs trains the decoder of --as-published" in " ".join(alone.stderr.replace("│", " ").split())
    slow = open_tracks(tmp_path / "slow", {"a": track(1, [2.0] * 30)})
    with pytest.raises(TracklakeError, match=r"as published needs 20 positions .* got 3 and 4 at 2 Hz: run `tracklake"):
        build(slow)
