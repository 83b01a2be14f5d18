"""Odd encodings, line ends and separators, turned into the plain form that the line reader knows while they are read.

The plain form is ASCII-compatible text with line feeds and commas or blanks. No line is added or removed, so that line
numbers stay those of the file.
"""

import codecs
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from tracklake.pipeline.sources.csv.line_bytes import BOM

BLOCK_BYTES = 1 << 20
"""Size of a block that is converted at once, in bytes."""
FEWEST_SEPARATORS = 4
"""Fewest semicolons or tabs in the first line that can separate its fields."""
UTF_16 = {codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
"""Codecs by byte order mark."""
POINT, COMMA = re.compile(rb"^[+-]?\d*\.\d+$"), re.compile(rb"^[+-]?\d*,\d+$")
"""Patterns of numbers with a decimal point and with a decimal comma."""


@dataclass(frozen=True)
class TextForm:
    """The way in which a text differs from the plain form.

    `codec` is that of an encoding with two bytes for each character, None for UTF-8; `replacements` are single bytes of
    the decoded text, and what replaces each.
    """

    codec: str | None
    replacements: tuple[tuple[bytes, bytes], ...]

    @property
    def is_plain(self) -> bool:
        """Whether nothing has to be converted."""
        return self.codec is None and not self.replacements


def recognise_form(head: bytes) -> TextForm:
    """Recognise the form of a text by its first bytes."""
    codec = _find_codec(head)
    text = head if codec is None else head.decode(codec, errors="ignore").encode()
    text = text.removeprefix(BOM)
    replacements = []
    if b"\r" in text.strip() and b"\n" not in text:
        replacements.append((b"\r", b"\n"))
        text = text.replace(b"\r", b"\n")
    lines = text.split(b"\n")
    # The last line of the first bytes may be cut short.
    lines = [line.rstrip(b"\r") for line in lines[: max(len(lines) - 1, 1)] if line.strip()]
    separator = next((mark for mark in (b";", b"\t") if lines and _is_separator(mark, lines)), None)
    if separator is not None:
        replacements.append((separator, b","))
        cells = [cell.strip(b' "') for line in lines for cell in line.split(separator)]
        if any(map(COMMA.match, cells)) and not any(map(POINT.match, cells)):
            replacements.append((b",", b"."))
    return TextForm(codec, tuple(replacements))


def _find_codec(head: bytes) -> str | None:
    if head[:2] in UTF_16:
        return UTF_16[head[:2]]
    # Every other byte of ASCII text in two bytes for each character is zero.
    first, second = head[0:64:2], head[1:64:2]
    if len(second) > 1 and not any(second) and all(first):
        return "utf-16-le"
    return "utf-16-be" if len(second) > 1 and not any(first) and all(second) else None


def _is_separator(mark: bytes, lines: list[bytes]) -> bool:
    """Whether a character separates the fields of all lines, alone."""
    fields = [line.split(mark) for line in lines]
    if len(fields[0]) <= FEWEST_SEPARATORS or not fields[0][-1].strip():
        return False
    if mark == b";":
        return b"," not in lines[0] or len(fields[0]) > lines[0].count(b",")
    # The original text mixes tabs and runs of blanks.
    even = sum(len(found) == len(fields[0]) for found in fields)
    return 2 * even > len(fields) and not any(b" " in cell.strip() for found in fields[1:] for cell in found)


def convert_text(handle: BinaryIO, form: TextForm) -> BinaryIO:
    """Return a stream of the plain form of an open text."""
    return stream_blocks(_convert_blocks(handle, form))


def _convert_blocks(handle: BinaryIO, form: TextForm) -> Iterator[bytes]:
    decode = codecs.getincrementaldecoder(form.codec)(errors="replace").decode if form.codec else None
    table = bytes.maketrans(*map(b"".join, zip(*form.replacements, strict=True))) if form.replacements else None
    while block := handle.read(BLOCK_BYTES):
        plain = block if decode is None else decode(block).encode("utf-8", errors="replace")
        yield plain.translate(table)


class _BlockStream(io.RawIOBase):
    """Blocks of bytes, read like a file."""

    def __init__(self, blocks: Iterator[bytes]) -> None:
        self._blocks = blocks
        self._rest = memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: "memoryview[int]") -> int:  # type: ignore[override]  # BufferedReader gives these only
        while not self._rest:
            block = next(self._blocks, None)
            if block is None:
                return 0
            self._rest = memoryview(block)
        size = min(len(buffer), len(self._rest))
        buffer[:size], self._rest = self._rest[:size], self._rest[size:]
        return size


def stream_blocks(blocks: Iterator[bytes]) -> BinaryIO:
    """Return a binary file whose content is some blocks, one after the other."""
    return io.BufferedReader(_BlockStream(blocks), BLOCK_BYTES)
