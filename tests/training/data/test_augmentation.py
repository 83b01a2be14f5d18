"""Mirrored and moved samples equal an obvious loop over samples and their neighbors."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lone_vehicles import reveal, seeds
from lone_vehicles import wander as wander_alone
from tensor_tables import TINY
from tiny_network import write_tiny
from wandering_scenes import wander as wander_together

from tracklake.schemas.columns import LATERAL_MANEUVERS
from tracklake.schemas.errors import UsageError
from tracklake.schemas.protocols import CSP
from tracklake.training.data.augmentation import augment
from tracklake.training.data.observed import Observed
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.loop import _load_batches, make_reader
from tracklake.training.models import find_model
from tracklake.training.runs.config import TrainConfig, make_plan
from tracklake.training.train import train

MIRROR = np.array([1, -1], dtype=np.float32)
OPPOSITE = {"keep": "keep", "left": "right", "right": "left"}


def draw_grid(draw, samples):
    """Samples with up to seven neighbors each, one in a cell."""
    history, future = wander_alone(draw, CSP, samples)
    counts = draw.integers(0, 8, samples)
    cells = [np.sort(draw.choice(39, count, replace=False)) for count in counts]
    around, _ = wander_alone(draw, CSP, int(counts.sum()))
    observed = Observed(
        history=history,
        neighbor_history=around + draw.normal(0, 10, (len(around), 1, 2)).astype(np.float32),
        neighbor_mask=draw.random(around.shape[:2]) < 0.8,
        neighbor_sample=np.repeat(np.arange(samples), counts),
        neighbor_cell=np.concatenate([*cells, []]).astype(np.int8),
    )
    return observed, reveal(future, draw)


def draw_changes(draw, samples):
    return draw.random(samples) < 0.5, draw.integers(-2, 3, samples)


def augment_arrays(observed, truth, mirrored, rows):
    tensors = (own.each(torch.from_numpy) for own in (observed, truth))
    changed = augment(*tensors, torch.from_numpy(mirrored), torch.from_numpy(rows))
    return tuple(own.each(torch.Tensor.numpy) for own in changed)


def mirror_maneuver(code):
    return LATERAL_MANEUVERS.index(OPPOSITE[LATERAL_MANEUVERS[code]])


@settings(max_examples=30)
@given(seeds, st.integers(0, 5))
def test_grids_equal_a_loop_over_samples_and_neighbors(seed, samples):
    draw = np.random.default_rng(seed)
    observed, truth = draw_grid(draw, samples)
    truth = type(truth)(**{**vars(truth), "lateral": draw.integers(0, 3, samples).astype(np.uint8)})
    mirrored, rows = draw_changes(draw, samples)
    found, came = augment_arrays(observed, truth, mirrored, rows)
    expected = []
    for number in range(samples):
        side = MIRROR if mirrored[number] else np.ones(2, dtype=np.float32)
        np.testing.assert_array_equal(found.history[number], observed.history[number] * side)
        np.testing.assert_array_equal(came.future[number], truth.future[number] * side)
        code = int(truth.lateral[number])
        assert came.lateral[number] == (mirror_maneuver(code) if mirrored[number] else code)
        for other in np.flatnonzero(observed.neighbor_sample == number):
            column, row = divmod(int(observed.neighbor_cell[other]), 13)
            row -= rows[number]
            if 0 <= row < 13:
                column = 2 - column if mirrored[number] else column
                place = observed.neighbor_history[other] * side - np.float32([rows[number] * 4.572, 0])
                expected.append((number, 13 * column + row, place, observed.neighbor_mask[other]))
    expected.sort(key=lambda own: own[:2])
    assert list(zip(found.neighbor_sample, found.neighbor_cell, strict=True)) == [own[:2] for own in expected]
    for place, known, (_, _, true_place, true_known) in zip(
        found.neighbor_history, found.neighbor_mask, expected, strict=True
    ):
        np.testing.assert_allclose(place, true_place, atol=1e-5)
        np.testing.assert_array_equal(known, true_known)
    np.testing.assert_array_equal(came.future_mask, truth.future_mask)
    np.testing.assert_array_equal(came.longitudinal, truth.longitudinal)


@settings(max_examples=20)
@given(seeds, st.integers(0, 4))
def test_scenes_equal_a_loop_over_samples_and_vehicles(seed, scenes):
    draw = np.random.default_rng(seed)
    observed, truth = wander_together(seed, scenes, 4)
    lanes = np.zeros((scenes, 5, 3), dtype=np.float32)  # of carriageways with up to five lanes, from the left
    for scene in range(scenes):
        lanes[scene, : scene + 1] = [(3.5 * lane - 5, 3.5 + lane / 10, 1) for lane in range(scene + 1)]
    observed = type(observed)(**{**vars(observed), "all_lanes": lanes})
    mirrored, rows = draw_changes(draw, scenes)
    found, came = augment_arrays(observed, truth, mirrored, rows)
    for scene in range(scenes):
        side = MIRROR if mirrored[scene] else np.ones(2, dtype=np.float32)
        for vehicle in range(4):
            there = vehicle > 0 and observed.vehicle_mask[scene, vehicle]
            back = np.float32([rows[scene] * 4.572 if there else 0, 0])
            for now, then in ((found.history, observed.history), (came.future, truth.future)):
                np.testing.assert_allclose(now[scene, vehicle], then[scene, vehicle] * side - back, atol=1e-4)
        for now, then in ((found.lanes, observed.lanes), (found.all_lanes, lanes)):
            if not mirrored[scene]:
                np.testing.assert_array_equal(now[scene], then[scene])
                continue
            by_offset = sorted((-offset, width) for offset, width, exists in then[scene] if exists)
            assert [tuple(own[:2]) for own in now[scene] if own[2]] == by_offset
        if mirrored[scene]:  # those left of, under and right of the ego change places
            np.testing.assert_array_equal(found.lanes[scene, :, 2], observed.lanes[scene, ::-1, 2])
            np.testing.assert_array_equal(found.all_lanes[scene, :, 2], lanes[scene, :, 2])
    for name in ("history_mask", "vehicle_mask", "size_m"):
        np.testing.assert_array_equal(getattr(found, name), getattr(observed, name))


@pytest.mark.parametrize("kind", ["grid", "scene"])
def test_dtypes_stay_and_a_mirrored_mirror_image_is_the_original(kind):
    draw = np.random.default_rng(4)
    observed, truth = draw_grid(draw, 6) if kind == "grid" else wander_together(4, 6, 4)
    mirrored, rows = draw_changes(draw, 6)
    still = np.zeros(6, dtype=np.int64)
    once = augment_arrays(observed, truth, mirrored, rows)
    twice = augment_arrays(*augment_arrays(observed, truth, mirrored, still), mirrored, still)
    for own, again, original in zip(once, twice, (observed, truth), strict=True):
        for name, values in vars(original).items():
            assert getattr(own, name).dtype == getattr(again, name).dtype == values.dtype, name
            np.testing.assert_array_equal(getattr(again, name), values, err_msg=name)


# Training


@pytest.fixture(scope="module")
def tensors(tmp_path_factory):
    return write_tiny(tmp_path_factory.mktemp("tensors"))


def list_batches(tensors, model, augmentation, step, count):
    """Batches from a step on, as NumPy arrays by name."""
    config = TrainConfig(steps=8, batch_size=16, augmentation=augmentation)
    plan = make_plan(find_model(model), TensorFolder.open(tensors), config)
    stream = _load_batches(plan, make_reader(plan.folder, plan.entry.reads, plan.device), step)
    batches = [next(stream) for _ in range(count)]
    return [{**vars(observed), **vars(truth)} for _, observed, truth in batches]


@pytest.mark.parametrize("model", ["cs-lstm", "attention-h2"])
def test_an_augmented_training_goes_on_with_the_batches_that_it_would_have_had(model, tensors):
    whole = list_batches(tensors, model, "both", 0, 11)  # more than an epoch
    rest = list_batches(tensors, model, "both", 6, 5)
    for one, other in zip(whole[6:], rest, strict=True):
        assert all(torch.equal(one[name], other[name]) for name in one)
    plain = list_batches(tensors, model, "none", 0, 1)[0]
    assert not torch.equal(plain["future"], whole[0]["future"])
    assert torch.equal(plain["future_mask"], whole[0]["future_mask"])


@pytest.mark.parametrize(("augmentation", "sides", "moves"), [("mirror", 1, 0), ("shift", 0, 1), ("both", 1, 1)])
def test_augmentations_are_drawn_as_named(augmentation, sides, moves, tensors):
    config = TrainConfig(augmentation=augmentation)
    plan = make_plan(find_model("lstm"), TensorFolder.open(tensors), config)
    mirrored, rows = plan.draw_changes(3, 0, 3000)
    assert mirrored.mean() == pytest.approx(sides / 2, abs=0.05)
    assert set(rows) == ({-1, 0, 1} if moves else {0})
    assert not np.array_equal(plan.draw_changes(3, 128, 3000)[1 if moves else 0], (mirrored, rows)[1 if moves else 0])


def test_the_run_says_how_its_samples_were_augmented(tensors, tmp_path):
    train("lstm", tensors, tmp_path / "run", TrainConfig(steps=2, augmentation="mirror"))
    assert json.loads((tmp_path / "run" / "config.json").read_text())["recipe"]["augmentation"] == "mirror"
    assert TensorFolder.open(tensors).protocol == TINY
    with pytest.raises(UsageError, match="`augmentation`: expected 'none', 'mirror', 'shift' or 'both', got 'flip'"):
        TrainConfig(augmentation="flip")
