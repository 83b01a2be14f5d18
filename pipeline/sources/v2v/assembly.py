"""Messages of a drive by their senders: one vehicle for each, moments on the drive's clock, and what was dropped.

First `date_messages`, then, once the drive's start is known, `assemble_messages`. The order of rows does not matter.
"""

from dataclasses import dataclass

import polars as pl

from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.csv import LINE
from tracklake.pipeline.sources.v2v.clocks import count_seconds, find_clock_steps, find_generation_times
from tracklake.pipeline.sources.v2v.messages import MEASURED
from tracklake.pipeline.sources.v2v.temporary_ids import link_ids
from tracklake.schemas import BSM, STATIONS
from tracklake.schemas.columns import PLACE

REPEATED_US = 50_000
"""Messages of one sender with one counter are the same message where they are less than this apart, in microseconds."""
RATE_HZ = 10
"""Messages that a vehicle sends in a second."""
COUNTS = 128
"""Numbers of the counter, after which it starts again."""
MAX_SILENCE_US = 86_400_000_000
"""Silence of a log in microseconds, a day, beyond which a few messages alone have a wrong time."""
FEW_MESSAGES = 10
"""Number of messages, of a second of one vehicle, below which they are no drive of their own."""
UNDATED, REPEATED, SAME_MOMENT = "no date", "duplicate message", "another message of the sender has this moment"
FAR = "a day or more from the other messages of the drive"
"""Reasons to drop a message."""


@dataclass(frozen=True)
class Assembled:
    """The messages of a drive in the tables' form.

    Args:
        bsm: rows of schemas.BSM but for the columns of its place.
        stations: rows of schemas.STATIONS, likewise.
        rejects: FILE, LINE, `reason` of messages that were dropped.
        ids_in_doubt: changes of temporary ids that could not be linked, because several vehicles were near.
    """

    bsm: pl.DataFrame
    stations: pl.DataFrame
    rejects: pl.DataFrame
    ids_in_doubt: int = 0


SENDER = ("device", "id")
"""What identifies a sender: the device where a log knows it, else the temporary id; neither for the receiver itself."""


def date_messages(messages: pl.DataFrame) -> pl.DataFrame:
    """Find when and by whom messages were sent, which of them repeat others, and where clocks stepped.

    Args:
        messages: rows of MESSAGE_SCHEMA and FILE, of one receiver.

    Returns:
        the same rows with SENDER, its number `sent_by`, `is_repeated`, `is_far` (whether its time must be wrong),
        `clock_step_us` and `is_timed` (whether the sender's clock tells when a message was generated). `utc_us` is that
        moment, less the clock's steps against the receiver's, else the moment of reception; null where nothing tells.
    """
    messages = _find_devices(messages)
    dated = messages.with_columns(
        find_generation_times(messages),
        *_name_senders(),
        is_timed=pl.col("utc_us").is_not_null() | pl.col("second_mark_ms").is_not_null(),
        row=pl.int_range(pl.len(), dtype=pl.Int64),
    )
    senders = dated.select(SENDER).unique().sort(SENDER).with_row_index("sent_by")
    dated = dated.join(senders, on=SENDER, how="left", nulls_equal=True, maintain_order="left")
    dated = dated.with_columns(_find_repeated(dated))
    comparable = dated.filter("is_timed", ~pl.col("is_repeated"), ~pl.col("own"), pl.col("received_us").is_not_null())
    stepped = find_clock_steps(comparable.select("row", "sent_by", "utc_us", "received_us", FILE, LINE))
    moved = dated.join(stepped.select("row", "clock_step_us", moved_us="utc_us"), on="row", how="left").with_columns(
        pl.coalesce("moved_us", "utc_us").alias("utc_us")
    )
    return moved.with_columns(_find_far(moved)).drop("moved_us", "row")


def _find_far(moved: pl.DataFrame) -> pl.Series:
    """Mark messages, a few together, that a silence of a day or more parts from the others: their time is wrong.

    One of them would stretch the drive over years. Logs of several days, each with more messages, are left as they are.
    """
    moment = pl.col("utc_us")
    ordered = moved.select("row", "utc_us").drop_nulls().sort("utc_us")
    size = pl.len().over((moment.diff() >= MAX_SILENCE_US).fill_null(value=False).cum_sum())
    far = ordered.with_columns(size=size).filter(
        pl.col("size") < FEW_MESSAGES, pl.col("size").max() >= FEW_MESSAGES
    )  # fmt: skip
    return moved["row"].is_in(far["row"].implode()).alias("is_far")


