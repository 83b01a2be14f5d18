"""The line reader: every line is kept as a typed row, or rejected with line number and reason.

A file is read in chunks of whole lines. A chunk is parsed strictly at once; if that does not account for all of its
lines, this chunk alone is parsed line by line.
"""

import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count
from typing import TypeVar

import polars as pl

from tracklake.pipeline.sources.csv.line_bytes import (
    BOM,
    LINE,
    count_byte,
    count_lines,
    separate_fields,
    split_lines,
    squeeze_blanks,
)
from tracklake.pipeline.sources.csv.quoting import are_paired, unquote_thousands
from tracklake.pipeline.sources.csv.raw_files import CHUNK_BYTES, open_raw, read_whole_lines
from tracklake.pipeline.sources.layout import Layout
from tracklake.pipeline.sources.source import RawFile

Result = TypeVar("Result")

REJECT_SCHEMA = {LINE: pl.Int64(), "reason": pl.String(), "text": pl.String()}
"""Columns of the lines that were not kept."""
THOUSANDS = r"^[+-]?(\d+|\d{1,3}(,\d{3})+)(\.\d+)?$"
"""Pattern of a number that may carry thousands separators: it fits `1,156`, not `1,15`."""
EXPONENT = r"^[+-]?\d(?:\.(\d*))?[eE]([+-]?\d{1,2})$"
"""Pattern of a number in scientific notation; its groups are the fraction and the exponent."""
DIGITS_LOST = "digits lost in scientific notation (a spreadsheet rounded it)"
"""Reason to reject a whole number of which not all digits were written."""
NULL_WORDS = ("nan", "na", "n/a", "#n/a", "<na>", "null", "none")
"""Words in lower case that programs write for a missing value."""
EXACT_WHOLE = 1 << 53
"""Lowest number above which double precision skips whole numbers."""
UNNAMED = "#"
"""Mark before the number of an unwanted field whose own name is missing or taken."""
WELL_QUOTED = r'^("[^"]*"|[^",]*)(,("[^"]*"|[^",]*))*$'
"""Pattern of a line whose quotes surround whole fields."""


@dataclass(frozen=True)
class Chunk:
    """The kept rows of consecutive lines (wanted fields and `line`, Int64 from 1) and the others (REJECT_SCHEMA).

    `rows_read`, the number of data lines, is always the sum of the two.
    """

    frame: pl.DataFrame
    rejects: pl.DataFrame
    rows_read: int


def read_chunks(file: RawFile, layout: Layout, *, chunk_bytes: int = CHUNK_BYTES) -> Iterator[Chunk]:
    """Read a file chunk by chunk; see `map_chunks`."""
    return map_chunks(file, layout, lambda _number, chunk: chunk, threads=1, chunk_bytes=chunk_bytes)


def map_chunks(
    file: RawFile, layout: Layout, work: Callable[[int, Chunk], Result], *, threads: int, chunk_bytes: int = CHUNK_BYTES
) -> Iterator[Result]:
    """Apply a function of a chunk's number, from 0, and the chunk in parsing threads; yield its results in order.

    `threads` chunks are parsed and worked on at once; one more is held in memory.
    """
    return map_lines(
        file,
        lambda number, data, first_line: work(number, parse_lines(data, layout, first_line=first_line)),
        threads=threads,
        heading_lines=layout.header_lines,
        chunk_bytes=chunk_bytes,
    )


def map_lines(
    file: RawFile,
    work: Callable[[int, bytes, int], Result],
    *,
    threads: int,
    heading_lines: int = 0,
    chunk_bytes: int = CHUNK_BYTES,
) -> Iterator[Result]:
    """Apply a function of a chunk's number, its whole lines and the number of the first in threads, as `map_chunks`."""
    line = 1
    numbers = count()
    ahead: deque[Future[Result]] = deque()
    with open_raw(file) as handle, ThreadPoolExecutor(threads) as pool:
        for data in read_whole_lines(handle, chunk_bytes, file, heading_lines=heading_lines):
            if line > heading_lines:
                ahead.append(pool.submit(work, next(numbers), data, line))
            line += count_lines(data)
            if len(ahead) > threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    if line == heading_lines + 1 > 1:
        yield work(0, b"", line)  # a header without rows is not an empty file


def parse_lines(data: bytes, layout: Layout, *, first_line: int = 1) -> Chunk:
    """Parse whole lines, of which the last may lack its newline; `first_line` is the number of the first."""
    if first_line == 1:
        data = data.removeprefix(BOM)
    rows_read = count_lines(data)
    kept = _parse_strictly(data, layout, rows_read, first_line)
    if kept is not None:
        return Chunk(kept, pl.DataFrame(schema=REJECT_SCHEMA), rows_read)
    return _parse_line_by_line(data, layout, rows_read, first_line)


