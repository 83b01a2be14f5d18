"""Tensors of a long subset, made in parts, are those of the whole subset, byte for byte."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tensor_tables import TINY, finding, random_clock, sample_everything, sizes_of, split_row

from tracklake.pipeline.lake.tensor_files import write_tensors
from tracklake.pipeline.transforms.number_store import MemoryStore
from tracklake.pipeline.transforms.tensors.arrays import build_subset_tensors
from tracklake.pipeline.transforms.tensors.entries import TensorInputs
from tracklake.pipeline.transforms.tensors.parts import LongSubset, build_parts
from tracklake.schemas.tensors import POSITION_STORAGES

FACTS = {"dataset": "highd", "subset": "a", "origin": "recorded", "frame_rate_hz": 10.0, "lane_markings_m": None}


def divide(clock, samples, neighbors, vehicles_at_once, at_once):
    """The tables as a long subset that is read so many vehicles at a time; one part of the clock has no entries."""
    ids = clock["vehicle_id"].unique().sort().to_list()
    groups = [[], *(ids[first : first + vehicles_at_once] for first in range(0, len(ids), vehicles_at_once))]

    def read_samples(low, high):
        vehicle = pl.col("vehicle_id")
        bounds = (vehicle > (-1 if low is None else low)) & (vehicle <= (2**31 - 1 if high is None else high))
        return samples.filter(bounds), neighbors.filter(bounds)

    def read_clocks():
        return [clock.filter(pl.col("vehicle_id").is_in(group)) for group in groups]

    return LongSubset(read_clocks, read_samples, MemoryStore, at_once)


@given(
    seed=st.integers(0, 10_000),
    storage=st.sampled_from(POSITION_STORAGES),
    vehicles_at_once=st.integers(1, 4),
    at_once=st.integers(1, 30),
    border=st.integers(1, 70) | st.none(),
    drop_cut=st.booleans(),
    again=st.booleans(),
)
def test_parts_are_those_of_the_whole(
    tmp_path_factory, seed, storage, vehicles_at_once, at_once, border, drop_cut, again
):
    draw = np.random.default_rng(seed)
    clock = random_clock(draw)
    samples, neighbors = sample_everything(draw, clock, dataset="highd", subset="a")
    blocks = split_row("a", "train")
    if border is not None:
        blocks = split_row("a", "train", last_frame=border)
        blocks.extend(split_row("a", "eval", block=1, first_frame=border + 4))
    ids = clock["vehicle_id"].unique()
    inputs = TensorInputs(
        blocks,
        vehicles=sizes_of(clock),
        findings=pl.concat([finding(ids[0], "error", 10, 40), finding(ids[-1], "info", 1, 20)]),
        first_frame=1,
        frame_rate_hz=10.0,
        protocol=TINY,
        storage=storage,
        left_out=ids.sample(1, seed=seed),
        drop_cut=drop_cut,
    )
    whole = build_subset_tensors(clock, samples, neighbors, inputs)
    parts = list(build_parts(divide(clock, samples, neighbors, vehicles_at_once, at_once), inputs))
    assert len(parts) > len(ids) / vehicles_at_once
    assert parts[-1].cut_samples == whole.cut_samples
    folders = [tmp_path_factory.mktemp("tensors") for _ in range(2)]
    for folder, made in zip(folders, ([whole], parts), strict=True):
        # A second subset after it, or not.
        write_tensors(folder, [(FACTS, made)] * (1 + again), blocks, TINY, storage=storage)
    for file in folders[0].iterdir():
        assert (folders[1] / file.name).read_bytes() == file.read_bytes(), file.name


def test_parts_with_samples_that_have_no_entries_are_refused():
    draw = np.random.default_rng(1)
    clock = random_clock(draw)
    samples, neighbors = sample_everything(draw, clock, dataset="highd", subset="a", left_out=0)
    inputs = TensorInputs(split_row("a", "train"), sizes_of(clock), pl.DataFrame(), 1, 10.0, TINY)
    inputs = replace(inputs, findings=finding(1, "info", 1, 2).clear())
    missing = clock.filter(pl.col("vehicle_id") != samples["vehicle_id"][0])
    with pytest.raises(ValueError, match=f"have no entry .* example vehicle {samples['vehicle_id'][0]} "):
        list(build_parts(divide(missing, samples, neighbors, 2, 10), inputs))