def _find_devices(messages: pl.DataFrame) -> pl.DataFrame:
    """Find the devices of messages in a log without them by their temporary ids in another log, which has devices."""
    if messages["sender"].null_count() in (0, messages.height):
        return messages
    known = messages.filter(~pl.col("own")).select("temporary_id", known="sender").drop_nulls().unique()
    known = known.filter(known["temporary_id"].is_unique())
    found = messages.join(known, on="temporary_id", how="left", maintain_order="left")
    return found.with_columns(pl.coalesce("sender", "known").alias("sender")).drop("known")


def _name_senders() -> tuple[pl.Expr, pl.Expr]:
    """Return the columns of SENDER."""
    own, sender = pl.col("own"), pl.col("sender")
    by_id = pl.when(~own & sender.is_null()).then("temporary_id")
    return pl.when(~own).then(sender).alias("device"), by_id.alias("id")


def _find_repeated(dated: pl.DataFrame) -> pl.Series:
    """Mark messages that repeat another one of the same sender, counter and moment.

    The one that was received first is kept, then the one that states most, then the first in the files.
    """
    unknown = pl.sum_horizontal(pl.col(name).is_null() for name in MEASURED)
    ordered = dated.select(
        "row", "sent_by", "message_count", "utc_us", "received_us", FILE, LINE, unknown=unknown
    ).sort("sent_by", "message_count", "utc_us")
    same = pl.all_horizontal(pl.col(name).eq_missing(pl.col(name).shift(1)) for name in ("sent_by", "message_count"))
    near = (pl.col("utc_us").diff() < REPEATED_US).fill_null(value=False)
    grouped = ordered.with_columns(group=(~(same & near)).cum_sum())
    several = grouped.filter(grouped["group"].is_duplicated())
    best = several.sort("group", "received_us", "unknown", "utc_us", FILE, LINE, nulls_last=True)
    again = best.filter(~pl.col("group").is_first_distinct())["row"]
    return dated["row"].is_in(again.implode()).alias("is_repeated")


def assemble_messages(messages: pl.DataFrame, start_us: int, impossible: pl.DataFrame | None = None) -> Assembled:
    """Turn what `date_messages` returns into the tables of a drive.

    Args:
        messages: all messages of one receiver.
        start_us: the drive's start, in microseconds since 1970; no later than the least `utc_us` and `received_us`.
        impossible: senders of messages that the readers refused (SENDER_SCHEMA), to be counted by vehicle.
    """
    reasons = {UNDATED: pl.col("utc_us").is_null(), FAR: pl.col("is_far"), REPEATED: pl.col("is_repeated")}
    dropped = pl.coalesce(pl.when(applies).then(pl.lit(reason)) for reason, applies in reasons.items())
    ordered = messages.with_columns(dropped.alias("reason")).sort("reason", "sent_by", "utc_us", FILE, LINE)
    same = [pl.col(name).eq_missing(pl.col(name).shift(1)) for name in ("reason", "sent_by", "utc_us")]
    ordered = ordered.with_columns(
        pl.when(pl.col("reason").is_null() & pl.all_horizontal(same) & (pl.int_range(pl.len()) > 0))
        .then(pl.lit(SAME_MOMENT))
        .otherwise("reason")
        .alias("reason")
    )
    kept = ordered.filter(pl.col("reason").is_null())
    dropped_rows = ordered.filter(pl.col("reason").is_not_null())
    vehicles, ids_in_doubt = _number_vehicles(kept)
    bsm = kept.join(vehicles.select("sent_by", "vehicle_id"), on="sent_by").sort("vehicle_id", "utc_us")
    bsm = bsm.with_columns(
        _count_lost().alias("lost_before"),
        time_s=count_seconds("utc_us", start_us),
        received_s=pl.when(~pl.col("own")).then(count_seconds("received_us", start_us)),
        clock_step_s=(pl.col("clock_step_us") / 1e6).cast(pl.Float32),
    )
    counts = _count_dropped(dropped_rows, impossible, vehicles)
    stations = _describe_stations(bsm).join(counts, on="vehicle_id", how="left", maintain_order="left")
    stations = stations.with_columns(pl.col("duplicates", "invalid").fill_null(0).cast(pl.Int64))
    columns = [name for name in BSM.columns if name not in PLACE]
    return Assembled(
        bsm.select(columns),
        stations.select(name for name in STATIONS.columns if name not in PLACE),
        dropped_rows.select(FILE, LINE, "reason"),
        ids_in_doubt,
    )


