"""Stores of numbers, in memory and in files, and the median of numbers that are read part by part."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracklake.pipeline.lake.scratch import open_scratch
from tracklake.pipeline.transforms.number_store import MemoryStore, find_median


@pytest.mark.parametrize("dtype", ["float64", "int32", "bool"])
def test_a_file_holds_what_memory_holds(tmp_path, dtype):
    with open_scratch(tmp_path) as make_store:
        stores = MemoryStore(dtype), make_store(dtype)
        for store in stores:
            assert (store.size, store[0:5].tolist(), store[np.empty(0, np.int64)].tolist()) == (0, [], [])
            store.append(np.array([], dtype))
            store.append(np.array([1, 0, 5], dtype))
            store.append(np.array([7, 0], dtype))
            assert store.size == 5
            store[np.array([4, 0])] = np.array([1, 0], dtype)
            kept = store[1:5]
            store[0:5] = np.zeros(5, dtype)
            assert kept.tolist() == np.array([0, 5, 7, 1], dtype).tolist(), "a copy"
            store.append(np.array([3], dtype))
            assert store[np.array([5, 4])].tolist() == np.array([3, 0], dtype).tolist()
            assert store[4:9].tolist() == np.array([0, 3], dtype).tolist()
            assert store[2:4].dtype == np.dtype(dtype)
        assert len(list((tmp_path / ".staging").glob("*/*"))) == 1
    assert not list((tmp_path / ".staging").iterdir())


@given(
    values=st.lists(st.floats(-1e9, 1e9) | st.sampled_from([0.5, -3.0]), min_size=1, max_size=40),
    at_once=st.integers(1, 9),
)
def test_the_median_is_numpys(values, at_once):
    store = MemoryStore("float64")
    store.append(np.array(values))
    assert find_median(store, at_once) == np.median(values)
