"""Basic safety messages in the unaligned packed encoding (UPER) of SAE J2735, written as hex digits.

A message frame begins with `0014`, the number of a basic safety message, and the length of what follows: one octet, or
above 127 two that begin with the bits 10. Three bits on (an extension, the optional parts) come the core data, with a
fixed number of bits for each field. Where radios and loggers put a header (WSMP, IEEE 1609.2) before the frame, the
first `0014` at a whole octet whose length fits counts.
"""

import re
from dataclasses import replace

import numpy as np
import polars as pl
import pyarrow as pa

from tracklake.pipeline.sources.csv import BOM, LINE, map_lines, read_head
from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.messages import (
    J2735,
    TRANSMISSIONS,
    Lines,
    RawMessages,
    collect_messages,
    read_times,
    screen_lines,
    write_ids,
)
from tracklake.schemas.arrays import Bytes, Integers

SKIPPED_BITS = 3
CORE_DATA = (
    ("message_count", 7, 0),
    ("temporary_id", 32, 0),
    ("second_mark_ms", 16, 0),
    ("lat_deg", 31, -900_000_000),
    ("lon_deg", 32, -1_799_999_999),
    ("elevation_m", 16, -4096),
    ("semi_major_m", 8, 0),
    ("semi_minor_m", 8, 0),
    ("orientation_deg", 16, 0),
    ("transmission", 3, 0),
    ("speed_mps", 13, 0),
    ("heading_deg", 15, 0),
    ("steering_angle_deg", 8, -126),
    ("accel_mps2", 12, -2000),
    ("lateral_accel_mps2", 12, -2000),
    ("vertical_accel_mps2", 8, -127),
    ("yaw_rate_degps", 16, -32_767),
    ("brakes", 15, 0),  # wheels 5, traction 2, anti-lock 2, stability 2, boost 2, auxiliary 2; not kept
    ("width_m", 10, 0),
    ("length_m", 12, 0),
)
"""Fields of the core data in order: name, width in bits, least value."""
CORE_OCTETS = -(-(SKIPPED_BITS + sum(width for _, width, _ in CORE_DATA)) // 8)
"""Octets that the core data and the bits before them fill."""
MESSAGE_ID = 0x14
"""Number of a basic safety message among the messages of J2735."""
LINE_PATTERN = r"^\s*(?:([^,;\s]+)(?:\s*[,;]\s*|\s+))?(?:0[xX])?([0-9A-Fa-f]+)\s*$"
"""Pattern of a line of a plain log: a time, if any, and hex digits. No text takes it more than linear time."""
HEADER_PATTERN = re.compile(r"^[A-Za-z_ ]+([,;][A-Za-z_ ]+)?$")
"""Pattern of a first line that names the columns of a plain log."""
RECOGNISED_LINES = 100
"""First lines of a file of which one must be a basic safety message."""
PARSING_THREADS = 2
"""Chunks of lines that are decoded at once."""


def decode_hex(text: pl.Series) -> pl.DataFrame:
    """Decode messages written as hex digits.

    Returns:
        one row per message: the columns of CORE_DATA but the brakes, and `reason`, null where the others are given.
    """
    digits = text.str.strip_chars().str.to_uppercase().str.strip_prefix("0X")
    packed = digits.str.decode("hex", strict=False)
    odd = (digits.str.len_bytes() % 2 == 1).fill_null(value=False)
    unread = pl.select(pl.when(odd).then(pl.lit("an odd number of hex digits")).when(packed.is_null()).then(
        pl.lit("no hex digits"))).to_series()  # fmt: skip
    octets, starts, ends = _join_octets(packed)
    row, begin, length = _find_frames(octets, starts, ends)
    other = _name_other_messages(octets, starts, ends)
    fits = (length >= CORE_OCTETS) & (begin + length <= ends[row]) & np.isin(other[row], (-1, MESSAGE_ID))
    first = np.unique(row[fits], return_index=True)[1]
    kept, begin = row[fits][first], begin[fits][first]
    core = octets[begin[:, None] + np.arange(CORE_OCTETS)]
    has_frame = pl.Series(np.isin(np.arange(len(text)), row))
    reasons = pl.DataFrame({"other": other, "has_frame": has_frame, "unread": unread}).select(
        pl.coalesce(
            "unread",
            pl.when(~pl.col("other").is_in([-1, MESSAGE_ID])).then(
                pl.format("message {} of J2735, not a basic safety message (20)", "other")
            ),
            pl.when("has_frame").then(pl.lit("the length of the message does not fit its octets")),
            pl.lit("no basic safety message (0014)"),
        ).alias("reason")
    )
    index = pl.int_range(len(text), dtype=pl.Int64, eager=True).alias("row")
    values = pl.DataFrame({"row": pl.Series(kept, dtype=pl.Int64), **_unpack(core)})
    return (
        reasons.with_columns(index)
        .join(values, on="row", how="left", maintain_order="left")
        .with_columns(pl.when(pl.col("message_count").is_null()).then("reason").alias("reason"))
        .drop("row")
    )


def _join_octets(packed: pl.Series) -> tuple[Bytes, Integers, Integers]:
    """Join packed messages to one array, with where each starts and ends; zeros follow, so that lengths can be read."""
    array = packed.fill_null(b"").to_arrow().cast(pa.large_binary())
    _, offsets, data = array.buffers()
    bounds = np.frombuffer(offsets, np.int64)[array.offset : array.offset + len(array) + 1]
    octets = np.frombuffer(data, np.uint8) if data is not None else np.zeros(0, np.uint8)
    return np.concatenate([octets, np.zeros(8, np.uint8)]), bounds[:-1], bounds[1:]


def _find_frames(octets: Bytes, starts: Integers, ends: Integers) -> tuple[Integers, Integers, Integers]:
    """Find each `0014` at a whole octet: the message it stands in, where what follows the length begins, the length."""
    found = np.flatnonzero((octets[:-8] == 0) & (octets[1:-7] == MESSAGE_ID))
    row = np.searchsorted(starts, found, side="right") - 1
    # An empty message starts where the next one does; the last of them is the one that holds the octet.
    found, row = found[found + 1 < ends[row]], row[found + 1 < ends[row]]
    begin, length = _read_lengths(octets, found + 2)
    return row, begin, length


def _read_lengths(octets: Bytes, at: Integers) -> tuple[Integers, Integers]:
    """Read lengths of one or two octets: where what follows begins, and how many octets it has; -1 for a longer one."""
    high, low = octets[at].astype(np.int64), octets[at + 1]
    short = high < 0x80
    length = np.where(short, high, np.where(high < 0xC0, (high & 0x3F) << 8 | low, -1))
    return at + np.where(short, 1, 2), length


def _name_other_messages(octets: Bytes, starts: Integers, ends: Integers) -> Integers:
    """Return the number of the message that each row is from its first octet to its last; -1 if it is none."""
    begin, length = _read_lengths(octets, starts + 2)
    number = octets[starts].astype(np.int64) << 8 | octets[starts + 1]
    return np.where((ends - starts > 4) & (number < 0x8000) & (begin + length == ends), number, -1)


def _unpack(core: Bytes) -> dict[str, pl.Series]:
    """Unpack (N, CORE_OCTETS) octets into the quantities of the core data, in the units of the columns."""
    columns = np.ascontiguousarray(core.T)
    at, values = SKIPPED_BITS, {}
    for name, width, least in CORE_DATA:
        last = (at + width - 1) // 8
        value = np.zeros(len(core), np.int64)
        for octet in range(at // 8, last + 1):
            value = value << 8 | columns[octet]
        at += width
        value = (value >> 8 * (last + 1) - at & (1 << width) - 1) + least
        values[name] = pl.Series(name, value / J2735[name][0] if name in J2735 else value)
    del values["brakes"]
    states = pl.Series(TRANSMISSIONS, dtype=pl.String).extend_constant(None, 4)
    ids = write_ids(values["temporary_id"].to_numpy().astype("u4"))
    return values | {"temporary_id": ids, "transmission": states.gather(values["transmission"])}


def recognise_hex(head: bytes) -> bool:
    """Recognise a plain log by hex digits in its first line, or the second under a header, and a message near it.

    Other messages of J2735 may come before the first basic safety message.
    """
    lines = head.removeprefix(BOM).decode("utf-8", errors="replace").splitlines()[:RECOGNISED_LINES]
    if lines and HEADER_PATTERN.match(lines[0].strip()):
        del lines[0]
    if not lines or not re.match(LINE_PATTERN, lines[0]):
        return False
    return decode_hex(pl.Series(lines).str.extract(LINE_PATTERN, 2))["reason"].is_null().any()


def read_hex(file: RawFile) -> RawMessages:
    """Read a plain log, whose lines are `hex`, or `time,hex` with the time at which a message was received.

    Times are seconds, milliseconds or microseconds since 1970, recognised by their size, or ISO 8601. Such a log does
    not tell who received its messages, nor whether the receiver sent some of them.

    Raises:
        SourceError: a compressed file is damaged.
    """
    first = read_head(file).removeprefix(BOM).split(b"\n", 1)[0].decode("utf-8", errors="replace").strip()
    header = int(bool(HEADER_PATTERN.match(first)))
    chunks = list(map_lines(file, _read_chunk, threads=PARSING_THREADS, heading_lines=header))
    return collect_messages(
        file,
        [frame for frame, _ in chunks],
        [lines.rejects for _, lines in chunks],
        sum(lines.rows_read for _, lines in chunks),
    )


def _read_chunk(_number: int, data: bytes, first_line: int) -> tuple[pl.DataFrame, Lines]:
    lines = screen_lines(data, first_line)
    kept, refused = convert_hex_lines(lines.usable)
    return kept, replace(lines, rejects=pl.concat([lines.rejects, refused]))


def convert_hex_lines(lines: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Convert lines (`line`, `text`) of a plain log to messages, and to the rejects of the others."""
    text = pl.col("text")
    parts = lines.with_columns(
        text.str.extract(LINE_PATTERN, 1).alias("time"), text.str.extract(LINE_PATTERN, 2).alias("hex")
    )
    rows = parts.with_columns(read_times(parts["time"]).alias("received_us")).hstack(decode_hex(parts["hex"]))
    reason = pl.coalesce(
        pl.when(pl.col("hex").is_null()).then(pl.lit("neither hex digits nor a time and hex digits")),
        pl.when(pl.col("time").is_not_null() & pl.col("received_us").is_null()).then(
            pl.lit("no time before the digits")
        ),
        "reason",
    )
    judged = rows.with_columns(reason.alias("reason"), own=pl.lit(value=False))
    kept = judged.filter(pl.col("reason").is_null()).drop("reason", "text", "time", "hex")
    return kept, judged.filter(pl.col("reason").is_not_null()).select(LINE, "reason", "text")
