"""Access to raw files, compressed or not: chunks of whole lines, single lines, the first bytes, hash and size."""

import gzip
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import BufferedReader
from shutil import copyfileobj
from tempfile import TemporaryFile
from typing import BinaryIO, cast
from zipfile import BadZipFile

import polars as pl

from tracklake.pipeline.sources.csv.archives import measure_member, open_member
from tracklake.pipeline.sources.csv.line_bytes import BOM, LINE, split_lines
from tracklake.pipeline.sources.csv.plain_text import convert_text, recognise_form, stream_blocks
from tracklake.pipeline.sources.csv.table_files import is_table, read_as_csv
from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.schemas.hashing import hash_chunks

CHUNK_BYTES = 12 << 20
"""Size of a chunk that is read and parsed at once, in bytes."""
HASH_BYTES = 1 << 20
"""Size of a block that is hashed at once, in bytes."""
MAX_TEXT_RATIO = 40
"""Highest ratio of text to file size; more than that is the same rows again and again, and would fill the memory."""
FREE_TEXT_BYTES = 256 << 20
"""Text that every file may hold, however small it is, in bytes."""
HEAD_BYTES = 8192
"""First bytes by which encoding and separators are recognised."""
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
    """Open a raw file for reading its text in the plain form; compressed text is not unpacked to disk.

    Raises:
        SourceError: a compressed file or a table is damaged, or an archive's member cannot be read.
    """
    with ExitStack() as stack:
        packed = stack.enter_context(_open_packed(file))
        with _explain_damage(file):
            is_gzip = _is_gzip(packed)
            handle = stack.enter_context(gzip.GzipFile(fileobj=packed)) if is_gzip else packed
            head = handle.peek(HEAD_BYTES)
            # A GzipFile reads like a binary file but is not declared as one.
            plain = cast("BinaryIO", handle)
            if is_table(head):
                if is_gzip or file.member is not None:
                    plain = stack.enter_context(TemporaryFile())  # a table is not read from its start to its end
                    copyfileobj(handle, plain)
                    plain.seek(0)
                plain = stream_blocks(read_as_csv(plain, head, file.name))
            elif not (form := recognise_form(head)).is_plain:
                plain = convert_text(plain, form)
        yield plain


def hash_raw(file: RawFile) -> str:
    """Hash a file's bytes with sha256: a gzip file as it is, an archive's member unpacked."""
    with _open_packed(file) as handle:
        return hash_chunks(iter(lambda: read_block(handle, HASH_BYTES, file), b""))


def measure_unpacked(file: RawFile) -> int:
    """Measure the size of a file's text in bytes; that of a gzip file is estimated."""
    with _open_packed(file) as handle, _explain_damage(file):
        is_gzip = _is_gzip(handle)
    size = file.path.stat().st_size if file.member is None else measure_member(file)
    return size * GZIP_RATIO if is_gzip else size


def _limit_text(file: RawFile) -> int:
    """Return the most bytes of text that a file may hold, by its size."""
    packed = file.path.stat().st_size if file.member is None else measure_member(file, packed=True)
    return max(FREE_TEXT_BYTES, MAX_TEXT_RATIO * packed)


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


def read_block(handle: BinaryIO, size: int, file: RawFile) -> bytes:
    """Read some bytes of an open file.

    Raises:
        SourceError: a compressed file is damaged or cut short.
    """
    with _explain_damage(file):
        return handle.read(size)


def read_whole_lines(handle: BinaryIO, chunk_bytes: int, file: RawFile, *, heading_lines: int = 0) -> Iterator[bytes]:
    """Read an open file in chunks of whole lines; the last line may lack its newline.

    The first `heading_lines` lines are chunks of their own.

    Raises:
        SourceError: a compressed file is damaged or cut short, or holds far more text than trajectories of its size.
    """
    limit, read = _limit_text(file), 0
    with _explain_damage(file):
        for _ in range(heading_lines):
            if line := handle.readline():
                yield line
        while block := handle.read(chunk_bytes):
            if not block.endswith(b"\n"):
                block += handle.readline(limit)
            read += len(block)
            if read > limit:
                raise SourceError(
                    f"{file.name}: unpacks to more than {limit >> 20} MiB, {MAX_TEXT_RATIO} times its size. Expected "
                    f"about {GZIP_RATIO} times, as trajectories compress. It repeats the same rows, or is damaged; "
                    "look at its rows, remove the repeated ones, and run again."
                )
            yield block


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
            while len(head) < size and (block := read_block(handle, 1024, file)):
                head += block
        except SourceError:
            if not head:
                raise
    return head[:size]
