"""Delimited text to typed columns with every line accounted for: kept, or rejected with line number and reason.

A file is read in chunks of whole lines. A chunk is parsed strictly and at once; only when that does not account for
all of its lines is the chunk (not the file) looked at line by line.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.sources.raw_files import BOM, CHUNK_BYTES, LINE, open_raw, split_lines, squeeze_blanks, whole_lines

REJECT_SCHEMA = {LINE: pl.Int64(), "reason": pl.String(), "text": pl.String()}
THOUSANDS = r"^[+-]?(\d+|\d{1,3}(,\d{3})+)(\.\d+)?$"
"""A count or a length that may carry thousands separators: `1,156` is one, `1,15` is not."""

UNNAMED = "#"
"""In the name of a field that is not wanted, precedes its number where its own name is missing or taken."""

WELL_QUOTED = r'^("[^"]*"|[^",]*)(,("[^"]*"|[^",]*))*$'
"""Quotes surround whole fields or do not occur."""


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


def read_chunks(path: Path, layout: Layout, *, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Chunk]:
    """Read a file chunk by chunk.

    Args:
        path: the file; gzip is recognised.
        layout: how to read its lines.
        chunk_bytes: about how much to hold at once.

    Raises:
        SourceError: a compressed file is damaged or cut short.
    """
    first_line = 1
    with open_raw(path) as handle:
        for data in whole_lines(handle, chunk_bytes, path):
            lines = data.count(b"\n") + (not data.endswith(b"\n"))
            skip = layout.header_lines if first_line == 1 else 0
            yield parse(data, layout, first_line=first_line, skip=skip)
            first_line += lines


def parse(data: bytes, layout: Layout, *, first_line: int = 1, skip: int = 0) -> Chunk:
    """Parse whole lines.

    Args:
        data: the lines; the last may lack its newline.
        layout: how to read them.
        first_line: number of the first of them in its file.
        skip: header lines at the start, neither kept nor counted.
    """
    if first_line == 1:
        data = data.removeprefix(BOM)
    for _ in range(skip):
        data = data[data.find(b"\n") + 1 :] if b"\n" in data else b""
    first_line += skip
    rows_read = data.count(b"\n") + (bool(data) and not data.endswith(b"\n"))
    kept = _parse_strictly(data, layout, rows_read, first_line)
    if kept is not None:
        return Chunk(kept, pl.DataFrame(schema=REJECT_SCHEMA), rows_read)
    return _parse_line_by_line(data, layout, rows_read, first_line)


def _parse_strictly(data: bytes, layout: Layout, rows_read: int, first_line: int) -> pl.DataFrame | None:
    """All lines typed at once, or None where a single one cannot be accounted for."""
    # A byte order mark inside a file comes from joining files; the CSV reader would take it only at a chunk's start.
    if b"\0" in data or BOM in data:
        return None
    if not rows_read:
        return pl.DataFrame(schema={LINE: pl.Int64(), **layout.dtypes})
    if layout.blanks:
        data = squeeze_blanks(data)
    elif not _is_well_quoted(data):
        return None
    typed = {
        name: pl.String() if name in layout.thousands else layout.dtypes.get(name, pl.String()) for name in layout.names
    }
    try:
        frame = _scan(data, layout, typed, first_line=first_line)
    except (pl.exceptions.ComputeError, pl.exceptions.NoDataError, pl.exceptions.SchemaError):
        return None
    # Where a line has too few fields its last one is missing; one with too many has failed the scan.
    if frame.height != rows_read or frame[layout.names[-1]].null_count():
        return None
    separated = sorted(layout.thousands & layout.dtypes.keys())
    if not all(frame[name].str.contains(THOUSANDS).all() for name in separated):
        return None
    empty = frame.select(pl.col(separated).null_count())
    frame = frame.with_columns(
        pl.col(LINE).cast(pl.Int64),
        *(
            pl.col(name).str.replace_all(",", "", literal=True).cast(layout.dtypes[name], strict=False)
            for name in separated
        ),
    )
    # A number that its dtype cannot hold has become null.
    if not frame.select(pl.col(separated).null_count()).equals(empty):
        return None
    return frame.select(LINE, *layout.dtypes) if frame.select(~_is_bad(layout).any()).item() else None


def _is_well_quoted(data: bytes) -> bool:
    """Whether quotes surround whole fields; elsewhere the CSV reader and the one for single lines might disagree."""
    if b'"' not in data:
        return True
    text = np.frombuffer(data, np.uint8)
    quotes = np.flatnonzero(text == ord('"'))
    if quotes.size % 2:
        return False
    opening, closing = quotes[0::2], quotes[1::2]
    before = text[opening[opening > 0] - 1]
    after = text[closing[closing + 1 < text.size] + 1]
    if not (np.isin(before, (10, 44)).all() and np.isin(after, (10, 13, 44)).all()):
        return False
    return data.count(b'"\r') == data.count(b'"\r\n')


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


def _parse_line_by_line(data: bytes, layout: Layout, rows_read: int, first_line: int) -> Chunk:
    lines = split_lines(data, first_line)
    reason = _structural_reason(lines, layout)
    sound = lines.filter(reason.is_null())
    fields = _split_fields(sound["text"].str.replace_all(BOM.decode(), "", literal=True), layout)
    cells = fields.with_columns(sound[LINE])
    numeric = [name for name, dtype in layout.dtypes.items() if dtype.is_numeric()]
    # What is not well formed stays as it is and fails its cast below.
    well_formed = {name: pl.col(name).str.contains(THOUSANDS) for name in layout.thousands & layout.dtypes.keys()}
    cells = cells.with_columns(
        pl.when(yes).then(pl.col(name).str.replace_all(",", "", literal=True)).otherwise(pl.col(name)).alias(name)
        for name, yes in well_formed.items()
    ).with_columns(
        # Programs that know no empty whole number write 1156 as 1156.0.
        pl.col(name).str.replace(r"^([+-]?\d+)\.0+$", "${1}")
        for name in numeric
        if layout.dtypes[name].is_integer()
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
        cell = pl.col(f"{name}.cell")
        finite = cell.cast(pl.Float64, strict=False).is_finite().fill_null(value=False)
        complaints.append(_say(cell.is_not_null() & ~finite, f"not a number: {name}"))
        if layout.dtypes[name].is_integer():
            unread = cell.is_not_null() & pl.col(name).is_null()
            whole = cell.str.contains(r"^[+-]?\d+$")
            complaints.append(_say(unread & ~whole, f"not a plain whole number: {name}"))
            complaints.append(_say(unread, f"out of range: {name}"))
    complaints += [_say(pl.col(name).is_null(), f"empty: {name}") for name in sorted(layout.required)]
    complaints += [_say(_outside(name, *limits), f"out of range: {name}") for name, limits in layout.bounds.items()]
    complaints += [
        _say(_not_among(name, allowed), f"unknown value: {name}") for name, allowed in layout.choices.items()
    ]
    return complaints


def _say(applies: pl.Expr, complaint: str) -> pl.Expr:
    return pl.when(applies).then(pl.lit(complaint))


def _structural_reason(lines: pl.DataFrame, layout: Layout) -> pl.Series:
    text = pl.col("text").str.replace_all(BOM.decode(), "", literal=True)
    if layout.blanks:
        fields = text.str.strip_chars(" \t\r").str.count_matches(r"[ \t\r]+") + 1
        unbalanced = misplaced = pl.lit(value=False)
        header = text.str.contains(r"^\s*[A-Za-z_]+(\s+[A-Za-z_]+)+\s*$")
    else:
        fields = text.str.replace_all(r'"[^"]*"', "").str.count_matches(",", literal=True) + 1
        unbalanced = text.str.count_matches('"', literal=True) % 2 == 1
        misplaced = ~text.str.contains(WELL_QUOTED)
        first_name = layout.names[0].lower().partition(UNNAMED)[0] or layout.names[0]
        header = text.str.to_lowercase().str.strip_chars_start(' "').str.contains(f'^{re.escape(first_name)}"?,')
    return lines.select(
        pl.when(~pl.col("utf8")).then(pl.lit("not UTF-8"))
        .when(text.str.strip_chars() == "").then(pl.lit("blank line"))
        .when(text.str.contains("\0", literal=True)).then(pl.lit("NUL byte"))
        .when(header).then(pl.lit("repeated header"))
        .when(unbalanced).then(pl.lit("unbalanced quotes"))
        .when(misplaced).then(pl.lit("misplaced quotes"))
        .when(fields != len(layout.names)).then(pl.format("{} fields instead of {}", fields, pl.lit(len(layout.names))))
        .alias("reason")
    ).to_series()  # fmt: skip


def _split_fields(text: pl.Series, layout: Layout) -> pl.DataFrame:
    """The wanted fields of structurally sound lines, as text; empty is null."""
    if text.is_empty():
        return pl.DataFrame(schema=dict.fromkeys(layout.dtypes, pl.String()))
    data = "\n".join(text.to_list()).encode()
    data = squeeze_blanks(data) if layout.blanks else data
    fields = _scan(data, layout, dict.fromkeys(layout.names, pl.String()), first_line=1).select(*layout.dtypes)
    return fields.with_columns(pl.all().str.strip_chars().replace("", None))


def _scan(data: bytes, layout: Layout, dtypes: Mapping[str, pl.DataType], *, first_line: int) -> pl.DataFrame:
    # All fields, wanted or not: the reader looks no further than the last one asked for, so that a field too many in
    # the middle of a line would shift the others unnoticed.
    return pl.scan_csv(
        data,
        has_header=False,
        separator=layout.separator,
        quote_char=None if layout.blanks else '"',
        schema=dtypes,
        row_index_name=LINE,
        row_index_offset=first_line,
    ).collect()
