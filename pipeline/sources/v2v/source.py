"""Drives of an instrumented vehicle: logs of messages, and what was sensed beside them, on one clock."""

from collections.abc import Sequence

import polars as pl

from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.csv import LINE
from tracklake.pipeline.sources.source import Canonical, Part, Source, SourceError
from tracklake.pipeline.sources.v2v.drive_tables import make_drive
from tracklake.pipeline.sources.v2v.grouping import group
from tracklake.pipeline.sources.v2v.logs import Logs, account_files, read_logs
from tracklake.pipeline.sources.v2v.recognition import TRUTH, detect
from tracklake.schemas import COMPLETENESS

DROPPED_SCHEMA = {FILE: pl.Int64(), LINE: pl.Int64(), "reason": pl.String()}
"""Columns of the messages that no drive takes: where they stand, and why."""


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the logs of a folder into drives: one, or one per receiver where a log has the messages of several.

    Raises:
        SourceError: a file cannot be read, no record states a time, the truth of one drive lies beside several, or
            a drive has several truths.
        MissingExtraError: the library for bags is not installed.
    """
    logs = read_logs(parts)
    names = _name_drives(logs, recording)
    if logs.truths and len(names) > 1:
        truth = next(part.file.name for part in parts if part.file.dialect == TRUTH)
        raise SourceError(
            f"recording {recording}: {truth} is the truth of one drive, and the logs beside it are of {len(names)} "
            f"receivers ({', '.join(names.values())}). Give each its own folder."
        )
    if len(logs.truths) > 1:
        found = " and ".join(part.file.name for part in parts if part.file.dialect == TRUTH)
        raise SourceError(
            f"recording {recording}: {found} are truths of one drive. Expected one; remove the others, or give each "
            "drive its own folder."
        )
    drives, notes, dropped = [], list(logs.notes), [pl.DataFrame(schema=DROPPED_SCHEMA)]
    files = [part.file for part in parts]
    for receiver, name in names.items():
        # The files of one folder are of one ego, also where only some of them name it.
        own = logs.messages.filter(pl.col("receiver").eq_missing(receiver)) if len(names) > 1 else logs.messages
        bag = logs.bag if receiver is None or len(names) == 1 else None
        drive, assembled = make_drive(name, recording, own, bag, logs, files)
        drives.append(drive)
        dropped.append(assembled.rejects)
        if assembled.ids_in_doubt:
            notes.append(
                f"drive {name}: {assembled.ids_in_doubt:,} temporary ids may follow one of several others and count as "
                "vehicles of their own"
            )
    log, refused = account_files(parts, logs, pl.concat(dropped), recording)
    return Canonical((), log, refused, COMPLETENESS.empty(), tuple(notes), "other", tuple(drives))


def _name_drives(logs: Logs, recording: str) -> dict[str | None, str]:
    """Name a drive for each receiver that the logs name, where there are several, and one for all that name none."""
    receivers = logs.messages["receiver"].unique().sort()
    named = receivers.drop_nulls().to_list()
    sensed = logs.bag is not None and bool(logs.bag.ego.height or len(logs.bag.images_us) or len(logs.bag.scans))
    if logs.messages.is_empty() and not sensed:
        return {}
    if len(named) < 2:
        return {None: recording}
    unnamed = sensed or receivers.null_count() > 0
    return {**({None: recording} if unnamed else {}), **{name: f"{recording}-rx{name}" for name in named}}


V2V = Source(
    name="v2v",
    title="drives of an instrumented vehicle",
    licence="that of the logs, which tracklake does not know",
    citation="the publication of these logs, which tracklake does not know",
    signature="drives: lines of BsmP1, V2V messages as JSON or hex, ROS bags",
    version=2,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    lacking="no message, position or scan is usable",
)
"""Dataset of drives; its licence and citation are those of the logs."""
