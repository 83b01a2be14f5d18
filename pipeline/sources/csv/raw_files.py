"""Raw files as bytes and lines: compressed or not, chunks of whole lines, the text of single lines."""

import gzip
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import BufferedReader
from typing import BinaryIO, cast
from zipfile import BadZipFile

import numpy as np
import polars as pl
import pyarrow as pa

from tracklake.pipeline.sources.csv.archives import member_bytes, open_member
from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.schemas.hashing import hash_chunks

CHUNK_BYTES = 12 << 20
HASH_BYTES = 1 << 20
CACHED_BYTES = 1 << 19
"""Byte-wise work done in blocks that stay in a core's cache takes half the time."""
LINE = "line"
BOM = b"\xef\xbb\xbf"
GZIP = b"\x1f\x8b"
GZIP_RATIO = 6
"""By which gzip makes trajectories shorter, at most."""


def _open_packed(file: RawFile) -> BufferedReader:
    return file.path.open("rb") if file.member is None else open_member(file)


def _is_gzip(handle: BufferedReader) -> bool:
    return handle.peek(len(GZIP)).startswith(GZIP)


@contextmanager
def open_raw(file: RawFile) -> Iterator[BinaryIO]:
    """Open a raw file for reading bytes; what is compressed is read without unpacking it to disk.

    Raises:
        SourceError: a zip archive is damaged, or its member cannot be read.
    """
    with ExitStack() as stack:
        handle = stack.enter_context(_open_packed(file))
        with _explain_damage(file):
            is_gzip = _is_gzip(handle)
        # A GzipFile reads as a binary file, though it is not declared as one.
        yield stack.enter_context(cast("BinaryIO", gzip.GzipFile(fileobj=handle))) if is_gzip else handle


def hash_raw(file: RawFile) -> str:
    """The sha256 of a file's bytes: those of a gzip file as it is, those of an archive's member unpacked.

    Raises:
        SourceError: a zip archive is damaged, or its member cannot be read.
    """
    with _open_packed(file) as handle:
        return hash_chunks(iter(lambda: _read_block(handle, HASH_BYTES, file), b""))


def unpacked_bytes(file: RawFile) -> int:
    """About how long a file's text is; that of a gzip file is estimated.

    Raises:
        SourceError: a zip archive is damaged, or its member cannot be read.
    """
    with _open_packed(file) as handle, _explain_damage(file):
        is_gzip = _is_gzip(handle)
    size = file.path.stat().st_size if file.member is None else member_bytes(file)
    return size * GZIP_RATIO if is_gzip else size


@contextmanager
def _explain_damage(file: RawFile) -> Iterator[None]:
    try:
        yield
    except (EOFError, gzip.BadGzipFile, BadZipFile, zlib.error) as damage:
        kind = "gzip file" if file.member is None else "zip archive"
        raise SourceError(
            f"{file.name}: the compressed file is damaged or cut short ({damage}). Expected a whole {kind}. "
            "Download it again."
        ) from None


def _read_block(handle: BinaryIO, size: int, file: RawFile) -> bytes:
    with _explain_damage(file):
        return handle.read(size)


def whole_lines(handle: BinaryIO, chunk_bytes: int, file: RawFile, *, heading_lines: int = 0) -> Iterator[bytes]:
    """The bytes of an open file in chunks that end with a line (the last one perhaps without its newline).

    Args:
        handle: the open file.
        chunk_bytes: about the size of a chunk.
        file: for messages.
        heading_lines: at the file's start, each given as a chunk of its own.

    Raises:
        SourceError: a compressed file is damaged or cut short.
    """
    with _explain_damage(file):
        for _ in range(heading_lines):
            if line := handle.readline():
                yield line
        while block := handle.read(chunk_bytes):
            yield block if block.endswith(b"\n") else block + handle.readline()


def count_lines(data: bytes) -> int:
    """Lines, the last of which may lack its newline."""
    return count_byte(data, "\n") + (bool(data) and not data.endswith(b"\n"))


def count_byte(data: bytes, character: str) -> int:
    """How often an ASCII character occurs; four times as fast as bytes.count where that is often."""
    text = np.frombuffer(data, np.uint8)
    blocks = (text[start : start + CACHED_BYTES] for start in range(0, text.size, CACHED_BYTES))
    return sum(int(np.count_nonzero(block == ord(character))) for block in blocks)


