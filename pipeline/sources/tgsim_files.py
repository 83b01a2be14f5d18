"""TGSIM's files: their sites, dialects and columns, and the lane centrelines beside them."""

import re
from collections.abc import Iterator, Sequence

import polars as pl

from tracklake.pipeline.sources.csv import BOM, LINE, UNNAMED, Chunk, Layout, read_chunks, read_head
from tracklake.pipeline.sources.source import ColumnsOfFile, Grouping, RawFile, SourceError, Unit
from tracklake.schemas.raw_tgsim import RAW_TGSIM, RAW_TGSIM_CENTRELINES

PORTAL, ORIGINAL, URBAN, CENTRELINES = "tgsim-portal", "tgsim-file", "tgsim-urban", "tgsim-centrelines"
"""Dialects: names with underscores (the portal) or hyphens, the urban site's, and lane centrelines."""
SITES = {
    "i-294-l1": r"i-?294-?l-?1(?!\d)",
    "i-294-l2": r"i-?294-?l-?2(?!\d)",
    "i-90-94-moving": r"i-?90.*moving",
    "i-90-94-stationary": r"i-?90.*stationary",
    "i-395": r"i-?395",
}
"""Patterns of the freeway sites in file names, in which everything but letters and digits is a hyphen."""
AUTOMATED = ("av", "acc")
"""Names of the column that marks automated vehicles."""
URBAN_COLUMN = "speed_kf_x"
"""Column that only the urban site has."""
_CENTRELINE = re.compile(r"(x|y|ramp)[ _]?(-?\d+)")
_RUN = re.compile(r"run-?(\d+)")


def read_names(head: bytes) -> tuple[str, ...]:
    """Read the names of a file's columns from its first bytes, as the raw schema has them."""
    line = head.removeprefix(BOM).split(b"\n", 1)[0].decode("utf-8", errors="replace").strip()
    names = (name.strip().strip('"').strip().lower() for name in line.split(","))
    # A hyphen is part of a name, or the sign of a lane's number.
    return tuple(re.sub(r"-(?=\D)", "_", name) for name in names)


def detect(head: bytes, _name: str) -> str | None:
    """Recognise a file of TGSIM by its header."""
    names = read_names(head)
    if RAW_TGSIM.required - {LINE} <= {*names}:
        return ORIGINAL if b"xloc-kf" in head[:1000].lower() else PORTAL
    if {"id", "time", "xloc_kf", URBAN_COLUMN} <= {*names}:
        return URBAN
    is_centreline = 1 < len(names) == len({*names}) and all(map(_CENTRELINE.fullmatch, names))
    return CENTRELINES if is_centreline else None


def find_site(file: RawFile) -> str | None:
    """Find the site that a file's name tells."""
    name = _write_plain(file.filename)
    return next((site for site, pattern in SITES.items() if re.search(pattern, name)), None)


def find_run(file: RawFile) -> int | None:
    """Find the run that the name of a file of centrelines tells; None = all runs of its site."""
    found = _RUN.search(_write_plain(file.filename))
    return int(found[1]) if found else None


def _write_plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower())


def describe_columns(file: RawFile) -> ColumnsOfFile | None:
    """Return the columns of a trajectory file; None for another."""
    return ColumnsOfFile(build_layout(read_head(file)), RAW_TGSIM) if file.dialect in (PORTAL, ORIGINAL) else None


def group(files: Sequence[RawFile]) -> Grouping:
    """Make a unit of each trajectory file and the lane centrelines of its site; the urban site is refused."""
    lines = [file for file in files if file.dialect == CENTRELINES]
    refusals = [
        f"{file.name}: trajectories of TGSIM's urban site, whose streets cross. Expected one of the freeway sites "
        f"({', '.join(SITES)}). Leave the file out."
        for file in files
        if file.dialect == URBAN
    ]
    units, used = [], set()
    for file in files:
        if file.dialect in (PORTAL, ORIGINAL):
            site = find_site(file)
            beside = [line for line in lines if site is not None and find_site(line) == site]
            used |= {line.name for line in beside}
            units.append(Unit((file, *beside)))
    refusals += [
        f"{line.name}: lane centrelines without the trajectories of their site. Expected a trajectory file whose name "
        f"tells the same site ({', '.join(SITES)}). Give both at once, under their names as downloaded."
        for line in lines
        if line.name not in used
    ]
    return Grouping(tuple(units), tuple(refusals))


def build_layout(head: bytes) -> Layout:
    """Build the layout of a trajectory file's lines by its first bytes."""
    names = ["automated" if name in AUTOMATED else name for name in read_names(head)]
    wanted = [name for name in RAW_TGSIM.dtypes if name in names and name != LINE]
    numbers = frozenset(name for name in wanted if RAW_TGSIM.dtypes[name].is_numeric())
    return Layout(
        names=_make_unique(names, wanted),
        dtypes={name: RAW_TGSIM.dtypes[name] for name in wanted},
        required=(RAW_TGSIM.required | {"run_index"}) & {*wanted},
        thousands=numbers,
        bounds={name: limits for name, limits in RAW_TGSIM.bounds.items() if name in wanted},
    )


def _make_unique(names: Sequence[str], wanted: Sequence[str]) -> tuple[str, ...]:
    """Keep the wanted names where they stand first; others get their number."""
    return tuple(
        name if name in wanted and name not in names[:number] else f"{UNNAMED}{number + 1}"
        for number, name in enumerate(names)
    )


def read_centrelines(file: RawFile) -> tuple[pl.DataFrame, Chunk]:
    """Read a file of lane centrelines: the rows of RAW_TGSIM_CENTRELINES, and its lines.

    Raises:
        SourceError: no lane has points.
    """
    names = read_names(read_head(file))
    layout = Layout(names=names, dtypes=dict.fromkeys(names, pl.Float64()), required=frozenset())
    chunks = list(read_chunks(file, layout))
    lines = Chunk(
        pl.concat([chunk.frame for chunk in chunks]),
        pl.concat([chunk.rejects for chunk in chunks]),
        sum(chunk.rows_read for chunk in chunks),
    )
    points = pl.concat([RAW_TGSIM_CENTRELINES.empty(), *_list_lanes(lines.frame)]).drop_nulls(["x", "y"])
    if points.is_empty():
        raise SourceError(
            f"{file.name}: no points of lane centrelines. Expected numbers in columns x1, y1, ramp1, ... Restore the "
            "original file, or leave it out."
        )
    points = points.sort(RAW_TGSIM_CENTRELINES.key)
    return RAW_TGSIM_CENTRELINES.validate(points, where=file.name), lines


def _list_lanes(lines: pl.DataFrame) -> Iterator[pl.DataFrame]:
    """Yield the points of each lane whose columns the lines have."""
    found = {(kind, int(lane)): name for name in lines.columns for kind, lane in _CENTRELINE.findall(name)}
    for lane in sorted({lane for _, lane in found}):
        if ("x", lane) in found and ("y", lane) in found:
            ramp = pl.col(found["ramp", lane]) if ("ramp", lane) in found else pl.lit(None)
            points = lines.select(
                LINE, lane=pl.lit(lane), x=pl.col(found["x", lane]), y=pl.col(found["y", lane]), ramp=ramp
            )
            yield points.select(pl.col(name).cast(dtype) for name, dtype in RAW_TGSIM_CENTRELINES.dtypes.items())
