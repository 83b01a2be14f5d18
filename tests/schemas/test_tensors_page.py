"""The page of tensors is what the declaration derives; and the declaration says what it needs to."""

from pathlib import Path

from tracklake.schemas.tensors import ARRAYS, POSITION_STORAGES, STEPS_M
from tracklake.schemas.tensors_markdown import LETTERS, write_tensors_page

PAGE = Path(__file__).parents[2] / "docs" / "tensors.md"


def test_the_page_of_tensors_is_current():
    assert PAGE.read_text() == write_tensors_page(), "run `make docs`"
    assert all(f"| `{array.name}` |" in write_tensors_page() for array in ARRAYS)


def test_arrays_name_known_letters():
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
