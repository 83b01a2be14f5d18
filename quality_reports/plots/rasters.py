"""Colours of numbers on a perceptually uniform scale."""

import numpy as np
from numpy.typing import NDArray

from tracklake.schemas.arrays import Bytes, Floats

VIRIDIS = ("440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b")
"""Ten equal steps of matplotlib's viridis less the last: perceptually uniform, distinct for colour-blind readers, and
in order of lightness on any printer. The last yellow is left out because it is hardly visible on white."""
EMPTY = 0
"""Palette entry of cells without a value, which is transparent."""
LEVELS = 255
"""Number of the other palette entries, from the least value to the greatest."""


def make_palette() -> NDArray[np.uint8]:
    """Make the colours as (256, 4) RGBA: EMPTY transparent, then LEVELS steps, linear between VIRIDIS's anchors."""
    anchors = np.array([[int(text[place : place + 2], 16) for place in (0, 2, 4)] for text in VIRIDIS], np.float64)
    steps = np.linspace(0, len(anchors) - 1, LEVELS)
    colours = np.zeros((LEVELS + 1, 4), np.uint8)
    for channel in range(3):
        colours[1:, channel] = np.round(np.interp(steps, np.arange(len(anchors)), anchors[:, channel]))
    colours[1:, 3] = 255
    return colours


def grade_values(values: Floats, least: float, greatest: float) -> Bytes:
    """Return palette entries of values: 1 up to `least`, 255 from `greatest` on, EMPTY for NaN."""
    share = np.clip((values - least) / (greatest - least), 0, 1)
    return np.where(np.isnan(share), EMPTY, 1 + np.round(np.nan_to_num(share) * (LEVELS - 1))).astype(np.uint8)


def colour_values(values: Floats, least: float, greatest: float) -> list[str]:
    """Return the colours of known values as `#rrggbb`, on the scale of `grade_values`."""
    return [f"#{bytes(colour[:3]).hex()}" for colour in make_palette()[grade_values(values, least, greatest)]]
