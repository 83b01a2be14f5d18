"""Messages of a drive by their senders: numbers of vehicles, moments on the drive's clock, and what was dropped."""

from dataclasses import dataclass

import polars as pl

from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.csv import LINE


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
