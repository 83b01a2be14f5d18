"""Drives of an instrumented vehicle: logs of messages, and what was sensed beside them, on one clock."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import FILE, account_rows
from tracklake.pipeline.sources.csv import LINE
from tracklake.pipeline.sources.source import Canonical, Drive, Part, RawFile, Source, SourceError
from tracklake.pipeline.sources.v2v.bsmp1 import read_bsmp1
from tracklake.pipeline.sources.v2v.grouping import group
from tracklake.pipeline.sources.v2v.messages import MESSAGE_SCHEMA, RawMessages
from tracklake.pipeline.sources.v2v.pilot_json import read_pilot_json
from tracklake.pipeline.sources.v2v.recognition import BSMP1, HEX, PILOT_JSON, TRUTH, detect
from tracklake.pipeline.sources.v2v.truth import Truth, read_truth, resolve_truth
from tracklake.pipeline.sources.v2v.uper import read_hex
from tracklake.schemas import BSM, COMPLETENESS, DRIVES, EGO_STATES, STATIONS, SURROUNDING_TRUTH, Table

READERS: Mapping[str, Callable[[RawFile], RawMessages]] = {
    BSMP1: read_bsmp1,
    PILOT_JSON: read_pilot_json,
    HEX: read_hex,
}
"""Readers of message logs, by dialect."""


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the logs of a folder into drives: one, or one per receiver where a log has the messages of several.

    Raises:
        SourceError: a file cannot be read, no record states a time, or the truth of one drive lies beside several.
    """
    read = {
        index: READERS[part.file.dialect](part.file) for index, part in enumerate(parts) if part.file.dialect in READERS
    }
    truths = {index: read_truth(part.file) for index, part in enumerate(parts) if part.file.dialect == TRUTH}
    frames = [raw.frame.with_columns(pl.lit(index, pl.Int64).alias(FILE)) for index, raw in read.items()]
    messages = pl.concat(frames or [pl.DataFrame(schema={**MESSAGE_SCHEMA, FILE: pl.Int64()})])
    receivers = messages["receiver"].unique().sort().to_list() or [None]
    if truths and len(receivers) > 1:
        raise SourceError(
            f"recording {recording}: {parts[min(truths)].file.name} is the truth of one drive, and the logs beside it "
            f"are of {len(receivers)} receivers ({', '.join(map(str, receivers[:3]))}, ...). Give each its own folder."
        )
    synthetic = bool(truths) or any(raw.synthetic for raw in read.values())
    drives, dropped = [], []
    for receiver in receivers if not messages.is_empty() else []:
        name = recording if len(receivers) == 1 or receiver is None else f"{recording}-rx{receiver}"
        own = messages.filter(pl.col("receiver").eq_missing(receiver))
        start_us = _find_start(own, truths.values(), recording)
        assembled = assemble_messages(own, start_us)
        dropped.append(assembled.rejects)
        tables = _make_tables(assembled, truths.values(), start_us)
        facts = _describe_drive(tables, start_us, synthetic=synthetic) | {"recording": recording, "subset": name}
        drives.append(_finish_drive(name, tables, facts, [part.file for part in parts]))
    accounts: dict[int, RawMessages | Truth] = {**read, **truths}
    log, refused = account_rows(
        "v2v",
        recording,
        [replace(part, rejects=accounts[index].rejects) for index, part in enumerate(parts)],
        [accounts[index].rows_read - accounts[index].rejects.height for index in range(len(parts))],
        list(_split_reasons(dropped)),
    )
    notes = tuple(note for raw in read.values() for note in raw.notes)
    return Canonical((), log, refused, COMPLETENESS.empty(), notes, "other", tuple(drives))


@dataclass(frozen=True)
class Assembled:
    """The messages of a drive in the tables' form, and those that were dropped (file, line, reason)."""

    bsm: pl.DataFrame
    stations: pl.DataFrame
    rejects: pl.DataFrame


