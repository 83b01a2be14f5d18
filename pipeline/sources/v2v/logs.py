"""The logs of a drive's folder as they are read: messages, what bags sensed, the truth, and each file's account."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import polars as pl

from tracklake.pipeline.sources.accounting import FILE, account_rows
from tracklake.pipeline.sources.csv import LINE, REJECT_SCHEMA, measure_unpacked
from tracklake.pipeline.sources.source import Part, RawFile, SourceError
from tracklake.pipeline.sources.v2v.bags import BagContents, read_bag
from tracklake.pipeline.sources.v2v.bsmp1 import read_bsmp1
from tracklake.pipeline.sources.v2v.messages import MESSAGE_SCHEMA, SENDER_SCHEMA, RawMessages
from tracklake.pipeline.sources.v2v.pilot_json import decode_texts, read_pilot_json
from tracklake.pipeline.sources.v2v.recognition import BAGS, BSMP1, HEX, PILOT_JSON, TRUTH
from tracklake.pipeline.sources.v2v.truth import Truth, read_truth
from tracklake.pipeline.sources.v2v.uper import read_hex

READERS: Mapping[str, Callable[[RawFile], RawMessages]] = {
    BSMP1: read_bsmp1,
    PILOT_JSON: read_pilot_json,
    HEX: read_hex,
}
"""Readers of message logs, by dialect."""
MAX_TEXT_BYTES = 1 << 30
"""Most text of one drive's messages, about 11 million lines of BsmP1; reading them takes ten times as much memory."""
FILED_SCHEMA = {FILE: pl.Int64(), **REJECT_SCHEMA}
"""Columns of rejected lines and messages, with the number of their file."""


@dataclass(frozen=True)
class Logs:
    """What the files of a folder hold.

    Args:
        messages: rows of MESSAGE_SCHEMA with the number of their file.
        bag: what bags sensed; None where there is none.
        truths: truth of the drive, one per file of it.
        impossible: senders of messages that cannot be (SENDER_SCHEMA).
        rejects: rows of FILED_SCHEMA, one per line or message that was not kept.
        texts: rows of FILED_SCHEMA without reason, of messages that have no line of their own.
        rows_read: lines and messages read, by file.
        synthetic: whether a file carries the mark of generated ones.
    """

    messages: pl.DataFrame
    impossible: pl.DataFrame
    bag: BagContents | None
    truths: tuple[Truth, ...]
    rejects: pl.DataFrame
    texts: pl.DataFrame
    rows_read: tuple[int, ...]
    notes: tuple[str, ...]
    synthetic: bool


def read_logs(parts: Sequence[Part]) -> Logs:
    """Read all files of a folder, the bags together.

    Raises:
        SourceError: a file cannot be read.
        MissingExtraError: the library for bags is not installed.
    """
    bags = [index for index, part in enumerate(parts) if part.file.dialect in BAGS]
    bag = read_bag([parts[index].file for index in bags]) if bags else None
    _refuse_excess([part.file for index, part in enumerate(parts) if index not in bags])
    read: dict[int, RawMessages | Truth] = {
        index: read_truth(part.file) if part.file.dialect == TRUTH else READERS[part.file.dialect](part.file)
        for index, part in enumerate(parts)
        if index not in bags
    }
    logs = {index: raw for index, raw in read.items() if isinstance(raw, RawMessages)}
    frames = [raw.frame.with_columns(pl.lit(index, pl.Int64).alias(FILE)) for index, raw in logs.items()]
    rejects = [raw.rejects.with_columns(pl.lit(index, pl.Int64).alias(FILE)) for index, raw in read.items()]
    texts = pl.DataFrame(schema=FILED_SCHEMA)
    rows_read = {index: raw.rows_read for index, raw in read.items()}
    if bag is not None:
        place = pl.col(FILE).replace_strict(dict(enumerate(bags)), return_dtype=pl.Int64)
        texts = bag.texts.with_columns(place)
        sent, refused = _decode_messages(texts)
        frames.append(sent)
        rejects += [refused, bag.rejects.with_columns(place)]
        rows_read |= dict(zip(bags, bag.rows_read, strict=True))
    truths = tuple(raw for raw in read.values() if isinstance(raw, Truth))
    empty = pl.DataFrame(schema={**MESSAGE_SCHEMA, FILE: pl.Int64()})
    return Logs(
        pl.concat([empty, *(frame.select(empty.columns) for frame in frames)]),
        pl.concat([pl.DataFrame(schema=SENDER_SCHEMA), *(raw.impossible for raw in logs.values())]),
        bag,
        truths,
        pl.concat([pl.DataFrame(schema=FILED_SCHEMA), *(each.select(*FILED_SCHEMA) for each in rejects)]),
        texts.select(FILE, LINE, "text"),
        tuple(rows_read[index] for index in range(len(parts))),
        (*(note for raw in logs.values() for note in raw.notes), *(bag.notes if bag is not None else ())),
        bool(truths) or any(raw.synthetic for raw in logs.values()) or (bag is not None and bag.synthetic),
    )


