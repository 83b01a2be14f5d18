"""Moments at which messages were generated, and clocks of senders that step against the receiver's."""

import polars as pl

from tracklake.pipeline.sources.csv import LINE

MINUTE_US = 60_000_000
"""Microseconds in a minute."""
CLOCK_STEP_US = 500_000
"""A sender's clock steps where it moves by more against the receiver's, in microseconds; radio delays less."""
SETTLED_MESSAGES = 3
"""Messages on each side of a step whose medians must differ, at least two: one that was late is no step."""


def find_generation_times(messages: pl.DataFrame) -> pl.Series:
    """Return when each message was generated, in microseconds since 1970; null where nothing tells.

    That is the sender's UTC time, else the second mark in the minute that puts it nearest to the reception, else the
    reception. A leap second (second marks from 60000) is the first second of the next minute, as in UTC since 1970.
    """
    received = pl.col("received_us")
    ahead = (pl.col("second_mark_ms").cast(pl.Int64) * 1000 - received + MINUTE_US // 2) % MINUTE_US - MINUTE_US // 2
    return messages.select(pl.coalesce("utc_us", received + ahead, received).alias("utc_us")).to_series()


def find_clock_steps(moments: pl.DataFrame) -> pl.DataFrame:
    """Find where clocks step, and put each message on the clock that agrees best with the receiver's.

    Between two steps a clock is off by the median of generated - received. All stretches are moved onto the one whose
    median is nearest to 0; its latency stays.

    Args:
        moments: `sent_by`, the sender's number, `utc_us`, `received_us`, none of them null, and LINE.

    Returns:
        the same rows in another order, `utc_us` moved, with `clock_step_us`: the jump before a message, or null.
    """
    ordered = moments.sort("sent_by", "received_us", "utc_us", LINE).with_columns(
        offset=pl.col("utc_us") - pl.col("received_us")
    )
    offset = pl.col("offset")
    before = offset.rolling_median(SETTLED_MESSAGES, min_samples=2).shift(1)
    after = offset.reverse().rolling_median(SETTLED_MESSAGES, min_samples=2).reverse()
    jumps = (offset.diff().abs() > CLOCK_STEP_US).any().over("sent_by")
    jumping = ordered.filter(jumps)
    stepped = (offset.diff().abs() > CLOCK_STEP_US) & ((after - before).abs() > CLOCK_STEP_US)
    marked = jumping.with_columns(
        pl.when(stepped).then((after - before).cast(pl.Int64)).over("sent_by").alias("clock_step_us")
    ).with_columns(stretch=pl.col("clock_step_us").is_not_null().cum_sum().over("sent_by"))
    marked = marked.with_columns(off=offset.median().over("sent_by", "stretch").cast(pl.Int64))
    best = marked.group_by("sent_by").agg(pl.col("off").sort_by(pl.col("off").abs(), "off").first().alias("best"))
    moved = marked.join(best, on="sent_by").with_columns(utc_us=pl.col("utc_us") - pl.col("off") + pl.col("best"))
    steady = ordered.filter(~jumps).with_columns(clock_step_us=pl.lit(None, pl.Int64))
    return pl.concat([steady.drop("offset"), moved.select(steady.drop("offset").columns)])


def count_seconds(name: str, start_us: int) -> pl.Expr:
    """Return a column of microseconds since 1970 as seconds since a start, to the microsecond.

    Polars divides by a number inexactly; without rounding, 0.2 s of one file would not be that of another.
    """
    return ((pl.col(name) - start_us) / 1e6).round(6)
