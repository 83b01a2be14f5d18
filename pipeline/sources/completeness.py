"""Completeness of a recording: the counts its publisher and metadata announce, compared with what was kept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import floor

import polars as pl

from tracklake.pipeline.sources.accounting import DUPLICATE
from tracklake.pipeline.sources.derived import IN_FULLER_FILE
from tracklake.pipeline.sources.source import Subset
from tracklake.schemas import COMPLETENESS, VEHICLES
from tracklake.schemas.columns import Dataset
from tracklake.schemas.completeness import PUBLISHED

VEHICLE = ["source_vehicle_id", "entries_announced"]
"""Columns that identify a vehicle of the source; on arterials its rows may lie in several subsets."""
HOLD_NO_ENTRY = ("blank line", "repeated header")
"""Reasons of rejected lines that never held a row."""
FAULTS = ("vehicles_without_rows", "vehicles_incomplete", "first_frames_differ", "last_frames_differ")
"""Measures that count faulty vehicles; the expected count is 0."""


@dataclass(frozen=True)
class Announced:
    """The counts announced for a recording.

    Args:
        totals: counts of the recording by measure (vehicles, cars, trucks, entries); None = not announced.
        vehicles: source_vehicle_id, entries_announced, first_frame, last_frame (null = not announced), one row per
            vehicle, also without rows; None if each vehicle's own rows announce their number.
    """

    totals: Mapping[str, int | None]
    totals_by: str
    vehicles: pl.DataFrame | None
    vehicles_by: str


def compare_counts(
    dataset: Dataset, recording: str, subsets: Sequence[Subset], announced: Announced, log: pl.DataFrame
) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """Compare what was kept of one recording with the counts that metadata, rows or the publisher announce.

    Returns the rows of schemas.COMPLETENESS, and notes about what is missing. `log` has the rows of
    schemas.INGEST_LOG of the files that hold its entries.
    """
    vehicles = pl.concat([VEHICLES.empty(), *(subset.vehicles for subset in subsets)])
    each = _compare_vehicles(vehicles, announced.vehicles)
    dropped = _count_dropped(log)
    table = (
        pl.LazyFrame(_list_measures(vehicles, each, announced), schema=_COUNTS, orient="row")
        .with_columns(
            dataset=pl.lit(dataset),
            recording=pl.lit(recording),
            agrees=pl.col("expected") == pl.col("found"),
            rows_dropped=pl.when(pl.col("measure") == "entries").then(pl.lit(sum(dropped.values()), pl.Int64)),
        )
        .pipe(COMPLETENESS.conform)
        .sort(COMPLETENESS.key)
        .collect()
    )
    about_totals = _describe_totals(recording, table, announced, dropped)
    about_vehicles = _describe_vehicles(recording, each, announced, dropped)
    return table, tuple(note for note in (about_totals, about_vehicles) if note is not None)


_COUNTS = {"measure": pl.String(), "authority": pl.String(), "expected": pl.Int64(), "found": pl.Int64()}


def _list_measures(
    vehicles: pl.DataFrame, each: pl.DataFrame, announced: Announced
) -> list[tuple[str, str, int | None, int | None]]:
    """List every measure with its authority, expected and found count."""
    whole = {
        "vehicles": vehicles["source_vehicle_id"].n_unique(),
        "cars": vehicles.filter(pl.col("class") == "car").height,
        "trucks": vehicles.filter(pl.col("class") == "truck").height,
        "entries": int(vehicles["entries"].sum()),
    }
    known, by = not each.is_empty(), announced.vehicles_by
    expected, found = (int(each[name].sum()) if known else None for name in ("entries_announced", "entries"))
    return [
        *((name, announced.totals_by, count, whole[name]) for name, count in announced.totals.items()),
        ("entries", by, expected, found),
        *(
            (name, by, 0, int(each[name].sum()) if each[name].count() else None)
            for name in FAULTS
            if name in each.columns
        ),
    ]


def _compare_vehicles(vehicles: pl.DataFrame, announced: pl.DataFrame | None) -> pl.DataFrame:
    """Compare each announced vehicle: vehicles, entries_announced, entries (0 = none) and FAULTS.

    A fault is null if it is unknown for the vehicle; its column is absent if it is unknown for all.
    """
    found = (
        vehicles.group_by("subset", *VEHICLE)
        .agg(
            pl.len().cast(pl.Int64).alias("vehicles"),
            pl.col("entries").cast(pl.Int64).sum(),
            first_frame_found=pl.col("first_frame").min(),
            last_frame_found=pl.col("last_frame").max(),
        )
        .group_by(VEHICLE)
        .agg(
            # An id that was split is several vehicles, each of which announces the same number of entries.
            pl.col("vehicles").max(),
            pl.col("entries").sum(),
            first_frame_found=pl.col("first_frame_found").min(),
            last_frame_found=pl.col("last_frame_found").max(),
        )
    )
    expected = found.select(VEHICLE) if announced is None else announced
    each = (
        expected.filter(pl.col("entries_announced").is_not_null())
        .join(found, on=VEHICLE, how="left")
        .with_columns(
            pl.col("entries_announced").cast(pl.Int64) * pl.col("vehicles").fill_null(1),
            pl.col("vehicles").fill_null(1),
            pl.col("entries").fill_null(0),
        )
        .sort(VEHICLE)
    )
    has_rows = pl.col("entries") > 0
    each = each.with_columns(vehicles_incomplete=has_rows & (pl.col("entries") != pl.col("entries_announced")))
    if announced is None:
        return each
    return each.with_columns(
        vehicles_without_rows=~has_rows,
        first_frames_differ=pl.col("first_frame") != pl.col("first_frame_found"),
        last_frames_differ=pl.col("last_frame") != pl.col("last_frame_found"),
    )


def _count_dropped(log: pl.DataFrame) -> dict[str, int]:
    """Count, by reason, dropped rows that could be some of the missing ones."""
    # A row that several files repeat was kept once; a repetition within the only file may count for the publisher.
    no_loss = (*HOLD_NO_ENTRY, DUPLICATE, IN_FULLER_FILE) if log.height > 1 else HOLD_NO_ENTRY
    counts = log.explode("dropped_by_reason").select(pl.col("dropped_by_reason").struct.unnest()).drop_nulls("reason")
    counts = counts.filter(~pl.col("reason").is_in(no_loss)).group_by("reason").agg(pl.col("rows").sum())
    return dict(counts.sort("rows", "reason", descending=[True, False]).iter_rows())


def _describe_totals(
    recording: str, table: pl.DataFrame, announced: Announced, dropped: Mapping[str, int]
) -> str | None:
    """Describe differences from the announced totals; the publisher's are shown in full, since excerpts are common."""
    by = table.filter(pl.col("authority") == announced.totals_by).sort("measure", descending=True)
    wrong = by.filter(~pl.col("agrees")).select("expected", "measure", "found").rows()
    if not wrong:
        return None
    if announced.totals_by != PUBLISHED:
        expected_counts = ", ".join(_count_noun(count, measure.removesuffix("s")) for count, measure, _ in wrong)
        return (
            f"{recording}: {announced.totals_by} announces {expected_counts}, the tracks have "
            f"{', '.join(f'{found:,}' for *_, found in wrong)}"
        )
    totals = by.rows_by_key("measure", named=True, unique=True)
    rows, vehicles = totals["entries"], totals["vehicles"]
    share = floor(1000 * rows["found"] / rows["expected"]) / 10  # rounded down: 100 % only if nothing is missing
    what = "an excerpt, or incomplete" if rows["found"] < rows["expected"] else "other than published"
    return (
        f"{recording}: {rows['found']:,} of {rows['expected']:,} published rows ({share or '< 0.1'} %) and "
        f"{vehicles['found']:,} of {vehicles['expected']:,} vehicles: {what}"
        f"{_describe_dropped(rows['expected'] - rows['found'], dropped)}"
    )


