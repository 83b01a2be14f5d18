"""Messages in the packed encoding (UPER) of SAE J2735, as hex digits in JSON lines with the mark of `pilot_files`."""

from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa

from tracklake.pipeline.synthetic.onboard.j2735 import encode_counts
from tracklake.pipeline.synthetic.onboard.pilot_files import describe_records
from tracklake.schemas.arrays import Bytes

BLOCK_ROWS = 20_000
"""Messages whose bits are laid out at once."""
BITS = (
    ("msgCnt", 7, 0),
    ("id", 32, 0),
    ("secMark", 16, 0),
    ("lat", 31, -900_000_000),
    ("long", 32, -1_799_999_999),
    ("elev", 16, -4096),
    ("semiMajor", 8, 0),
    ("semiMinor", 8, 0),
    ("orientation", 16, 0),
    ("transmission", 3, 0),
    ("speed", 13, 0),
    ("heading", 15, 0),
    ("angle", 8, -126),
    ("accelLong", 12, -2000),
    ("accelLat", 12, -2000),
    ("accelVert", 8, -127),
    ("accelYaw", 16, -32_767),
    ("brakes", 15, 0),
    ("width", 10, 0),
    ("length", 12, 0),
)
"""Keys of the core data in order, their widths in bits, and the counts that zeros stand for."""
LEADING_BITS = 3
"""Bits before the core data: an extension and two optional parts, all absent."""
MESSAGE_OCTETS = -(-(LEADING_BITS + sum(width for _, width, _ in BITS)) // 8)
"""Octets of a packed message."""
FRAME_OCTETS = 3 + MESSAGE_OCTETS
"""Octets of a frame: the number of the message in two, the length in one, the message."""
UNKNOWN_BRAKES = 0b10000_00_00_00_00_00
"""Brakes of which nothing is known: the first of five bits for wheels says so, the others have states of two bits."""


def encode_messages(messages: pl.DataFrame) -> pl.Series:
    """Encode messages as message frames in hex digits: `0014`, the length, the packed message."""
    counts = encode_counts(messages).with_columns(brakes=pl.lit(UNKNOWN_BRAKES, pl.Int64))
    blocks = [_pack(counts.slice(start, BLOCK_ROWS)) for start in range(0, counts.height, BLOCK_ROWS)]
    packed = b"".join(block.tobytes() for block in blocks)
    frames = pa.FixedSizeBinaryArray.from_buffers(pa.binary(FRAME_OCTETS), counts.height, [None, pa.py_buffer(packed)])
    return pl.Series("bytes", frames, dtype=pl.Binary).bin.encode("hex").str.to_uppercase()


def _pack(counts: pl.DataFrame) -> Bytes:
    """Lay out the bits of (N,) messages, most significant first, and pack them into (N, octets) frames."""
    bits = [np.zeros((counts.height, LEADING_BITS), np.uint8)]
    for key, width, least in BITS:
        number = counts[key].to_numpy() - least
        bits.append((number[:, None] >> np.arange(width)[::-1] & 1).astype(np.uint8))
    message = np.packbits(np.concatenate(bits, axis=1), axis=1)
    head = np.array([0x00, 0x14, MESSAGE_OCTETS], np.uint8)
    return np.concatenate([np.broadcast_to(head, (counts.height, 3)), message], axis=1)


def write_hex(path: Path, messages: pl.DataFrame) -> None:
    """Write messages as JSON lines with hex digits in `payload.data.bytes`.

    Args:
        path: file to write.
        messages: rows of the columns that a reader of messages returns.
    """
    data_type = "us.dot.its.jpo.ode.model.OdeHexByteArray"
    records = describe_records(messages, data_type, 6)
    data = pl.struct(pl.col("bytes"))
    payload = encode_messages(messages).to_frame().select(
        pl.struct(pl.lit(data_type).alias("dataType"), data.alias("data")).alias("payload")
    )  # fmt: skip
    records.hstack(payload).write_ndjson(path)
