"""Fields of an NGSIM file, found in its first lines or in the user's mapping."""

import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import polars as pl

from tracklake.pipeline.sources.column_mapping import ESSENTIAL, UNITS, ColumnMapping, suggest_mapping
from tracklake.pipeline.sources.csv import BOM, LINE, NULL_WORDS, UNNAMED, Layout
from tracklake.pipeline.sources.ngsim_dialects import ALIASES, EXPORT_FIELDS, GUESSES, LOCATIONS, TEXT_FIELDS
from tracklake.pipeline.sources.source import SourceError
from tracklake.schemas.raw_ngsim import RAW_NGSIM

CSV, TEXT = "ngsim-csv", "ngsim-text"
CSV_BARE, TEXT_HEADED, MAPPED = f"{CSV}-no-header", f"{TEXT}-header", "columns"
"""Dialects: with commas or blanks between the fields, with a header or without, or as the user maps the columns."""
LINES = 25
"""First lines that are looked at."""
FEWEST_KNOWN = 4
"""Fewest known names in the header of a file that is taken for a recording, and refused if others are missing."""
WITH_UNIT = re.compile(r"^(.*?)\s*[\(\[](.*?)[\)\]]\s*$")
"""Pattern of a name with its unit behind it: `local_x(m)`."""
SECONDS = re.compile(r"^\d+\.\d*[1-9]\d*$")
"""Pattern of a time in seconds, which has a fraction; times in ms are whole."""

NUMBERED = {
    len(TEXT_FIELDS): TEXT_FIELDS,
    len(EXPORT_FIELDS) - 1: EXPORT_FIELDS[:-1],
    len(EXPORT_FIELDS): EXPORT_FIELDS,
}
"""Fields of files without header, by their number: the original, the first release of the arterials, the export."""


@dataclass(frozen=True)
class Heading:
    """The fields of a file.

    Args:
        names: names of all fields in the file's order; NGSIM's where they are known.
        blanks: whether runs of blanks separate fields instead of commas.
        units: units that are not NGSIM's own, by NGSIM's name.
    """

    dialect: str
    names: tuple[str, ...]
    header_lines: int
    blanks: bool
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def factors(self) -> dict[str, float]:
        """Factors from the file's units to NGSIM's, by NGSIM's name."""
        factors = {name: UNITS[name][unit] for name, unit in self.units.items() if name in self.names}
        return {name: factor for name, factor in factors.items() if factor != 1}

    def to_layout(self) -> Layout:
        """Build the layout of the file's lines; its bounds are in the file's units."""
        wanted = [name for name in RAW_NGSIM.columns if name in self.names and name != LINE]
        factors = self.factors
        bounds = {name: limits for name, limits in RAW_NGSIM.bounds.items() if name in wanted}
        for name, factor in factors.items():
            low, high = bounds.get(name, (None, None))
            bounds[name] = (None if low is None else low / factor, None if high is None else high / factor)
        headed = self.dialect in (CSV, MAPPED)
        return Layout(
            names=self.names,
            dtypes={name: pl.Float64() if name in factors else RAW_NGSIM.dtypes[name] for name in wanted},
            required=RAW_NGSIM.required & set(wanted),
            # The portal's export has them in five columns; other columns may have them too.
            thousands=frozenset(name for name in wanted if headed and RAW_NGSIM.dtypes[name].is_numeric()),
            bounds=bounds,
            choices={"Location": LOCATIONS} if "Location" in self.names else {},
            header_lines=self.header_lines,
            blanks=self.blanks,
        )


def detect(head: bytes, name: str) -> str | None:
    """Recognise an NGSIM trajectory file by its first lines; see `read_heading`."""
    heading = read_heading(head, name)
    return None if heading is None else heading.dialect


