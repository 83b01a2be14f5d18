"""Delimited text to typed columns with every line accounted for: kept, or rejected with line number and reason.

A file is read in chunks of whole lines. A chunk is parsed strictly and at once; only when that does not account for
all of its lines is the chunk (not the file) looked at line by line.
"""

import gzip
import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import polars as pl
import pyarrow as pa

CHUNK_BYTES = 32 << 20
LINE = "line"
REJECT_SCHEMA = {LINE: pl.Int64(), "reason": pl.String(), "text": pl.String()}
THOUSANDS = r"^[+-]?(\d+|\d{1,3}(,\d{3})+)(\.\d+)?$"
"""A count or a length that may carry thousands separators: `1,156` is one, `1,15` is not."""


@dataclass(frozen=True)
class Layout:
    """How the lines of a file are to be read.

    Args:
        names: of all fields, in the file's order, as the raw schema calls them.
        dtypes: of the fields that are wanted.
        required: wanted fields that may not be empty.
        thousands: wanted numeric fields that may carry thousands separators.
        bounds: least and greatest value of numeric fields.
        choices: the only values a text field may have (compared in lower case).
        header_lines: 1 where line 1 names the fields, else 0.
        blanks: fields are separated by runs of blanks instead of commas.
    """

    names: tuple[str, ...]
    dtypes: Mapping[str, pl.DataType]
    required: frozenset[str]
    thousands: frozenset[str] = frozenset()
    bounds: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    header_lines: int = 1
    blanks: bool = False

    @property
    def separator(self) -> str:
        """Between fields, once runs of blanks are squeezed."""
        return " " if self.blanks else ","


@dataclass(frozen=True)
class Chunk:
    """What became of some consecutive lines.

    Args:
        frame: kept rows: the wanted fields plus `line` (Int64, from 1).
        rejects: `line`, `reason`, `text` of the others.
        rows_read: data lines seen; always the sum of the two.
    """

    frame: pl.DataFrame
    rejects: pl.DataFrame
    rows_read: int


def open_raw(path: Path) -> BinaryIO:
    """Open a raw file for reading bytes; a gzip file is read without unpacking it to disk."""
    with path.open("rb") as probe:
        magic = probe.read(2)
    return gzip.open(path, "rb") if magic == b"\x1f\x8b" else path.open("rb")  # type: ignore[return-value]


def read_chunks(path: Path, layout: Layout, *, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Chunk]:
    """Read a file chunk by chunk.

    Args:
        path: the file; gzip is recognised.
        layout: how to read its lines.
        chunk_bytes: about how much to hold at once.
    """
    first_line = 1
    with open_raw(path) as handle:
        for data in _whole_lines(handle, chunk_bytes):
            lines = data.count(b"\n") + (not data.endswith(b"\n"))
            skip = layout.header_lines if first_line == 1 else 0
            yield parse(data, layout, first_line=first_line, skip=skip)
            first_line += lines


def _whole_lines(handle: BinaryIO, chunk_bytes: int) -> Iterator[bytes]:
    rest = b""
    while block := handle.read(chunk_bytes):
        cut = block.rfind(b"\n") + 1
        if cut == 0:
            rest += block
            continue
        yield rest + block[:cut]
        rest = block[cut:]
    if rest:
        yield rest


def parse(data: bytes, layout: Layout, *, first_line: int = 1, skip: int = 0) -> Chunk:
    """Parse whole lines.

    Args:
        data: the lines; the last may lack its newline.
        layout: how to read them.
        first_line: number of the first of them in its file.
        skip: header lines at the start, neither kept nor counted.
    """
    for _ in range(skip):
        data = data[data.find(b"\n") + 1 :] if b"\n" in data else b""
    first_line += skip
    if first_line <= 2:
        data = data.removeprefix(b"\xef\xbb\xbf")
    rows_read = data.count(b"\n") + (bool(data) and not data.endswith(b"\n"))
    kept = _parse_strictly(data, layout, rows_read, first_line)
    if kept is not None:
        return Chunk(kept, pl.DataFrame(schema=REJECT_SCHEMA), rows_read)
    return _parse_line_by_line(data, layout, rows_read, first_line)