def separate_fields(data: bytes) -> bytes:
    """Fields between runs of blanks as fields between commas, for data without commas.

    Numbers may keep blanks before them, which the CSV reader passes over, so that nothing has to be moved: the first
    blank after a field becomes a comma. Where that is a line's end, line feed and blank change places.
    """
    blocks = [_separate(block) for block in cut_at_lines(data)]
    if blocks:
        blocks[-1] = blocks[-1].removesuffix(b" ")
    return b"".join(blocks)


def _separate(lines: bytes) -> bytes:
    text = np.frombuffer(lines, np.uint8)
    ends = np.flatnonzero(text == 10)
    first = text[1:] == 32
    first &= text[:-1] > 32
    marked = text.copy()
    marked[1:] += first.view(np.uint8) * np.uint8(ord(",") - 32)
    last = marked[ends - 1] if ends.size and ends[0] else np.zeros(1, np.uint8)
    if not lines.endswith(b"\n") or b"\t" in lines or b"\r" in lines or (last <= 32).any():
        return squeeze_blanks(lines).replace(b" ", b",")
    trailing = ends[last == ord(",")]
    marked[trailing - 1], marked[trailing] = 10, 32
    return marked.tobytes()


def squeeze_blanks(data: bytes) -> bytes:
    """Runs of blanks, tabs and carriage returns to one blank; none at the start or the end of a line."""
    return b"".join(_squeeze(block) for block in cut_at_lines(data))


def cut_at_lines(data: bytes, size: int = CACHED_BYTES) -> Iterator[bytes]:
    """Blocks of whole lines of about a size: byte-wise work in them stays in a core's cache."""
    start = 0
    while start < len(data):
        end = data.rfind(b"\n", start, start + size) + 1 or data.find(b"\n", start + size) + 1 or len(data)
        yield data[start:end]
        start = end


def _squeeze(data: bytes) -> bytes:
    text = np.frombuffer(data, np.uint8)
    blank = text == 32
    if b"\t" in data or b"\r" in data:
        blank |= (text == 9) | (text == 13)
        text = np.where(blank, np.uint8(32), text)
    # Of a run the last one stays, and that only before something solid.
    kept = ~blank
    kept[:-1] |= ~(blank | (text == 10))[1:]
    # Polars filters bytes ten times as fast as NumPy.
    squeezed = pl.Series(text).filter(pl.Series(kept)).to_numpy()
    starts = np.concatenate([[0], np.flatnonzero(squeezed == 10) + 1])
    leading = starts[starts < squeezed.size]
    leading = leading[squeezed[leading] == 32]
    if leading.size:
        kept = np.ones(squeezed.size, dtype=bool)
        kept[leading] = False
        squeezed = pl.Series(squeezed).filter(pl.Series(kept)).to_numpy()
    return bytes(squeezed.tobytes())


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


def fetch_lines(file: RawFile, numbers: pl.Series) -> pl.DataFrame:
    """The text of some lines of a file: `line`, `text`.

    Args:
        file: the file.
        numbers: line numbers from 1.
    """
    wanted = pl.DataFrame({LINE: numbers.cast(pl.Int64)}).unique()
    found = []
    first_line = 1
    with open_raw(file) as handle:
        for data in whole_lines(handle, CHUNK_BYTES, file):
            lines = split_lines(data.removeprefix(BOM) if first_line == 1 else data, first_line)
            found.append(lines.join(wanted, on=LINE, how="semi").select(LINE, "text"))
            first_line += lines.height
    return pl.concat(found) if found else pl.DataFrame(schema={LINE: pl.Int64(), "text": pl.String()})


def read_head(file: RawFile, size: int = 65_536) -> bytes:
    """The first bytes of a raw file (of its content, where it is compressed; up to where that is damaged).

    Raises:
        SourceError: not one byte of a compressed file can be read.
    """
    head = b""
    with open_raw(file) as handle:
        try:
            while len(head) < size and (block := _read_block(handle, 1024, file)):
                head += block
        except SourceError:
            if not head:
                raise
    return head[:size]