def _parse_strictly(data: bytes, layout: Layout, rows_read: int, first_line: int) -> pl.DataFrame | None:
    """Parse all lines at once; None if a single one cannot be accounted for."""
    # A byte order mark inside a file comes from joining files; the CSV reader accepts one only at a chunk's start.
    if b"\0" in data or (BOM[:1] in data and BOM in data):
        return None
    if not rows_read:
        return pl.DataFrame(schema={LINE: pl.Int64(), **layout.dtypes})
    if layout.blanks:
        if b"," in data or b'"' in data:
            return None
        data, layout = separate_fields(data), replace(layout, blanks=False)
    elif b'"' in data:
        if not are_paired(data):
            return None
        data = unquote_thousands(data) if layout.thousands else data
    try:
        frame = _scan(data, layout, layout.dtypes, first_line=first_line)
    except (pl.exceptions.ComputeError, pl.exceptions.NoDataError, pl.exceptions.SchemaError):
        return None
    # A line with too few fields lacks its last one. If no line does and the number of separators is right, no line
    # has too many fields either; the CSV reader would ignore those.
    if frame.height != rows_read or frame[layout.names[-1]].null_count():
        return None
    surplus = count_byte(data, layout.separator) - rows_read * (len(layout.names) - 1)
    if surplus:
        texts = [name for name in layout.names if not layout.dtypes.get(name, pl.String()).is_numeric()]
        if b'"' not in data or surplus != _count_separators(_scan_text(data, layout, texts), layout):
            return None
    frame = frame.select(pl.col(LINE).cast(pl.Int64), *layout.dtypes)
    return frame if frame.select(_is_sound(layout)).item() else None


def _count_separators(fields: pl.DataFrame, layout: Layout) -> int:
    """Count the separators inside quoted fields."""
    counts = fields.select(pl.all().str.count_matches(layout.separator, literal=True).sum())
    return int(counts.sum_horizontal().sum())


def _is_sound(layout: Layout) -> pl.Expr:
    """Return an expression that is true if no value is forbidden: empty, not finite, out of bounds or unknown."""
    sound = [pl.col(name).null_count() == 0 for name in sorted(layout.required)]
    sound += [pl.col(name).is_finite().all() for name, dtype in layout.dtypes.items() if dtype.is_float()]
    for name, (low, high) in layout.bounds.items():
        sound += [] if low is None else [pl.col(name).min().fill_null(low) >= low]
        sound += [] if high is None else [pl.col(name).max().fill_null(high) <= high]
    sound += [~_not_among(pl.col(name).unique(), allowed).any() for name, allowed in layout.choices.items()]
    # Only the line parser strips blanks around a text. Texts with given choices have none: they are compared above.
    free = [name for name, dtype in layout.dtypes.items() if dtype == pl.String() and name not in layout.choices]
    sound += [~pl.col(name).ne_missing(pl.col(name).str.strip_chars()).any() for name in free]
    sound += [~(pl.col(name) == "").any() for name in free]  # an empty field in quotes, which is empty like any other
    return pl.all_horizontal(sound)


def _is_outside(name: str, low: float | None, high: float | None) -> pl.Expr:
    below = pl.lit(value=False) if low is None else pl.col(name) < low
    above = pl.lit(value=False) if high is None else pl.col(name) > high
    return (below | above).fill_null(value=False)


def _not_among(values: pl.Expr, allowed: tuple[str, ...]) -> pl.Expr:
    return ~values.str.to_lowercase().is_in(list(allowed)).fill_null(value=True)


def _parse_line_by_line(data: bytes, layout: Layout, rows_read: int, first_line: int) -> Chunk:
    lines = split_lines(data, first_line)
    reason = _structural_reason(lines, layout)
    sound = lines.filter(reason.is_null())
    fields = _split_fields(sound["text"].str.replace_all(BOM.decode(), "", literal=True), layout)
    cells = fields.with_columns(sound[LINE]).with_columns(_drop_null_words(layout))
    numeric = [name for name, dtype in layout.dtypes.items() if dtype.is_numeric()]
    # A malformed number stays as it is and fails its cast below.
    well_formed = {name: pl.col(name).str.contains(THOUSANDS) for name in layout.thousands & layout.dtypes.keys()}
    cells = cells.with_columns(
        pl.when(yes).then(pl.col(name).str.replace_all(",", "", literal=True)).otherwise(pl.col(name)).alias(name)
        for name, yes in well_formed.items()
    ).with_columns(_write_whole(name) for name in numeric if layout.dtypes[name].is_integer())
    typed = cells.select(
        LINE,
        *(
            pl.col(name).cast(dtype, strict=False) if name in numeric else pl.col(name)
            for name, dtype in layout.dtypes.items()
        ),
    )
    checked = typed.with_columns(cells[name].alias(f"{name}.cell") for name in numeric).with_columns(
        reason=pl.coalesce(_list_value_reasons(layout, numeric))
    )
    kept = checked.filter(pl.col("reason").is_null()).select(LINE, *layout.dtypes)
    rejects = pl.concat(
        [
            lines.with_columns(reason).filter(pl.col("reason").is_not_null()),
            checked.select(LINE, "reason").filter(pl.col("reason").is_not_null()).join(lines, on=LINE),
        ],
        how="diagonal",
    ).select(pl.col(name).cast(dtype) for name, dtype in REJECT_SCHEMA.items())
    return Chunk(kept, rejects.sort(LINE), rows_read)