def read_heading(head: bytes, where: str, mapping: ColumnMapping | None = None) -> Heading | None:
    """Tell the fields of a file by its first lines, or return None if it is no NGSIM file.

    A first line without a number is a header, behind lines that are blank or begin with # or %. A file without header
    has the columns of the original or of the export, possibly behind an index.

    `where` names the file in messages. By a mapping of the user's, a file that lacks one of its columns is None.

    Raises:
        SourceError: the header's names are not understood, or two columns have one meaning.
    """
    lines = head.removeprefix(BOM).decode("utf-8", errors="replace").split("\n")[:LINES]
    lines = [line.rstrip("\r") for line in lines]
    at = _find_header(lines)
    rows = lines[at + 1 :] if at is not None else lines
    header = None if at is None else _split(lines[at].lstrip("#% "))
    if mapping is not None:
        return _map_fields(header, rows, at, mapping)
    if header is None or at is None:
        return _read_bare(lines)
    known, units = _match_names(header, where)
    lengths = Counter(len(_split(row)) for row in rows if row.strip())
    most = max(lengths, key=lambda length: lengths[length], default=len(header))
    if most == len(header) + 1:
        known = ["", *known]  # R writes no name above its row numbers
    if set(ESSENTIAL) <= set(known):
        if "Global_Time" not in units and _are_seconds(known, rows):
            units["Global_Time"] = "s"
        names = _make_unique(known, where)
        return Heading(CSV if "," in lines[at] else TEXT_HEADED, names, at + 1, "," not in lines[at], units)
    if most not in (len(header), len(header) + 1):
        return _read_bare(lines)  # a comment over rows of numbers
    understood = [name for name in known if name in RAW_NGSIM.columns or _guess(name)]
    numbers = max((sum(map(_is_number, _split(row))) for row in rows), default=0)
    if len(understood) >= FEWEST_KNOWN or numbers >= len(TEXT_FIELDS) - 2:
        raise SourceError(_explain_header(where, at + 1, header, known))
    return None


def _split(line: str) -> list[str]:
    fields = next(csv.reader([line.replace("\r", " ")]), []) if "," in line else line.split()
    return [each.strip().strip("\"'") for each in fields]


def _find_header(lines: Sequence[str]) -> int | None:
    """Find the first line that is neither blank nor a comment, if no field of it is a number."""
    for number, line in enumerate(lines):
        fields = [each for each in _split(line.lstrip("#% ")) if each]
        is_comment = line.lstrip().startswith(("#", "%"))
        named = len(fields) > 1 and not any(map(_is_number, fields)) and "\0" not in line and "\ufffd" not in line
        if named and (not is_comment or set(ESSENTIAL) <= set(_match_names(fields, "")[0])):
            return number
        if line.strip() and not is_comment:
            return None
    return None


def _is_number(text: str) -> bool:
    try:
        return float(text.replace(",", "")) is not None
    except ValueError:
        return text.strip().lower() in NULL_WORDS


def _match_names(header: Sequence[str], where: str) -> tuple[list[str], dict[str, str]]:
    """Match names by case, underscores, blanks and units in parentheses; return NGSIM's names, and the units."""
    names, units = [], {}
    for given in header:
        matched = WITH_UNIT.match(given)
        plain, unit = (matched[1], matched[2].strip().lower()) if matched else (given, None)
        name = ALIASES.get(re.sub(r"[\s_.-]+", "", plain.lower()), given)
        if unit is not None and name in UNITS:
            if unit not in UNITS[name] and where:
                raise SourceError(
                    f"{where}: {given!r} has a unit that is not known. Expected one of {', '.join(UNITS[name])}, got "
                    f"{unit!r}. Correct the header, or convert the column."
                )
            units[name] = unit
        names.append(name)
    return names, units


def _are_seconds(names: Sequence[str], rows: Sequence[str]) -> bool:
    if "Global_Time" not in names:
        return False
    at = names.index("Global_Time")
    return any(len(fields) > at and SECONDS.match(fields[at]) for fields in map(_split, rows))


