"""Batches as torch tensors: streamed, drawn by a sampler, and gathered on a device, equal to the mapped folder's."""

import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensor_loop import IN_TIME, UNDIVIDED, random_tables
from tensor_tables import drive, sample_everything, split_row, write
from torch.utils.data import DataLoader

from tracklake.training.data.augmentation import mirror
from tracklake.training.data.batches import Batch
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.data.torch_batches import BatchStream, ResidentTensors, SampleDataset, TorchBatch


def assert_equals(got, wanted):
    for own in fields(Batch):
        left, right = getattr(got, own.name), getattr(wanted, own.name)
        if own.name == "absolute":
            assert left == right
            continue
        assert isinstance(left, torch.Tensor), own.name
        assert left.numpy().dtype == right.dtype, own.name
        np.testing.assert_array_equal(left.numpy(), right, err_msg=own.name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    draw = np.random.default_rng(0)
    clock = drive(draw, vehicles=6, ticks=14)
    tables = [("a", clock, *sample_everything(draw, clock, dataset="highd", subset="a"))]
    return TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), tables, split_row("a", "train")))


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    splits=st.sampled_from([UNDIVIDED, IN_TIME]),
    storage=st.sampled_from(["float32", "int16-decimetres", "int16-centimetres"]),
    absolute=st.booleans(),
)
def test_what_a_device_gathers_equals_what_is_mapped(tmp_path_factory, seed, splits, storage, absolute):
    tables = random_tables(seed)
    mapped = TensorFolder.open(write(tmp_path_factory.mktemp("tensors"), tables, splits, storage=storage))
    resident = ResidentTensors(mapped, "cpu")
    for part in ("train", "val", "eval"):
        got = list(resident.batches(part, 3, absolute=absolute))
        wanted = list(mapped.batches(part, 3, absolute=absolute))
        assert len(got) == len(wanted)
        for ours, theirs in zip(got, wanted, strict=True):
            assert_equals(ours, theirs)


def test_a_resident_shuffle_is_fixed_by_its_seed_and_leaves_nothing_out(folder):
    resident = ResidentTensors(folder, "cpu")
    orders = [
        torch.cat([batch.sample for batch in resident.batches("train", 5, shuffle_seed=seed)]).tolist()
        for seed in (1, 1, 2)
    ]
    assert orders[0] == orders[1]
    assert orders[0] != orders[2]
    assert sorted(orders[0]) == folder.samples_of("train").tolist()


def test_a_stream_yields_the_folders_batches_and_shuffles_every_pass_anew(folder):
    stream = BatchStream(folder, "train", 7, shuffle_seed=5)
    for seed in (5, 6):
        wanted = list(folder.batches("train", 7, shuffle_seed=seed))
        got = list(DataLoader(stream, batch_size=None))
        assert len(got) == len(wanted) == len(stream)
        for ours, theirs in zip(got, wanted, strict=True):
            assert_equals(ours, theirs)


def test_workers_of_a_stream_share_the_batches(folder, monkeypatch):
    wanted = [batch.sample.tolist() for batch in folder.batches("train", 7)]
    assert len(wanted) > 3
    seen = []
    for number in range(2):
        worker = type("Worker", (), {"id": number, "num_workers": 2})()
        monkeypatch.setattr("tracklake.training.data.torch_batches.get_worker_info", lambda worker=worker: worker)
        seen.append([batch.sample.tolist() for batch in BatchStream(folder, "train", 7, absolute=True)])
    assert seen == [wanted[0::2], wanted[1::2]]


def test_workers_share_every_pass_and_draw_it_anew(folder):
    command = [sys.executable, Path(__file__).parents[2] / "helpers" / "read_with_workers.py", folder.path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    everything = folder.samples_of("train").tolist()
    assert len(everything) > 20
    for (first, second), again, other in json.loads(done.stdout):
        assert sorted(first) == sorted(second) == everything
        assert first != second
        assert again == [first, second]
        assert other[0] != first


def test_batches_are_changed_before_they_become_torch(folder):
    def change(batch):
        return mirror(folder, batch, np.ones(len(batch), dtype=np.bool_))

    numbers = folder.samples_of("train")[:4]
    wanted = change(folder.gather(numbers))
    assert (wanted.history[..., 1] == -folder.gather(numbers).history[..., 1]).all()
    assert_equals(next(iter(BatchStream(folder, "train", 4, change=change))), wanted)
    (got,) = SampleDataset(folder, "train", change=change).__getitems__([0, 1, 2, 3])
    assert_equals(got, wanted)


def test_a_sampler_draws_whole_batches(folder):
    dataset = SampleDataset(folder, "train", absolute=True)
    loader = DataLoader(dataset, batch_size=4, sampler=[3, 1, 8, 0, 2], collate_fn=dataset.collate)
    got = list(loader)
    assert len(got) == 2
    assert_equals(got[0], folder.gather([3, 1, 8, 0], absolute=True))
    assert_equals(got[1], folder.gather([2], absolute=True))
    assert_equals(dataset[3], folder.gather([3], absolute=True))
    assert len(dataset) == len(folder.samples_of("train"))


def test_a_batch_moves_to_a_device_whole(folder):
    batch = TorchBatch.of(folder.gather([0, 1]))
    assert len(batch) == 2
    moved = batch.to("meta")
    assert {getattr(moved, own.name).device.type for own in fields(Batch) if own.name != "absolute"} == {"meta"}
    assert moved.absolute is False


def test_pinned_batches_are_asked_of_torch(folder, monkeypatch):
    pinned = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda tensor: pinned.append(tensor) or tensor)
    batch = next(iter(BatchStream(folder, "train", 4, pin_memory=True)))
    assert len(pinned) == len(fields(Batch)) - 1
    assert_equals(batch, folder.gather(folder.samples_of("train")[:4]))


def test_unknown_part(folder):
    for make in (BatchStream, SampleDataset):
        with pytest.raises(ValueError, match="unknown part `test`"):
            make(folder, "test", *([4] if make is BatchStream else []))