def _drop_null_words(layout: Layout) -> list[pl.Expr]:
    """Turn the words for a missing value into null in the columns that may be null."""
    optional = [
        name
        for name, dtype in layout.dtypes.items()
        if name not in layout.required and (dtype.is_numeric() or name in layout.choices)
    ]
    return [
        pl.when(~pl.col(name).str.to_lowercase().is_in(list(NULL_WORDS))).then(pl.col(name)).alias(name)
        for name in optional
    ]


def _write_whole(name: str) -> pl.Expr:
    """Write whole numbers without a fraction or an exponent, where that loses no digit.

    Programs without a null for whole numbers write 1156 as 1156.0, others as 1.156000e+03. A number with more digits
    before its decimal point than were written (1.12E+12) stays as it is: the others are unknown.
    """
    cell = pl.col(name).str.replace(r"^([+-]?\d+)\.0+$", "${1}")
    value = cell.cast(pl.Float64, strict=False)
    exact = ~_lost_digits(cell) & (value == value.floor()) & (value.abs() < EXACT_WHOLE)
    return pl.when(exact).then(value.cast(pl.Int64, strict=False).cast(pl.String)).otherwise(cell).alias(name)


def _lost_digits(cell: pl.Expr) -> pl.Expr:
    """Return whether a number in scientific notation lacks digits before its decimal point; null for other numbers."""
    digits = cell.str.extract(EXPONENT, 1).fill_null("").str.len_bytes().cast(pl.Int32)
    return cell.str.extract(EXPONENT, 2).cast(pl.Int32, strict=False) > digits


def _list_value_reasons(layout: Layout, numeric: list[str]) -> list[pl.Expr]:
    """List why a row's values may be rejected, in the order of precedence; `<name>.cell` is a number's text."""
    reasons = [pl.lit(None, pl.String)]
    for name in numeric:
        cell = pl.col(f"{name}.cell")
        finite = cell.cast(pl.Float64, strict=False).is_finite().fill_null(value=False)
        reasons.append(_reject_if(cell.is_not_null() & ~finite, f"not a number: {name}"))
        if layout.dtypes[name].is_integer():
            unread = cell.is_not_null() & pl.col(name).is_null()
            whole = cell.str.contains(r"^[+-]?\d+$")
            reasons.append(_reject_if(unread & _lost_digits(cell), f"{DIGITS_LOST}: {name}"))
            reasons.append(_reject_if(unread & ~whole, f"not a plain whole number: {name}"))
            reasons.append(_reject_if(unread, f"out of range: {name}"))
    reasons += [_reject_if(pl.col(name).is_null(), f"empty: {name}") for name in sorted(layout.required)]
    reasons += [
        _reject_if(_is_outside(name, *limits), f"out of range: {name}") for name, limits in layout.bounds.items()
    ]
    reasons += [
        _reject_if(_not_among(pl.col(name), allowed), f"unknown value: {name}")
        for name, allowed in layout.choices.items()
    ]
    return reasons


def _reject_if(applies: pl.Expr, reason: str) -> pl.Expr:
    return pl.when(applies).then(pl.lit(reason))


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
    """Split structurally sound lines into the wanted fields, as text; an empty field is null."""
    if text.is_empty():
        return pl.DataFrame(schema=dict.fromkeys(layout.dtypes, pl.String()))
    data = "\n".join(text.to_list()).encode()
    data = squeeze_blanks(data) if layout.blanks else data
    return _scan_text(data, layout, [*layout.dtypes]).with_columns(pl.all().str.strip_chars().replace("", None))


def _scan_text(data: bytes, layout: Layout, names: Sequence[str]) -> pl.DataFrame:
    return _scan(data, layout, dict.fromkeys(names, pl.String()), first_line=1).select(*names)


def _scan(data: bytes, layout: Layout, dtypes: Mapping[str, pl.DataType], *, first_line: int) -> pl.DataFrame:
    """Scan the fields of `dtypes`, each line's last field and its number."""
    wanted = list(dict.fromkeys((*dtypes, layout.names[-1])))
    return (
        pl.scan_csv(
            data,
            has_header=False,
            separator=layout.separator,
            quote_char=None if layout.blanks else '"',
            schema={name: dtypes.get(name, pl.String()) for name in layout.names},
            row_index_name=LINE,
            row_index_offset=first_line,
        )
        .select(LINE, *wanted)
        .collect()
    )