def _parse_strictly(data: bytes, layout: Layout, rows_read: int, first_line: int) -> pl.DataFrame | None:
    """All lines typed at once, or None where a single one cannot be accounted for."""
    if b"\0" in data:
        return None
    if not rows_read:
        return pl.DataFrame(schema={LINE: pl.Int64(), **layout.dtypes})
    typed = {
        name: pl.String() if name in layout.thousands else layout.dtypes.get(name, pl.String()) for name in layout.names
    }
    try:
        frame = _scan(data, layout, typed, first_line=first_line)
    except (pl.exceptions.ComputeError, pl.exceptions.NoDataError, pl.exceptions.SchemaError):
        return None
    if frame.height != rows_read:
        return None
    separated = sorted(layout.thousands & layout.dtypes.keys())
    if not all(frame[name].str.contains(THOUSANDS).all() for name in separated):
        return None
    frame = frame.with_columns(
        pl.col(LINE).cast(pl.Int64),
        *(pl.col(name).str.replace_all(",", "", literal=True).cast(layout.dtypes[name]) for name in separated),
    )
    return frame.select(LINE, *layout.dtypes) if frame.select(~_is_bad(layout).any()).item() else None


def _is_bad(layout: Layout) -> pl.Expr:
    """True for typed rows with a value that may not be: empty, not finite or not among those allowed."""
    bad = [pl.col(name).is_null() for name in sorted(layout.required)]
    bad += [
        ~pl.col(name).is_finite().fill_null(value=True) for name, dtype in layout.dtypes.items() if dtype.is_float()
    ]
    bad += [_outside(name, low, high) for name, (low, high) in layout.bounds.items()]
    bad += [_not_among(name, allowed) for name, allowed in layout.choices.items()]
    return pl.any_horizontal(bad)


def _outside(name: str, low: float | None, high: float | None) -> pl.Expr:
    below = pl.lit(value=False) if low is None else pl.col(name) < low
    above = pl.lit(value=False) if high is None else pl.col(name) > high
    return (below | above).fill_null(value=False)


def _not_among(name: str, allowed: tuple[str, ...]) -> pl.Expr:
    return ~pl.col(name).str.to_lowercase().is_in(list(allowed)).fill_null(value=True)


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


def _parse_line_by_line(data: bytes, layout: Layout, rows_read: int, first_line: int) -> Chunk:
    lines = split_lines(data, first_line)
    reason = _structural_reason(lines, layout)
    sound = lines.filter(reason.is_null())
    fields = _split_fields(sound["text"], layout)
    cells = fields.with_columns(sound[LINE])
    numeric = [name for name, dtype in layout.dtypes.items() if dtype.is_numeric()]
    # What is not well formed stays as it is and fails its cast below.
    well_formed = {name: pl.col(name).str.contains(THOUSANDS) for name in layout.thousands & layout.dtypes.keys()}
    cells = cells.with_columns(
        pl.when(yes).then(pl.col(name).str.replace_all(",", "", literal=True)).otherwise(pl.col(name)).alias(name)
        for name, yes in well_formed.items()
    )
    typed = cells.select(
        LINE,
        *(
            pl.col(name).cast(dtype, strict=False) if name in numeric else pl.col(name)
            for name, dtype in layout.dtypes.items()
        ),
    )
    complaint = pl.coalesce(_complaints(layout, numeric))
    judged = typed.with_columns(cells[name].alias(f"{name}.cell") for name in numeric).with_columns(
        complaint.alias("reason")
    )
    kept = judged.filter(pl.col("reason").is_null()).select(LINE, *layout.dtypes)
    rejects = pl.concat(
        [
            lines.with_columns(reason).filter(pl.col("reason").is_not_null()),
            judged.select(LINE, "reason").filter(pl.col("reason").is_not_null()).join(lines, on=LINE),
        ],
        how="diagonal",
    ).select(pl.col(name).cast(dtype) for name, dtype in REJECT_SCHEMA.items())
    return Chunk(kept, rejects.sort(LINE), rows_read)


