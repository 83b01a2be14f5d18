"""The layout of a text file's lines: names, types, bounds and separators of their fields."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import polars as pl


@dataclass(frozen=True)
class Layout:
    """The layout of a file's lines.

    Args:
        names: names of all fields, in the file's order, as in the raw schema.
        dtypes: types of the wanted fields.
        required: wanted fields that may not be empty.
        thousands: wanted numeric fields that may carry thousands separators.
        bounds: lowest and highest allowed value of numeric fields.
        choices: allowed values of text fields, in lower case.
        header_lines: 1 if line 1 names the fields, else 0.
        blanks: whether runs of blanks separate fields instead of commas.
    """

    names: tuple[str, ...]
    dtypes: Mapping[str, pl.DataType]
    required: frozenset[str]
    thousands: frozenset[str] = frozenset()
    bounds: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    header_lines: int = 1
    blanks: bool = False

    @property
    def separator(self) -> str:
        """Character between fields, once runs of blanks are squeezed."""
        return " " if self.blanks else ","