def _describe_vehicles(
    recording: str, each: pl.DataFrame, announced: Announced, dropped: Mapping[str, int]
) -> str | None:
    """Describe faulty vehicles: how many there are, and one example of each fault."""
    by_fault = {fault: each.filter(fault) for fault in FAULTS if fault in each.columns}
    faults = [_describe_fault(fault, faulty) for fault, faulty in by_fault.items() if not faulty.is_empty()]
    if not faults:
        return None
    expected, found = int(each["entries_announced"].sum()), int(each["entries"].sum())
    return (
        f"{recording}: {announced.vehicles_by} announces {_count_noun(expected, 'row')} of "
        f"{_count_noun(int(each['vehicles'].sum()), 'vehicle')}, the tracks have {found:,}; {', '.join(faults)}"
        f"{_describe_dropped(expected - found, dropped)}"
    )


def _describe_fault(fault: str, vehicles: pl.DataFrame) -> str:
    one = vehicles.row(0, named=True)
    example, several = f"for example {one['source_vehicle_id']}", vehicles.height > 1
    who = _count_noun(vehicles.height, "vehicle")
    if fault == "vehicles_without_rows":
        return f"{who} {'have' if several else 'has'} no row ({example})"
    if fault == "vehicles_incomplete":
        rows = f"{one['entries']:,} of {one['entries_announced']:,} rows"
        return f"{who} {'have' if several else 'has'} other than announced ({example}: {rows})"
    end, verb = ("first_frame", "begin") if fault == "first_frames_differ" else ("last_frame", "end")
    frames = f"frame {one[f'{end}_found']} instead of {one[end]}"
    return f"{who} {verb if several else f'{verb}s'} elsewhere than announced ({example}: {frames})"


def _count_noun(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _describe_dropped(missing: int, dropped: Mapping[str, int]) -> str:
    """Describe how many of the missing rows may be dropped ones."""
    total = sum(dropped.values())
    if missing <= 0 or not total:
        return ""
    reasons = ", ".join(f"{reason}: {rows:,}" for reason, rows in list(dropped.items())[:3])
    more = ", ..." if len(dropped) > 3 else ""
    return f"; dropped rows ({reasons}{more}) may be {min(total, missing):,} of the {missing:,} missing"
