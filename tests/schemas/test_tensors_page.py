"""The page of tensors is what the declaration derives; and the declaration says what it needs to."""

from pathlib import Path

import numpy as np

from tracklake.schemas.tensors import ARRAYS, POSITION_STORAGES, SAFETENSORS_DTYPES, STEPS_M
from tracklake.schemas.tensors_markdown import LETTERS, write_tensors_page

PAGE = Path(__file__).parents[2] / "docs" / "tensors.md"


def test_the_page_of_tensors_is_current():
    assert PAGE.read_text() == write_tensors_page(), "run `make docs`"
    assert all(f"| `{array.name}` |" in write_tensors_page() for array in ARRAYS)


def test_arrays_stand_aligned_one_after_the_other_and_name_known_letters():
    for storage in POSITION_STORAGES:
        widths = [np.dtype(array.stored_as(storage)).itemsize for array in ARRAYS]
        assert all(array.stored_as(storage) in SAFETENSORS_DTYPES for array in ARRAYS)
        odd = [
            width
            for array, width in zip(ARRAYS, widths, strict=True)
            if array.name != "position_m"  # rows of two: as wide as the float32 around it either way
        ]
        assert odd == sorted(odd, reverse=True)
    axes = {axis.partition("+")[0] for array in ARRAYS for axis in array.shape}
    assert axes == {*LETTERS, "2"}
    assert set(STEPS_M) == set(POSITION_STORAGES) - {"float32"}


def test_shapes_in_numbers():
    by_name = {array.name: array for array in ARRAYS}
    sizes = {"N": 7, "R": 2, "S": 3, "K": 5, "C": 1, "M": 4}
    assert by_name["position_m"].sizes(sizes) == (7, 2)
    assert by_name["neighbor_offset"].sizes(sizes) == (4,)
    assert by_name["position_m"].stored_as("int16-decimetres") == "int16"
    assert by_name["lane"].stored_as("float32") == "int16"
