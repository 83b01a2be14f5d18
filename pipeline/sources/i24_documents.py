"""The documents of a JSON list, read block by block: each is kept as a row, or rejected with its number and a reason.

A document begins where a known key, or the first key of the first one, stands behind a brace. So one that is cut short
spoils no other, and a file of any size is read in the memory that some blocks take.
"""

import io
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import polars as pl

from tracklake.pipeline.sources.csv import BOM, LINE, REJECT_SCHEMA, open_raw, read_block
from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.schemas.raw_i24 import RAW_I24_FIELDS

BLOCK_BYTES = 16 << 20
"""Size of the blocks of a file that are read at once, in bytes."""
MAX_DOCUMENT_BYTES = 256 << 20
"""Size of the largest document, in bytes; a day's longest trajectories have some MB."""
TEXT_BYTES = 500
"""First bytes of a rejected document that are kept."""
NO_DOCUMENT = "no trajectory's document: not JSON, or a value of another type"
"""Reason to reject a document that cannot be parsed."""
FIRST_KEY = re.compile(rb'^\s*\[\s*\{\s*"([^"\\]+)"\s*:')
"""Pattern of a list's beginning, up to the first key of its first document."""
SCALAR = re.compile(rb'"(length|width|height)"\s*:\s*(-?[0-9][-+0-9.eE]*)')
"""Pattern of sizes that are numbers; others are arrays."""
PLAIN_ID = re.compile(rb'"_id"\s*:\s*"?([^"{},\s]+)"?\s*,')
"""Pattern of an id that is a text or a number; others are objects."""
NOT_JSON = re.compile(rb"\b(?:NaN|-?Infinity)\b")
"""Words that Python writes for numbers which JSON does not have."""
LISTS = {name: pl.List(pl.Float64) for name in ("timestamp", "x_position", "y_position", "length", "width")}
SCHEMA: dict[str, pl.DataType | type[pl.DataType]] = {
    "_id": pl.Struct({"$oid": pl.String}),
    **LISTS,
    "coarse_vehicle_class": pl.Float64,
    "direction": pl.Float64,
}
"""Keys that are read, and their types."""


@dataclass(frozen=True)
class Documents:
    """The parsed documents of a block (SCHEMA and LINE, their numbers from 1) and the others (REJECT_SCHEMA)."""

    frame: pl.DataFrame
    rejects: pl.DataFrame
    read: int


def read_documents(file: RawFile) -> Iterator[Documents]:
    """Read the documents of a list.

    Raises:
        SourceError: no list of documents, a document of more than MAX_DOCUMENT_BYTES, or a damaged compressed file.
    """
    number = 1
    with open_raw(file) as handle:
        for texts in _split(partial(read_block, handle, file=file), file.name):
            frame, rejects = _parse(texts, number)
            yield Documents(frame, pl.DataFrame(rejects, schema=REJECT_SCHEMA, orient="row"), len(texts))
            number += len(texts)


def _split(read: Callable[[int], bytes], where: str) -> Iterator[list[bytes]]:
    """Yield the texts of the documents that end in each block; `read` returns bytes, `where` names the file."""
    waiting = read(BLOCK_BYTES).removeprefix(BOM)
    found = FIRST_KEY.match(waiting)
    if found is None:
        raise SourceError(f'{where}: no list of documents. Expected `[{{"_id": ...`, got {waiting[:40]!r}.')
    keys = b"|".join(map(re.escape, {found[1]: None, **dict.fromkeys(map(str.encode, RAW_I24_FIELDS))}))
    begin = re.compile(rb"\{\s*\"(?:" + keys + rb")\"\s*:")
    ended = False
    while not ended:
        block = read(BLOCK_BYTES)
        ended = not block
        waiting += block
        # The last document may go on in the next block.
        starts = [match.start() for match in begin.finditer(waiting)]
        cut = [*starts, len(waiting)] if ended else starts
        yield [waiting[start:end].rstrip(b" \t\r\n,]") for start, end in pairwise(cut)]
        waiting = b"" if ended else waiting[starts[-1] :]
        if len(waiting) > MAX_DOCUMENT_BYTES:
            raise SourceError(
                f"{where}: a document of more than {MAX_DOCUMENT_BYTES >> 20} MiB. Expected one for each trajectory, "
                "which have some MB. Download the file again."
            )


def _parse(texts: list[bytes], first: int) -> tuple[pl.DataFrame, list[tuple[int, str, str]]]:
    """Parse documents, of which the first has this number; where that fails, each half, down to the broken ones."""
    lines = [_write_line(text) for text in texts]
    try:
        frame = pl.read_ndjson(io.BytesIO(b"\n".join(lines)), schema=SCHEMA) if lines else pl.DataFrame(schema=SCHEMA)
        if frame.height == len(texts):
            return frame.with_columns(pl.int_range(first, first + len(texts), dtype=pl.Int64).alias(LINE)), []
    except (pl.exceptions.PolarsError, ValueError):
        pass  # Its message quotes values, which a reason must not have.
    if len(texts) == 1:
        reason = "cut short" if not texts[0].endswith(b"}") else NO_DOCUMENT
        text = texts[0][:TEXT_BYTES].decode("utf-8", errors="replace")
        return pl.DataFrame(schema={**SCHEMA, LINE: pl.Int64}), [(first, reason, text)]
    half = len(texts) // 2
    (one, rejects), (other, more) = _parse(texts[:half], first), _parse(texts[half:], first + half)
    return pl.concat([one, other]), rejects + more


def _write_line(text: bytes) -> bytes:
    """Write a document on one line, its sizes as arrays."""
    text = PLAIN_ID.sub(rb'"_id":{"$oid":"\1"},', SCALAR.sub(rb'"\1":[\2]', text), count=1)
    text = NOT_JSON.sub(b"null", text) if b"NaN" in text or b"Infinity" in text else text
    return text.replace(b"\n", b" ") if b"\n" in text else text
