"""What a raw file is: its format, columns, counts and units, without any value of it."""

import csv
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.ingest.discovery import find_raw_files
from tracklake.pipeline.sources import RawFile, Source, SourceError
from tracklake.pipeline.sources.csv import BOM, LINE, UNNAMED, Chunk, Layout, read_chunks, read_head
from tracklake.pipeline.sources.i24 import DIALECT as I24_JSON
from tracklake.pipeline.sources.i24 import split_unusable
from tracklake.pipeline.sources.i24_documents import read_documents
from tracklake.pipeline.sources.ngsim_dialects import ALIASES, GUESSES
from tracklake.pipeline.sources.source import ColumnsOfFile
from tracklake.pipeline.sources.v2v.logs import READERS
from tracklake.schemas import BSM
from tracklake.schemas.arrays import Floats
from tracklake.schemas.markdown import RAW_TABLES
from tracklake.schemas.raw_i24 import RAW_I24

READ, LACKING, UNREAD = "read", "missing", "not read"
"""States of a column: in the file and used, known and not in the file, in the file and not used."""
UNIT_SI = {
    **{"m": 1.0, "ft": 0.3048, "feet": 0.3048, "cm": 0.01, "m/s": 1.0, "ft/s": 0.3048, "km/h": 1 / 3.6},
    **{"mph": 0.44704},
}
"""Metres, or metres a second, of one unit."""
TYPICAL = {"length": (3.0, 10.0), "width": (1.4, 3.0), "speed": (1.5, 60.0)}
"""Least and greatest plausible median of vehicles' sizes in m, and of speeds in m/s."""
LEAST_JUDGED, FEWEST_JUDGED = 0.5, 10
"""Least value in m or m/s that counts in a judgement, and the fewest such values that can be judged."""
ROLES = {
    **dict.fromkeys(("v_length", "length", "length_smoothed", "length_m"), "length"),
    **dict.fromkeys(("v_Width", "width", "width_smoothed", "width_m"), "width"),
    **dict.fromkeys(("v_Vel", "xVelocity", "speed_kf", "speed_mps"), "speed"),
}
"""What columns measure, by name."""
OTHER_ROLES = {"raw_highd_tracks": {"width": "length", "height": "width"}}
OTHER_ROLES["raw_highd_vehicles"] = OTHER_ROLES["raw_highd_tracks"]
"""What columns measure in tables where the same name means something else."""


@dataclass(frozen=True)
class Motion:
    """Columns by which positions are compared with speeds: the vehicle, the clock in so many counts a second, both."""

    vehicle: str
    clock: str
    rate_hz: float
    positions: tuple[str, str]
    speeds: tuple[str, ...]


MOTIONS = {
    "raw_highd_tracks": Motion("id", "frame", 25, ("x", "y"), ("xVelocity", "yVelocity")),
    "raw_ngsim": Motion("Vehicle_ID", "Frame_ID", 10, ("Local_X", "Local_Y"), ("v_Vel",)),
    "raw_tgsim": Motion("id", "time", 1, ("xloc_kf", "yloc_kf"), ("speed_kf",)),
}
MOTIONS |= dict.fromkeys(
    ("raw_exid_tracks", "raw_urban_tracks"),
    Motion("trackId", "frame", 25, ("xCenter", "yCenter"), ("xVelocity", "yVelocity")),
)
"""Columns of motion by raw table; the cameras' own rates."""
SHARED = {"levelx-tracks": "ind or round"}
SHARED |= dict.fromkeys(("levelx-recordingMeta", "levelx-tracksMeta"), "exid, ind or round")
"""Datasets by dialect, where several share it."""
AGREEING = (0.9, 1.1)
"""Ratios of ways to speeds times, in the median, at which the two agree."""
_NOT_PLAIN = re.compile(r"\(.*?\)|\[.*?\]|[\s_.-]+")
KNOWN = {*ALIASES, *GUESSES, *(_NOT_PLAIN.sub("", name.lower()) for table in RAW_TABLES for name in table.columns)}
"""Names of columns of all datasets, in lower case without blanks, underscores and units."""
FEWEST_KNOWN = 2
"""Fewest names of KNOWN in a line that is taken for a header; lines of data can have such a word."""


@dataclass(frozen=True)
class ColumnProbe:
    """One column: its state, unit, the share of readable rows that have a value, and whether its values fit the unit.

    `filled` and `fits` are None where the column is not read, or it is not known.
    """

    name: str
    state: str
    unit: str = ""
    filled: float | None = None
    fits: bool | None = None


