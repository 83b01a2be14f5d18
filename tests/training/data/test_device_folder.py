"""What is gathered from torch tensors on a device equals what NumPy gathers from the mapped folder."""

from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import BY_VEHICLE, IN_TIME, UNDIVIDED, random_tables
from tensor_tables import write

from tracklake.training.data.gathers import gather_nearest, gather_samples
from tracklake.training.data.tensor_folder import DeviceFolder, TensorFolder

CPU = torch.device("cpu")
STORAGES = ["float32", "int16-decimetres", "int16-centimetres"]
MARKINGS = [0.0, 4.0, 8.0, 11.0]


def assert_equals(got, wanted):
    assert is_dataclass(got)
    for own in fields(wanted):
        left, right = getattr(got, own.name), getattr(wanted, own.name)
        if own.name == "absolute":
            assert left == right
            continue
        assert isinstance(left, torch.Tensor), own.name
        assert left.numpy().dtype == right.dtype, own.name
        np.testing.assert_array_equal(left.numpy(), right, err_msg=own.name)


def draw_numbers(order, folder):
    """Numbers of samples in any order, some twice."""
    samples = len(folder.sample_row)
    return np.array([order.randrange(samples) for _ in range(12)] if samples else [], dtype=np.int64)


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME]),
    storage=st.sampled_from(STORAGES),
    absolute=st.booleans(),
    order=st.randoms(use_true_random=False),
)
def test_samples_on_a_device_equal_the_mapped_ones(tmp_path_factory, seed, splits, storage, absolute, order):
    written = write(tmp_path_factory.mktemp("tensors"), random_tables(seed), splits, storage=storage)
    folder = TensorFolder.open(written)
    numbers = draw_numbers(order, folder)
    got = gather_samples(DeviceFolder(folder, CPU), torch.from_numpy(numbers), absolute=absolute)
    assert_equals(got, folder.gather(numbers, absolute=absolute))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME, BY_VEHICLE]),
    storage=st.sampled_from(STORAGES),
    markings=st.sampled_from([None, MARKINGS]),
    nearest=st.integers(0, 7),
    order=st.randoms(use_true_random=False),
)
def test_vehicles_on_a_device_equal_the_mapped_ones(tmp_path_factory, seed, splits, storage, markings, nearest, order):
    kept = UNDIVIDED if markings is None else splits
    written = write(tmp_path_factory.mktemp("tensors"), random_tables(seed), kept, markings=markings, storage=storage)
    folder = TensorFolder.open(written)
    numbers = draw_numbers(order, folder)
    got = gather_nearest(DeviceFolder(folder, CPU), torch.from_numpy(numbers), nearest=nearest)
    for ours, theirs in zip(got, gather_nearest(folder, numbers, nearest=nearest), strict=True):
        assert_equals(ours, theirs)


def test_changing_a_batch_does_not_change_the_next_one(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(3), UNDIVIDED))
    device, numbers = DeviceFolder(folder, CPU), np.array([1, 0])
    for part in gather_nearest(device, torch.from_numpy(numbers), nearest=2):
        part.each(lambda tensor: tensor.zero_())
    for ours, theirs in zip(
        gather_nearest(device, torch.from_numpy(numbers), nearest=2),
        gather_nearest(folder, numbers, nearest=2),
        strict=True,
    ):
        assert_equals(ours, theirs)


def test_an_array_is_copied_when_it_is_first_used(tmp_path):
    folder = TensorFolder.open(write(tmp_path, random_tables(3), UNDIVIDED))
    device = DeviceFolder(folder, torch.device("meta"))
    assert "lane" not in vars(device)
    assert device.lane.device.type == "meta"
    assert device.lane is device.lane
    assert device.protocol is folder.protocol
    with pytest.raises(AttributeError, match="a tensor folder has no array `lanee`"):
        _ = device.lanee
