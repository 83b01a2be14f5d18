"""Surroundings gathered on a device are those that NumPy gathers (`test_surroundings` holds these to a loop)."""

from dataclasses import fields

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import BY_VEHICLE, IN_TIME, UNDIVIDED, random_tables
from tensor_tables import write

from tracklake.training.data.nearest_vehicles import gather_surroundings
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.data.torch_nearest_vehicles import ResidentSurroundings

MARKINGS = [0.0, 4.0, 8.0, 11.0]


def assert_equals(got, wanted):
    for ours, theirs in zip(got, wanted, strict=True):
        for own in fields(theirs):
            left, right = getattr(ours, own.name), getattr(theirs, own.name)
            assert isinstance(left, torch.Tensor), own.name
            assert left.numpy().dtype == right.dtype, own.name
            np.testing.assert_array_equal(left.numpy(), right, err_msg=own.name)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME, BY_VEHICLE]),
    storage=st.sampled_from(["float32", "int16-decimetres", "int16-centimetres"]),
    markings=st.sampled_from([None, MARKINGS]),
    nearest=st.integers(0, 7),
    order=st.randoms(use_true_random=False),
)
def test_what_a_device_gathers_equals_what_is_mapped(tmp_path_factory, seed, splits, storage, markings, nearest, order):
    kept = UNDIVIDED if markings is None else splits
    written = write(tmp_path_factory.mktemp("tensors"), random_tables(seed), kept, markings=markings, storage=storage)
    folder = TensorFolder.open(written)
    samples = len(folder.sample_row)
    numbers = np.array([order.randrange(samples) for _ in range(12)] if samples else [], dtype=np.int64)
    resident = ResidentSurroundings(folder, "cpu", nearest=nearest)
    got = resident.gather(torch.from_numpy(numbers))
    assert_equals(got, gather_surroundings(folder, numbers, nearest=nearest))


def test_a_network_reads_no_storage_of_the_folders(tmp_path):
    """What is gathered may be changed without changing what is gathered next."""
    folder = TensorFolder.open(write(tmp_path, random_tables(3), UNDIVIDED))
    resident = ResidentSurroundings(folder, "cpu", nearest=2)
    numbers = torch.tensor([1, 0])
    for part in resident.gather(numbers):
        part.each(lambda tensor: tensor.zero_())
    assert_equals(resident.gather(numbers), gather_surroundings(folder, numbers.numpy(), nearest=2))