@dataclass(frozen=True)
class FileProbe:
    """One file: its dataset and dialect (empty where none is recognised), lines, and columns.

    Args:
        name: name of the file within SOURCE.
        rows: data lines or messages; None where they were not counted.
        rejected: rows that cannot be read, by reason.
        motion: whether positions advance by the speeds; None where it is not known.
        problem: what kept the file from being read; empty where nothing did.
    """

    name: str
    dataset: str
    dialect: str
    rows: int | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)
    columns: tuple[ColumnProbe, ...] = ()
    motion: bool | None = None
    problem: str = ""

    @property
    def is_sound(self) -> bool:
        """Whether every row was read, and nothing is implausible."""
        unfit = any(column.fits is False for column in self.columns)
        return bool(self.dataset) and not (self.rejected or self.problem or unfit or self.motion is False)


def probe_source(path: Path) -> Iterator[FileProbe]:
    """Probe a file, or each raw file of a folder or archive.

    Raises:
        SourceError: no such file or folder.
    """
    for source, file in find_raw_files(path):
        yield _describe_unknown(file) if source is None else _probe_file(source, file)


def _probe_file(source: Source, file: RawFile) -> FileProbe:
    try:
        if file.dialect in READERS:
            return _probe_messages(source, file)
        if source.describe_columns is not None and (columns := source.describe_columns(file)) is not None:
            return _probe_table(source, file, columns)
        if file.dialect == I24_JSON:
            return _probe_documents(source, file)
    except SourceError:
        # The message may quote the file.
        problem = f"cannot be read as {file.dialect}; `tracklake ingest` says why, and may quote a line"
        return FileProbe(file.name, SHARED.get(file.dialect, source.name), file.dialect, problem=problem)
    return FileProbe(file.name, SHARED.get(file.dialect, source.name), file.dialect)


def _probe_table(source: Source, file: RawFile, described: ColumnsOfFile) -> FileProbe:
    """Read a table chunk by chunk; what is plausible is judged by the first one."""
    layout, raw, units = described.layout, described.raw, described.units
    rows, kept = 0, 0
    reasons: Counter[str] = Counter()
    empty: Counter[str] = Counter()
    first: Chunk | None = None
    for chunk in read_chunks(file, layout):
        first = first or chunk
        rows, kept = rows + chunk.rows_read, kept + chunk.frame.height
        reasons.update(dict(chunk.rejects.group_by("reason").len().iter_rows()))
        empty.update(chunk.frame.select(layout.dtypes.keys()).null_count().row(0, named=True))
    frame = pl.DataFrame(schema=layout.dtypes) if first is None else first.frame
    names = {name: units.get(name) or raw.columns[name].unit or "" for name in raw.columns if name != LINE}
    columns = [
        ColumnProbe(
            name,
            READ if name in layout.dtypes else LACKING,
            unit,
            1 - empty[name] / kept if name in layout.dtypes and kept else None,
            _judge(frame, name, unit, raw.name),
        )
        for name, unit in names.items()
    ]
    others = [name for name in layout.names if name not in layout.dtypes]
    columns += [ColumnProbe(_name_unread(name, layout), UNREAD) for name in others]
    motion = _compare_motion(frame, MOTIONS.get(raw.name), names)
    return FileProbe(
        file.name,
        SHARED.get(file.dialect, source.name),
        file.dialect,
        rows,
        dict(sorted(reasons.items())),
        tuple(columns),
        motion,
    )


def _probe_documents(source: Source, file: RawFile) -> FileProbe:
    """Read a list of I-24 MOTION's documents block by block; what is plausible is judged by the first one."""
    rows, kept = 0, 0
    reasons: Counter[str] = Counter()
    empty: Counter[str] = Counter()
    first = pl.DataFrame()
    for documents in read_documents(file):
        usable, refused = split_unusable(documents)
        first = usable if first.is_empty() else first
        rows, kept = rows + documents.read, kept + usable.height
        reasons.update(dict(refused.group_by("reason").len().iter_rows()))
        empty.update(usable.null_count().row(0, named=True))
    columns = []
    for name in (name for name in RAW_I24.columns if name in first.columns and name != LINE):
        values = first.select(pl.col(name).explode() if first[name].dtype == pl.List else name)
        filled, unit = 1 - empty[name] / kept if kept else 0.0, RAW_I24.columns[name].unit or ""
        state = READ if filled else LACKING
        columns.append(ColumnProbe(name, state, unit, filled or None, _judge(values, name, unit, RAW_I24.name)))
    return FileProbe(file.name, source.name, file.dialect, rows, dict(sorted(reasons.items())), tuple(columns))


