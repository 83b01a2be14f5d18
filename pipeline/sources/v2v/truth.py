"""The truth of a synthetic drive: where the vehicles around the ego were, from the overhead recording."""

import re
from dataclasses import dataclass

import polars as pl

from tracklake.pipeline.sources.csv import BOM, LINE, REJECT_SCHEMA, Layout, read_chunks, read_head
from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.pipeline.sources.v2v.messages import POSSIBLE_US
from tracklake.schemas import BSM, SURROUNDING_TRUTH
from tracklake.schemas.drives import TICK_RATE_HZ

TRUTH_MARK = b"# tracklake drive truth"
"""First bytes of a file with the truth of a synthetic drive."""
START = re.compile(rb"start_us=(\d{1,18})\b")
"""Pattern, in the first line, of the moment of tick 0 in microseconds since 1970."""
FIELDS: dict[str, pl.DataType] = {
    name: dtype for name, dtype in SURROUNDING_TRUTH.dtypes.items() if name not in ("dataset", "subset", "vehicle_id")
} | {"temporary_id": pl.String()}
"""Columns of the file: those of `surrounding_truth`, with the id that the vehicle sends instead of the drive's own."""
TICK_US = 1_000_000 // TICK_RATE_HZ
"""Microseconds from tick to tick."""
MAX_TICK = 86_400 * TICK_RATE_HZ
"""Greatest tick of a drive, which lasts a day at most."""


@dataclass(frozen=True)
class Truth:
    """The rows of a file of truth, as far as they could be read.

    Args:
        frame: rows of FIELDS.
        rejects: `line`, `reason`, `text` of every other line.
        rows_read: data lines read.
        start_us: moment of tick 0, in microseconds since 1970; None where the file does not state it.
    """

    frame: pl.DataFrame
    rejects: pl.DataFrame
    rows_read: int
    start_us: int | None


def read_truth(file: RawFile) -> Truth:
    """Read the rows of truth; of two for the same vehicle and tick, the second is rejected.

    Raises:
        SourceError: a column is missing, the start cannot be, or the file is damaged.
    """
    head = read_head(file).removeprefix(BOM).split(b"\n")
    header = head[1].decode("utf-8", "replace") if len(head) > 1 else ""
    names = tuple(name.strip() for name in header.split(","))
    if missing := [name for name in FIELDS if name not in names]:
        raise SourceError(
            f"{file.name}, line 2: expected the columns {', '.join(FIELDS)}; {', '.join(missing)} missing. Write the "
            "drive again with `tracklake instrument`, or remove the file."
        )
    start = START.search(head[0])
    if start and not POSSIBLE_US[0] <= int(start[1]) <= POSSIBLE_US[1]:
        raise SourceError(
            f"{file.name}, line 1: start_us={int(start[1])}. Expected microseconds since 1970, of a moment between "
            "2004 and 2100. Write the drive again with `tracklake instrument`, or remove the file."
        )
    bounds = {name: limits for name, limits in SURROUNDING_TRUTH.bounds.items() if name in FIELDS}
    layout = Layout(
        names,
        {name: pl.String() if dtype == pl.Boolean else dtype for name, dtype in FIELDS.items()},
        SURROUNDING_TRUTH.required & set(FIELDS),
        bounds=bounds | {"tick": (0, MAX_TICK)},
        choices={"connected": ("true", "false")},
        header_lines=2,
    )
    chunks = list(read_chunks(file, layout))
    rows = pl.concat([chunk.frame for chunk in chunks] or [pl.DataFrame(schema={LINE: pl.Int64(), **layout.dtypes})])
    first = pl.struct("truth_id", "tick").is_first_distinct()
    again = rows.filter(~first).select(
        LINE, reason=pl.lit("duplicate row"), text=pl.format("{}, {}", "truth_id", "tick")
    )
    return Truth(
        rows.filter(first).with_columns(pl.col("connected").str.to_lowercase() == "true").select(*FIELDS),
        pl.concat([pl.DataFrame(schema=REJECT_SCHEMA), *(chunk.rejects for chunk in chunks), again]).sort(LINE),
        sum(chunk.rows_read for chunk in chunks),
        int(start[1]) if start else None,
    )


def resolve_truth(truth: Truth, bsm: pl.DataFrame, start_us: int) -> pl.DataFrame:
    """Return the rows of `surrounding_truth`, but for the columns of their place, on a drive's clock.

    A vehicle is the sender of the message with the same temporary id that is nearest in time.

    Args:
        truth: rows of a file of truth.
        bsm: messages of the drive.
        start_us: start of the drive, in microseconds since 1970.
    """
    ticks_late = 0 if truth.start_us is None else round((truth.start_us - start_us) / TICK_US)
    rows = truth.frame.with_columns(pl.col("tick") + ticks_late).with_columns(
        time_s=pl.col("tick") / TICK_RATE_HZ, temporary_id=pl.col("temporary_id").str.to_uppercase()
    )
    known = bsm.select("temporary_id", "time_s", "vehicle_id").with_columns(pl.col("temporary_id").str.to_uppercase())
    is_sent = pl.col("temporary_id").is_not_null()
    found = (
        rows.filter(is_sent)
        .sort("time_s")
        .join_asof(known.sort("time_s"), on="time_s", by="temporary_id", strategy="nearest", check_sortedness=False)
    )
    silent = rows.filter(~is_sent).with_columns(vehicle_id=pl.lit(None, BSM.dtypes["vehicle_id"]))
    return pl.concat([found, silent.select(found.columns)]).sort("truth_id", "tick").drop("temporary_id", "time_s")