def _complaints(layout: Layout, numeric: list[str]) -> list[pl.Expr]:
    """What is wrong with a row's values, the first complaint that applies; `<name>.cell` is the text of a number."""
    complaints = [pl.lit(None, pl.String)]
    for name in numeric:
        unread = pl.col(name).is_null() | ~pl.col(name).cast(pl.Float64).is_finite()
        complaints.append(_say(pl.col(f"{name}.cell").is_not_null() & unread, f"not a number: {name}"))
    complaints += [_say(pl.col(name).is_null(), f"empty: {name}") for name in sorted(layout.required)]
    complaints += [_say(_outside(name, *limits), f"out of range: {name}") for name, limits in layout.bounds.items()]
    complaints += [
        _say(_not_among(name, allowed), f"unknown value: {name}") for name, allowed in layout.choices.items()
    ]
    return complaints


def _say(applies: pl.Expr, complaint: str) -> pl.Expr:
    return pl.when(applies).then(pl.lit(complaint))


def _structural_reason(lines: pl.DataFrame, layout: Layout) -> pl.Series:
    text = pl.col("text")
    if layout.blanks:
        fields = text.str.strip_chars().str.count_matches(r"[ \t]+") + 1
        unbalanced = pl.lit(value=False)
        header = text.str.contains(r"^\s*[A-Za-z_]+(\s+[A-Za-z_]+)+\s*$")
    else:
        fields = text.str.replace_all(r'"[^"]*"', "").str.count_matches(",", literal=True) + 1
        unbalanced = text.str.count_matches('"', literal=True) % 2 == 1
        header = text.str.to_lowercase().str.starts_with(f"{layout.names[0].lower()},")
    return lines.select(
        pl.when(~pl.col("utf8")).then(pl.lit("not UTF-8"))
        .when(text.str.strip_chars() == "").then(pl.lit("blank line"))
        .when(text.str.contains("\0", literal=True)).then(pl.lit("NUL byte"))
        .when(header).then(pl.lit("repeated header"))
        .when(unbalanced).then(pl.lit("unbalanced quotes"))
        .when(fields != len(layout.names)).then(pl.format("{} fields instead of {}", fields, pl.lit(len(layout.names))))
        .alias("reason")
    ).to_series()  # fmt: skip


def _split_fields(text: pl.Series, layout: Layout) -> pl.DataFrame:
    """The wanted fields of structurally sound lines, as text; empty is null."""
    if text.is_empty():
        return pl.DataFrame(schema=dict.fromkeys(layout.dtypes, pl.String()))
    data = "\n".join(text.to_list()).encode()
    fields = _scan(data, layout, dict.fromkeys(layout.names, pl.String()), first_line=1).drop(LINE)
    return fields.with_columns(pl.all().str.strip_chars().replace("", None))


def _scan(data: bytes, layout: Layout, dtypes: Mapping[str, pl.DataType], *, first_line: int) -> pl.DataFrame:
    return (
        pl.scan_csv(
            squeeze_blanks(data) if layout.blanks else data,
            has_header=False,
            separator=layout.separator,
            quote_char=None if layout.blanks else '"',
            schema=dtypes,
            row_index_name=LINE,
            row_index_offset=first_line,
        )
        .select(LINE, *layout.dtypes)
        .collect()
    )


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
        decoded = [value.decode("utf-8", errors="replace") for value in binary.gather(damaged)]
        utf8[damaged] = ["\N{REPLACEMENT CHARACTER}" not in value for value in decoded]
        text = binary.scatter(damaged, [value.encode() for value in decoded]).cast(pl.String)
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
        for data in _whole_lines(handle, CHUNK_BYTES):
            lines = split_lines(data, first_line)
            found.append(lines.join(wanted, on=LINE, how="semi").select(LINE, "text"))
            first_line += lines.height
    return pl.concat(found) if found else pl.DataFrame(schema={LINE: pl.Int64(), "text": pl.String()})


def read_head(path: Path, size: int = 65_536) -> bytes:
    """The first bytes of a raw file (of its content, where it is compressed)."""
    with open_raw(path) as handle:
        try:
            return handle.read(size)
        except (EOFError, gzip.BadGzipFile, io.UnsupportedOperation):
            return b""