def _name_unread(name: str, layout: Layout) -> str:
    """Return the name of a column that is not read; one without a name of its own has its number."""
    return f"column {layout.names.index(name) + 1}" if name.startswith(UNNAMED) else name.partition(UNNAMED)[0]


def _probe_messages(source: Source, file: RawFile) -> FileProbe:
    """Read a log of V2V messages, whose units are those of the lake's table of messages."""
    raw = READERS[file.dialect](file)
    columns = []
    for name in raw.frame.columns:
        if name != LINE:
            filled = 1 - raw.frame[name].null_count() / raw.frame.height if raw.frame.height else 0.0
            unit = (BSM.columns[name].unit if name in BSM.columns else None) or ""
            state = READ if filled else LACKING
            columns.append(ColumnProbe(name, state, unit, filled or None, _judge(raw.frame, name, unit, "")))
    reasons = dict(raw.rejects.group_by("reason").len().sort("reason").iter_rows())
    return FileProbe(
        file.name, SHARED.get(file.dialect, source.name), file.dialect, raw.rows_read, reasons, tuple(columns)
    )


def _judge(frame: pl.DataFrame, name: str, unit: str, table: str) -> bool | None:
    """Judge whether the median of a size or a speed is one of vehicles, in its unit; None where nothing tells."""
    role = OTHER_ROLES.get(table, {}).get(name) or ROLES.get(name)
    factor = UNIT_SI.get(unit)
    if role is None or factor is None or name not in frame.columns:
        return None
    # Standing vehicles and road users without a size do not count.
    values = frame[name].cast(pl.Float64).abs().drop_nulls() * factor
    values = values.filter(values > LEAST_JUDGED)
    median, (low, high) = values.median(), TYPICAL[role]
    return low <= median <= high if isinstance(median, float) and len(values) >= FEWEST_JUDGED else None


def _compare_motion(frame: pl.DataFrame, motion: Motion | None, units: Mapping[str, str]) -> bool | None:
    """Tell whether vehicles advance by their speeds between two rows; None where too little is known."""
    if motion is None:
        return None
    wanted = [motion.vehicle, motion.clock, *motion.positions, *motion.speeds]
    if not set(wanted) <= set(frame.columns):
        return None
    factors = [UNIT_SI.get(units[name], 1.0) for name in (*motion.positions, *motion.speeds)]
    rows = frame.select(wanted).drop_nulls().sort(motion.vehicle, motion.clock).to_numpy().astype(np.float64)
    measured: Floats = rows[:, 2:] * factors
    same = np.diff(rows[:, 0]) == 0
    seconds = np.diff(rows[:, 1]) / motion.rate_hz
    way = np.hypot(*np.diff(measured[:, :2], axis=0).T)
    speed = np.sqrt(np.sum(measured[:-1, 2:] ** 2, axis=1))
    usable = same & (seconds > 0) & (seconds < 0.5) & (speed > 2)
    if usable.sum() < FEWEST_JUDGED:
        return None
    ratio = float(np.median(way[usable] / (speed[usable] * seconds[usable])))
    return AGREEING[0] <= ratio <= AGREEING[1]


def _describe_unknown(file: RawFile) -> FileProbe:
    """Describe the columns of a file of no known format, by the names in its first line if some are known."""
    try:
        head = read_head(file)
    except SourceError:
        return FileProbe(file.name, "", "", problem="cannot be read: damaged, or a table of another kind")
    lines = head.removeprefix(BOM).decode("utf-8", errors="replace").splitlines()
    if not lines:
        return FileProbe(file.name, "", "", problem="empty")
    names = next(csv.reader(lines[:1]), [])
    known = KNOWN & {_NOT_PLAIN.sub("", name.lower()) for name in names}
    is_json = lines[0].lstrip().startswith(("{", "["))
    is_header = len(known) >= FEWEST_KNOWN and not is_json and not any(_is_number(name) for name in names)
    columns = tuple(ColumnProbe(name.strip(), UNREAD) for name in names) if is_header else ()
    problem = (
        "no known format"
        if is_header
        else f"no known format, and no header with known names; {len(names)} fields in its first line"
    )
    return FileProbe(file.name, "", "", columns=columns, problem=problem)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return not text.strip()
    return True