def _number_vehicles(kept: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """Link the ids of each vehicle and number vehicles from 0: the receiver, then the others as they appear.

    Args:
        kept: messages sorted by sender and time.

    Returns:
        `sent_by`, SENDER and `vehicle_id`, and the number of ids whose vehicle is in doubt.
    """
    moving = ("utc_us", "lat_deg", "lon_deg", "speed_mps", "heading_deg")
    units = kept.group_by("sent_by", maintain_order=True).agg(
        pl.col("own", *SENDER).first(),
        pl.col("length_m", "width_m").drop_nulls().first(),
        pl.col(moving).first().name.prefix("first_"),
        pl.col(moving).last().name.prefix("last_"),
        messages=pl.len(),
    )
    # A known device is one vehicle whatever its ids, and so is the receiver.
    linkable = units.filter(pl.col("id").is_not_null())
    first_unit, ids_in_doubt = link_ids(linkable)
    roots = linkable.select("sent_by", root=linkable["sent_by"].gather(first_unit))
    rooted = units.join(roots, on="sent_by", how="left").with_columns(pl.col("root").fill_null(pl.col("sent_by")))
    order = rooted.filter(pl.col("root") == pl.col("sent_by")).sort(
        ~pl.col("own"), "first_utc_us", *SENDER, nulls_last=True
    )
    numbers = order.select("root", vehicle_id=pl.int_range(pl.len(), dtype=pl.Int32))
    return rooted.join(numbers, on="root").select("sent_by", *SENDER, "vehicle_id"), ids_in_doubt


def _count_lost() -> pl.Expr:
    """Return the messages missing before each one, of messages sorted by vehicle and time.

    The counter tells how many. After a silence in which it went round, 12.8 s, nothing does: the vehicle may have been
    out of reach or parked, for hours. A temporary id begins with any number; a counter that never moves tells nothing.
    """
    count = pl.col("message_count").cast(pl.Int32)
    steps = (count.diff() + COUNTS) % COUNTS
    sent = pl.col("utc_us").diff() * (RATE_HZ / 1e6)
    wraps = ((sent - steps) / COUNTS).round().cast(pl.Int32)
    moves = (count.max() > count.min()).fill_null(value=False)
    lost = pl.when(moves & (sent <= COUNTS)).then((steps + COUNTS * wraps - 1).clip(0))
    return lost.over("vehicle_id", "temporary_id").fill_null(0).cast(pl.Int32)


def _count_dropped(dropped: pl.DataFrame, impossible: pl.DataFrame | None, vehicles: pl.DataFrame) -> pl.DataFrame:
    """Count dropped messages by vehicle: `duplicates` and `invalid`; senders of no kept message count nowhere."""
    parts = [dropped.select(*SENDER, invalid=pl.col("reason").is_in([UNDATED, FAR]))]
    if impossible is not None:
        parts.append(impossible.select(*_name_senders(), invalid=pl.lit(value=True)))
    found = pl.concat(parts).join(vehicles, on=SENDER, nulls_equal=True)
    return found.group_by("vehicle_id").agg(
        duplicates=(~pl.col("invalid")).sum().cast(pl.Int64), invalid=pl.col("invalid").sum().cast(pl.Int64)
    )


def _describe_stations(bsm: pl.DataFrame) -> pl.DataFrame:
    """Describe vehicles by their messages, which are sorted by vehicle and time."""
    ids = pl.col("temporary_id")
    latency_s = pl.when("is_timed").then(pl.col("received_s") - pl.col("time_s"))
    return bsm.group_by("vehicle_id", maintain_order=True).agg(
        pl.col("own").first(),
        ids.unique(maintain_order=True).alias("temporary_ids"),
        (ids.rle_id().max()).cast(pl.Int32).alias("id_changes"),
        pl.col("length_m", "width_m").drop_nulls().first(),
        first_s=pl.col("time_s").first(),
        last_s=pl.col("time_s").last(),
        messages=pl.len().cast(pl.Int64),
        lost=pl.col("lost_before").sum().cast(pl.Int64),
        clock_steps=pl.col("clock_step_s").count().cast(pl.Int64),
        latency_median_s=latency_s.median().cast(pl.Float32),
    )
