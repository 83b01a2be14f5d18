"""Rasters: a grid of numbers as a PNG with a palette, and the palette: from few bytes, without an imaging library."""

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.uint8]

VIRIDIS = ("440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b")
"""Ten equal steps of matplotlib's viridis less the last: perceptually uniform, told apart by colour-blind readers, and
in order of lightness on any printer. Its last yellow would hardly be seen on white."""
EMPTY = 0
"""The palette's entry of cells without a value: transparent."""
LEVELS = 255
"""The others, from the least value to the greatest."""


def make_palette() -> NDArray[np.uint8]:
    """The colours as (256, 4) RGBA: EMPTY transparent, then LEVELS steps of VIRIDIS, linear between its anchors."""
    anchors = np.array([[int(text[place : place + 2], 16) for place in (0, 2, 4)] for text in VIRIDIS], np.float64)
    steps = np.linspace(0, len(anchors) - 1, LEVELS)
    colours = np.zeros((LEVELS + 1, 4), np.uint8)
    for channel in range(3):
        colours[1:, channel] = np.round(np.interp(steps, np.arange(len(anchors)), anchors[:, channel]))
    colours[1:, 3] = 255
    return colours


def grade(values: NDArray[np.float64], least: float, greatest: float) -> Indices:
    """Palette entries of values: 1 at `least` and below, 255 at `greatest` and above, EMPTY where not a number."""
    share = np.clip((values - least) / (greatest - least), 0, 1)
    return np.where(np.isnan(share), EMPTY, 1 + np.round(np.nan_to_num(share) * (LEVELS - 1))).astype(np.uint8)


def encode_png(indices: Indices) -> bytes:
    """A PNG of palette entries (H, W), the first row uppermost; the same bytes for the same entries.

    Source: Portable Network Graphics (PNG) Specification, W3C: colour type 3, bit depth 8, filter 0.
    """
    height, width = indices.shape
    palette = make_palette()
    rows = np.zeros((height, width + 1), np.uint8)
    rows[:, 1:] = indices
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", palette[:, :3].tobytes()),
        (b"tRNS", palette[:1, 3].tobytes()),
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def encode_uri(indices: Indices) -> str:
    """The PNG as a data URI."""
    return "data:image/png;base64," + base64.b64encode(encode_png(indices)).decode("ascii")