def _read_bare(lines: Sequence[str]) -> Heading | None:
    """Tell the fields of a file without header by the number of its fields."""
    rows = [(line, fields) for line in lines if _are_numbers(fields := _split(line))]
    if not rows:
        return None
    line, fields = rows[0]
    names = NUMBERED.get(len(fields), TEXT_FIELDS)
    if len(fields) == len(TEXT_FIELDS) + 1:
        numbers = [float(found[0] or 0) for _, found in rows if len(found) == len(fields)]
        is_index = all(after - before == 1 for before, after in pairwise(numbers))
        names = (f"{UNNAMED}1", *TEXT_FIELDS) if is_index else (*TEXT_FIELDS, f"{UNNAMED}{len(fields)}")
    blanks = "," not in line
    units = {"Global_Time": "s"} if _are_seconds(names, [row for row, _ in rows]) else {}
    return Heading(TEXT if blanks else CSV_BARE, names, 0, blanks, units)


def _are_numbers(fields: Sequence[str]) -> bool:
    """Whether a line's fields are the numbers of a file without header; a few may be missing."""
    if len(fields) not in (*NUMBERED, len(TEXT_FIELDS) + 1):
        return False
    numbers = fields[:-1] if fields[-1].lower() in LOCATIONS else fields
    present = [each for each in numbers if each and each.lower() not in NULL_WORDS]
    return len(present) >= len(RAW_NGSIM.required) and all(map(_is_number, present))


def _map_fields(
    header: Sequence[str] | None, rows: Sequence[str], at: int | None, mapping: ColumnMapping
) -> Heading | None:
    sample = next((row for row in rows if row.strip()), "")
    size = len(header) if header is not None else len(_split(sample))
    names = [f"{UNNAMED}{number}" for number in range(1, size + 1)]
    for name, column in mapping.columns.items():
        if isinstance(column, str):
            if header is None or column not in header:
                return None
            names[header.index(column)] = name
        elif 1 <= column <= size:
            names[column - 1] = name
        else:
            return None
    blanks = "," not in sample
    return Heading(MAPPED, tuple(names), 0 if at is None else at + 1, blanks, mapping.units)


def _guess(column: str) -> str | None:
    return GUESSES.get(re.sub(r"[\s_.-]+", "", WITH_UNIT.sub(r"\1", column).lower()))


def _explain_header(where: str, line: int, header: Sequence[str], known: Sequence[str]) -> str:
    strange = [given for given, name in zip(header, known[-len(header) :], strict=True) if name not in ALIASES.values()]
    missing = [name for name in ESSENTIAL if name not in known]
    given = dict(zip(known[-len(header) :], header, strict=True))
    guesses = {name: given[name] for name in RAW_NGSIM.columns if name in given}
    for column in strange:
        if name := _guess(column):
            guesses.setdefault(name, column)
    return (
        f"{where}, line {line}: a header without {', '.join(missing)}. Expected NGSIM's names, got names that are not "
        f"understood: {', '.join(strange) or 'none'}. Say what the columns are: write the lines below to columns.toml, "
        f"check them and replace each `?`, and run again with `--columns columns.toml` (docs/data.md).\n\n"
        f"{suggest_mapping(guesses)}"
    )


def _make_unique(names: Sequence[str], where: str) -> tuple[str, ...]:
    """Make names unique: unknown fields are numbered if their name is missing, repeated or reserved."""
    taken = {LINE, ""}
    unique = []
    for number, name in enumerate(names, start=1):
        if name in taken and name in RAW_NGSIM.columns and name != LINE:
            raise SourceError(
                f"{where}, line 1: two columns stand for {name}. Expected one; remove or rename the other."
            )
        unique.append(f"{name}{UNNAMED}{number}" if name in taken else name)
        taken.add(name)
    return tuple(unique)


def refine(heading: Heading, units: Mapping[str, str], *, use_time: bool) -> Heading:
    """Return a heading with further units, and without Global_Time where it cannot be used."""
    unused = f"Global_Time{UNNAMED}"
    names = heading.names if use_time else tuple(unused if name == "Global_Time" else name for name in heading.names)
    return replace(heading, names=names, units={**heading.units, **units})
