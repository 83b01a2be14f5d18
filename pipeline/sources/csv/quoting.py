"""Quoted fields in CSV bytes: whether quotes surround whole fields, and numbers quoted for their separators."""

import numpy as np
import polars as pl

from tracklake.pipeline.sources.csv.line_bytes import cut_at_lines

QUOTE, COMMA, POINT, ZERO, NINE = (ord(character) for character in '",.09')
BLOCK_BYTES = 1 << 21
"""Size of a block, in bytes; larger than CACHED_BYTES since most of the work is on the few quotes' positions."""
LONGEST_GROUP = 3
"""Most digits before or after a thousands separator."""
LONGEST_FRACTION = 4
"""Most digits after the decimal point of a number that is unquoted."""


def are_paired(data: bytes) -> bool:
    """Check that quotes surround whole fields; otherwise the chunk and the line parser might disagree."""
    return b'"' not in data or all(_are_paired(np.frombuffer(block, np.uint8)) for block in cut_at_lines(data))


def _are_paired(text: np.ndarray) -> bool:
    quotes = np.flatnonzero(text == QUOTE)
    if quotes.size % 2:
        return False
    opening, closing = quotes[0::2], quotes[1::2]
    before = text[opening[opening > 0] - 1]
    closing = closing[closing + 1 < text.size]
    after = text[closing + 1]
    if not (((before == 10) | (before == COMMA)).all() and ((after == 10) | (after == 13) | (after == COMMA)).all()):
        return False
    returns = closing[after == 13] + 2
    return bool((returns < text.size).all() and (text[returns] == 10).all())


def unquote_thousands(data: bytes) -> bytes:
    """Turn quoted numbers with one thousands separator into plain ones (`"1,156.5"` to `1156.5`); quotes are paired.

    The CSV reader then parses the whole column as numbers.
    """
    return b"".join(_unquote(np.frombuffer(block, np.uint8)) for block in cut_at_lines(data, BLOCK_BYTES))


def _unquote(text: np.ndarray) -> bytes:
    quotes = np.flatnonzero(text == QUOTE)
    opening, closing = quotes[0::2], quotes[1::2]
    last = text.size - 1
    commas = [text[np.minimum(opening + 1 + digits, last)] == COMMA for digits in range(LONGEST_GROUP, 0, -1)]
    digits = np.select(commas, range(LONGEST_GROUP, 0, -1), 0)
    fits = (digits > 0) & (opening + 1 + digits + LONGEST_GROUP < closing)
    opening, closing, digits = opening[fits], closing[fits], digits[fits]
    comma = opening + 1 + digits
    sound = np.ones(comma.size, dtype=bool)
    for place in range(1, LONGEST_GROUP + 1):
        sound &= _is_digit(text[comma + place]) & ((digits < place) | _is_digit(text[comma - place]))
    # After the group the field ends, or a point and some digits follow.
    point = comma + LONGEST_GROUP + 1
    ends = point == closing
    fraction = np.flatnonzero(sound & ~ends)
    sound[fraction] = _is_fraction(text, point[fraction], closing[fraction])
    kept = np.ones(text.size, dtype=bool)
    for removed in (opening, comma, closing):
        kept[removed[sound]] = False
    return bytes(pl.Series(text).filter(pl.Series(kept)).to_numpy().tobytes())


def _is_fraction(text: np.ndarray, point: np.ndarray, closing: np.ndarray) -> np.ndarray:
    digits = closing - point - 1
    sound: np.ndarray = (text[point] == POINT) & (digits > 0) & (digits <= LONGEST_FRACTION)
    for place in range(1, LONGEST_FRACTION + 1):
        sound &= (digits < place) | _is_digit(text[np.minimum(point + place, closing)])
    return sound


def _is_digit(characters: np.ndarray) -> np.ndarray:
    return (characters >= ZERO) & (characters <= NINE)
