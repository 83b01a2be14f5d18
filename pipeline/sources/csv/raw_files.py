"""Access to raw files, compressed or not: chunks of whole lines, single lines, the first bytes, hash and size."""

import gzip
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import BufferedReader
from typing import BinaryIO, cast
from zipfile import BadZipFile

import polars as pl

from tracklake.pipeline.sources.csv.archives import measure_member, open_member
from tracklake.pipeline.sources.csv.line_bytes import BOM, LINE, split_lines
from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.schemas.hashing import hash_chunks

CHUNK_BYTES = 12 << 20
"""Size of a chunk that is read and parsed at once, in bytes."""

HASH_BYTES = 1 << 20
"""Size of a block that is hashed at once, in bytes."""

GZIP = b"\x1f\x8b"
"""First bytes of a gzip file."""

GZIP_RATIO = 6
"""Highest compression ratio that gzip reaches on trajectories."""


def _open_packed(file: RawFile) -> BufferedReader:
    return file.path.open("rb") if file.member is None else open_member(file)


def _is_gzip(handle: BufferedReader) -> bool:
    return handle.peek(len(GZIP)).startswith(GZIP)


@contextmanager
def open_raw(file: RawFile) -> Iterator[BinaryIO]:
    """Open a raw file for reading bytes; compressed files are not unpacked to disk.

    Raises:
        SourceError: a zip archive is damaged, or its member cannot be read.
    """
    with ExitStack() as stack:
        handle = stack.enter_context(_open_packed(file))
        with _explain_damage(file):
            is_gzip = _is_gzip(handle)
        # A GzipFile reads like a binary file but is not declared as one.
        yield stack.enter_context(cast("BinaryIO", gzip.GzipFile(fileobj=handle))) if is_gzip else handle


def hash_raw(file: RawFile) -> str:
    """Hash a file's bytes with sha256: a gzip file as it is, an archive's member unpacked.

    Raises:
        SourceError: a zip archive is damaged, or its member cannot be read.
    """
    with _open_packed(file) as handle:
        return hash_chunks(iter(lambda: _read_block(handle, HASH_BYTES, file), b""))


def measure_unpacked(file: RawFile) -> int:
    """Measure the size of a file's text in bytes; that of a gzip file is estimated.

    Raises:
        SourceError: a zip archive is damaged, or its member cannot be read.
    """
    with _open_packed(file) as handle, _explain_damage(file):
        is_gzip = _is_gzip(handle)
    size = file.path.stat().st_size if file.member is None else measure_member(file)
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


def read_whole_lines(handle: BinaryIO, chunk_bytes: int, file: RawFile, *, heading_lines: int = 0) -> Iterator[bytes]:
    """Read an open file in chunks of whole lines; the last line may lack its newline.

    Args:
        handle: the open file.
        chunk_bytes: approximate size of a chunk.
        file: named in messages.
        heading_lines: number of lines at the file's start that are chunks of their own.

    Raises:
        SourceError: a compressed file is damaged or cut short.
    """
    with _explain_damage(file):
        for _ in range(heading_lines):
            if line := handle.readline():
                yield line
        while block := handle.read(chunk_bytes):
            yield block if block.endswith(b"\n") else block + handle.readline()


def fetch_lines(file: RawFile, numbers: pl.Series) -> pl.DataFrame:
    """Read the text of some lines, numbered from 1, to the columns `line`, `text`."""
    wanted = pl.DataFrame({LINE: numbers.cast(pl.Int64)}).unique()
    found = []
    first_line = 1
    with open_raw(file) as handle:
        for data in read_whole_lines(handle, CHUNK_BYTES, file):
            lines = split_lines(data.removeprefix(BOM) if first_line == 1 else data, first_line)
            found.append(lines.join(wanted, on=LINE, how="semi").select(LINE, "text"))
            first_line += lines.height
    return pl.concat(found) if found else pl.DataFrame(schema={LINE: pl.Int64(), "text": pl.String()})


def read_head(file: RawFile, size: int = 65_536) -> bytes:
    """Read the first bytes of a raw file's unpacked content, up to where it is damaged.

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