def assemble_messages(messages: pl.DataFrame, start_us: int) -> Assembled:
    """Number the senders and put messages on the drive's clock; the second of two of one moment is dropped."""
    numbered = messages.with_columns(
        vehicle_id=pl.coalesce("sender", "temporary_id").rank("dense").cast(pl.Int32) - 1,
        time_s=(pl.coalesce("utc_us", "received_us") - start_us) / 1e6,
        received_s=(pl.col("received_us") - start_us) / 1e6,
        lost_before=pl.lit(0),
        clock_step_s=None,
    ).sort("vehicle_id", "time_s")
    first = pl.struct("vehicle_id", "time_s").is_first_distinct()
    bsm = numbered.filter(first)
    stations = bsm.group_by("vehicle_id", maintain_order=True).agg(
        pl.col("own").first(),
        pl.col("temporary_id").unique(maintain_order=True).alias("temporary_ids"),
        (pl.col("temporary_id").n_unique() - 1).alias("id_changes"),
        pl.col("length_m", "width_m").first(),
        first_s=pl.col("time_s").first(),
        last_s=pl.col("time_s").last(),
        messages=pl.len(),
        latency_median_s=(pl.col("received_s") - pl.col("time_s")).median(),
        **dict.fromkeys(("duplicates", "invalid", "lost", "clock_steps"), pl.lit(0)),
    )
    return Assembled(bsm, stations, numbered.filter(~first).select(FILE, LINE, reason=pl.lit("duplicate message")))


def _find_start(messages: pl.DataFrame, truths: Iterable[Truth], recording: str) -> int:
    """Return the least moment that a drive's files state, in microseconds since 1970."""
    moments = messages.select(pl.col("utc_us", "received_us").min()).row(0)
    known = [moment for moment in (*moments, *(truth.start_us for truth in truths)) if moment is not None]
    if not known:
        raise SourceError(
            f"recording {recording}: none of its {messages.height:,} messages states a date. Expected a UTC time of "
            "sending or receiving; the second mark alone tells the second in an unknown minute. Give logs with times."
        )
    return int(min(known))


def _make_tables(assembled: Assembled, truths: Iterable[Truth], start_us: int) -> dict[Table, pl.DataFrame]:
    """Return the tables of a drive but for `drives`; columns of its place are added later."""
    own = assembled.bsm.filter("own").with_columns(source=pl.lit("bsm")).unique("time_s", keep="first")
    truth = [resolve_truth(each, assembled.bsm, start_us) for each in truths]
    return {
        STATIONS: assembled.stations,
        BSM: assembled.bsm,
        EGO_STATES: own.sort("time_s"),
        **({SURROUNDING_TRUTH: truth[0]} if truth else {}),
    }


def _describe_drive(tables: Mapping[Table, pl.DataFrame], start_us: int, *, synthetic: bool) -> dict[str, Any]:
    """Return the columns of `drives` that follow from a drive's other tables."""
    ego = tables[STATIONS].filter("own").sort("messages", descending=True).head(1)
    last_s = max(tables[BSM].select(pl.max_horizontal(pl.col("time_s", "received_s").max())).item() or 0.0, 0.0)
    return {
        "origin": "synthetic" if synthetic else "recorded",
        "start_utc": datetime.fromtimestamp(0, tz=UTC).replace(tzinfo=None) + timedelta(microseconds=start_us),
        "seconds": last_s,
        "ego_id": ego["vehicle_id"].item() if ego.height else None,
        "ego_length_m": ego["length_m"].item() if ego.height else None,
        "ego_width_m": ego["width_m"].item() if ego.height else None,
        "stations": tables[STATIONS].height,
        "messages": tables[BSM].height,
        "scans": 0,
        "images": 0,
    }


def _finish_drive(
    name: str, tables: Mapping[Table, pl.DataFrame], facts: Mapping[str, Any], files: Sequence[RawFile]
) -> Drive:
    """Add the row of `drives` and the columns of its place to a drive's tables."""
    row = {**facts, "source_files": [{"file": file.name, "sha256": file.sha256} for file in files]}
    place = {"dataset": pl.lit("v2v"), "subset": pl.lit(name)}
    frames = {DRIVES: pl.DataFrame([dict.fromkeys(DRIVES.dtypes) | row], schema=DRIVES.dtypes), **tables}
    return Drive(
        name,
        {table: frame.lazy().with_columns(**place).pipe(table.conform).collect() for table, frame in frames.items()},
    )


def _split_reasons(dropped: Sequence[pl.DataFrame]) -> Iterator[tuple[pl.DataFrame, str]]:
    """Yield the messages that were dropped while drives were assembled, by reason."""
    for (reason,), rows in pl.concat(dropped).group_by("reason", maintain_order=True) if dropped else ():
        yield rows, str(reason)


V2V = Source(
    name="v2v",
    title="drives of an instrumented vehicle",
    licence="that of the logs, which tracklake does not know",
    citation="the publication of these logs, which tracklake does not know",
    signature="an instrumented vehicle's logs (BsmP1, messages as JSON or hex, ROS bags)",
    version=1,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    lacking="no message is usable",
)
"""Dataset of drives; its licence and citation are those of the logs."""
