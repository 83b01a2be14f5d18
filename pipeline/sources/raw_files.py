"""Raw files as bytes and lines: compressed or not, chunks of whole lines, the text of single lines."""

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
import polars as pl
import pyarrow as pa

from pipeline.sources.base import SourceError

CHUNK_BYTES = 32 << 20
LINE = "line"
BOM = b"\xef\xbb\xbf"


def open_raw(path: Path) -> BinaryIO:
    """Open a raw file for reading bytes; a gzip file is read without unpacking it to disk."""
    with path.open("rb") as probe:
        magic = probe.read(2)
    # A GzipFile reads as a binary file, though it is not declared as one.
    return cast("BinaryIO", gzip.open(path, "rb")) if magic == b"\x1f\x8b" else path.open("rb")


def _read_block(handle: BinaryIO, size: int, path: Path) -> bytes:
    try:
        return handle.read(size)
    except (EOFError, gzip.BadGzipFile, zlib.error) as damage:
        raise SourceError(
            f"{path.name}: the compressed file is damaged or cut short ({damage}). Expected a whole gzip file. "
            "Download it again."
        ) from None


def whole_lines(handle: BinaryIO, chunk_bytes: int, path: Path) -> Iterator[bytes]:
    """The bytes of an open file in chunks that end with a line (the last one perhaps without its newline).

    Raises:
        SourceError: a compressed file is damaged or cut short.
    """
    rest = b""
    while block := _read_block(handle, chunk_bytes, path):
        cut = block.rfind(b"\n") + 1
        if cut == 0:
            rest += block
            continue
        yield rest + block[:cut]
        rest = block[cut:]
    if rest:
        yield rest


def squeeze_blanks(data: bytes) -> bytes:
    """Runs of blanks, tabs and carriage returns to one blank; none at the start or the end of a line."""
    text = np.frombuffer(data, np.uint8)
    blank = (text == 32) | (text == 9) | (text == 13)
    last_of_run = np.empty_like(blank)
    last_of_run[:-1] = ~blank[1:] & (text[1:] != 10)
    last_of_run[-1:] = False
    text = np.where(blank, np.uint8(32), text)[~blank | last_of_run]
    leading = text == 32
    leading[1:] &= text[:-1] == 10
    squeezed: bytes = text[~leading].tobytes()
    return squeezed


def split_lines(data: bytes, first_line: int = 1) -> pl.DataFrame:
    """Lines as text: `line`, `text` (without its end, undecodable bytes replaced), `utf8` (whether it was)."""
    ends = np.flatnonzero(np.frombuffer(data, np.uint8) == 10)
    if data and not data.endswith(b"\n"):
        ends = np.append(ends, len(data))
    # An Arrow array over the same bytes: each line runs to the next one's start, its newline stripped below.
    offsets = np.concatenate([[0], np.minimum(ends + 1, len(data))]).astype(np.int64)
    buffers = [None, pa.py_buffer(offsets), pa.py_buffer(data)]
    array = pa.LargeBinaryArray.from_buffers(pa.large_binary(), len(ends), buffers)
    binary = pl.Series("text", array, dtype=pl.Binary)
    utf8 = np.ones(len(binary), dtype=bool)
    try:
        text = binary.cast(pl.String)
    except pl.exceptions.ComputeError:
        # Only lines with a byte beyond ASCII can be at fault; those few are decoded one by one.
        damaged = np.flatnonzero(np.maximum.reduceat(np.frombuffer(data, np.uint8), offsets[:-1]) > 127)
        found = binary.gather(damaged).to_list()
        decoded = [value.decode("utf-8", errors="replace").encode() for value in found]
        utf8[damaged] = [value == before for value, before in zip(decoded, found, strict=True)]
        text = binary.scatter(damaged, decoded).cast(pl.String)
    return pl.DataFrame(
        {
            LINE: pl.int_range(first_line, first_line + len(ends), eager=True, dtype=pl.Int64),
            "text": text.str.strip_suffix("\n").str.strip_suffix("\r"),
            "utf8": pl.Series(utf8),
        }
    )


def fetch_lines(path: Path, numbers: pl.Series) -> pl.DataFrame:
    """The text of some lines of a file: `line`, `text`.

    Args:
        path: the file.
        numbers: line numbers from 1.
    """
    wanted = pl.DataFrame({LINE: numbers.cast(pl.Int64)}).unique()
    found = []
    first_line = 1
    with open_raw(path) as handle:
        for data in whole_lines(handle, CHUNK_BYTES, path):
            lines = split_lines(data.removeprefix(BOM) if first_line == 1 else data, first_line)
            found.append(lines.join(wanted, on=LINE, how="semi").select(LINE, "text"))
            first_line += lines.height
    return pl.concat(found) if found else pl.DataFrame(schema={LINE: pl.Int64(), "text": pl.String()})


def read_head(path: Path, size: int = 65_536) -> bytes:
    """The first bytes of a raw file (of its content, where it is compressed; up to where that is damaged).

    Raises:
        SourceError: not one byte of a compressed file can be read.
    """
    head = b""
    with open_raw(path) as handle:
        try:
            while len(head) < size and (block := _read_block(handle, 1024, path)):
                head += block
        except SourceError:
            if not head:
                raise
    return head[:size]