def _refuse_excess(files: Sequence[RawFile]) -> None:
    """Refuse logs that would not fit into the memory of usual computers."""
    size = sum(map(measure_unpacked, files))
    if size > MAX_TEXT_BYTES:
        largest = max(files, key=measure_unpacked)
        raise SourceError(
            f"{largest.name}: with the logs beside it {size / 1e9:,.1f} GB of messages. Expected at most "
            f"{MAX_TEXT_BYTES / 1e9:,.1f} GB for one drive, which are read at once. Split the log by receiver or hour, "
            "each into a folder of its own; of BsmP1, `awk -F, '$1 == 12' LOG` prints what device 12 logged."
        )


def _decode_messages(texts: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Decode messages that a bag holds as text; they keep the places and times of their records.

    Returns:
        messages with the number of their file, and rows of FILED_SCHEMA of texts that are none.
    """
    numbered = texts.with_row_index("number", offset=1).with_columns(pl.col("number").cast(pl.Int64))
    sent, refused = decode_texts(numbered.select(pl.col("number").alias(LINE), "text"))
    places = numbered.select("number", FILE, pl.col(LINE).alias("place"), pl.col("received_us").alias("logged_us"))

    def put_back(frame: pl.DataFrame) -> pl.DataFrame:
        joined = frame.join(places, left_on=LINE, right_on="number", maintain_order="left")
        return joined.with_columns(pl.col("place").alias(LINE))

    # The time of the record is when the ego received the message, or sent its own.
    own = pl.col("own")
    timed = put_back(sent).with_columns(
        received_us=pl.when(~own).then(pl.coalesce("logged_us", "received_us")).otherwise("received_us"),
        utc_us=pl.when(own).then(pl.coalesce("utc_us", "logged_us")).otherwise("utc_us"),
    )
    return timed, put_back(refused)


def account_files(
    parts: Sequence[Part], logs: Logs, dropped: pl.DataFrame, recording: str
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Account for every line and message; `dropped` (file, line, reason) are those that the drives did not take.

    Returns:
        rows of schemas.INGEST_LOG, one per file, and of schemas.REJECTS.
    """
    place = [FILE, LINE]
    without_line = dropped.join(logs.texts, on=place, how="inner").select(*FILED_SCHEMA)
    rejects = pl.concat([logs.rejects, without_line]).unique(place, keep="first", maintain_order=True)
    of_lines = dropped.join(rejects, on=place, how="anti")
    own = [rejects.filter(pl.col(FILE) == index).drop(FILE) for index in range(len(parts))]
    return account_rows(
        "v2v",
        recording,
        [replace(part, rejects=refused) for part, refused in zip(parts, own, strict=True)],
        [rows - refused.height for rows, refused in zip(logs.rows_read, own, strict=True)],
        [(rows, str(reason)) for (reason,), rows in of_lines.group_by("reason", maintain_order=True)],
    )
