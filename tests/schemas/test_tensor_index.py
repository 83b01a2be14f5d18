"""Kinds of values in the index of tensors; `training/data/test_tensor_opening.py` reads damaged ones."""

from tracklake.schemas.tensor_index import KINDS
from tracklake.schemas.tensors import INDEX_KEYS, SUBSET_KEYS


def test_every_kind_that_is_declared_is_known():
    assert {*INDEX_KEYS.values(), *SUBSET_KEYS.values()} == set(KINDS)
