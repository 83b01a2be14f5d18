"""Is everything there? What a recording's publisher and metadata announce, compared with what was kept."""

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
"""What identifies a vehicle to its source: on arterials it may stand in several subsets, each with some of its rows."""

HOLD_NO_ENTRY = ("blank line", "repeated header")
"""Reasons of rejected lines that were never a row."""

FAULTS = ("vehicles_without_rows", "vehicles_incomplete", "first_frames_differ", "last_frames_differ")
"""Measures that count vehicles with something wrong: none is expected."""


@dataclass(frozen=True)
class Announced:
    """What others say that a recording holds.

    Args:
        totals: by measure (vehicles, cars, trucks, entries), over the recording; None where a file does not say.
        totals_by: the authority for them.
        vehicles: source_vehicle_id, entries_announced, first_frame, last_frame (the last two null where not said), one
            row per vehicle, those without rows included; None where a vehicle's own rows announce how many they are.
        vehicles_by: the authority for those.
    """

    totals: Mapping[str, int | None]
    totals_by: str
    vehicles: pl.DataFrame | None
    vehicles_by: str


@dataclass(frozen=True)
class Completeness:
    """The comparison.

    Args:
        table: schemas.COMPLETENESS.
        notes: what is missing, a line or two.
    """

    table: pl.DataFrame
    notes: tuple[str, ...]


def compare(
    dataset: Dataset, recording: str, subsets: Sequence[Subset], announced: Announced, log: pl.DataFrame
) -> Completeness:
    """Compare what was kept of one recording with what was announced.

    Args:
        dataset: of the recording.
        recording: its name.
        subsets: its subsets.
        announced: by metadata, rows or the publisher.
        log: schemas.INGEST_LOG of the files that hold its entries.
    """
    vehicles = pl.concat([VEHICLES.empty(), *(subset.vehicles for subset in subsets)])
    each = _compare_vehicles(vehicles, announced.vehicles)
    dropped = _count_dropped(log)
    whole = {
        "vehicles": vehicles["source_vehicle_id"].n_unique(),
        "cars": vehicles.filter(pl.col("class") == "car").height,
        "trucks": vehicles.filter(pl.col("class") == "truck").height,
        "entries": int(vehicles["entries"].sum()),
    }
    rows: list[dict[str, object]] = [
        {"measure": measure, "authority": announced.totals_by, "expected": expected, "found": whole[measure]}
        for measure, expected in announced.totals.items()
    ]
    known = not each.is_empty()
    rows.append({
        "measure": "entries",
        "authority": announced.vehicles_by,
        "expected": int(each["entries_announced"].sum()) if known else None,
        "found": int(each["entries"].sum()) if known else None,
    })  # fmt: skip
    rows += [
        {
            "measure": measure,
            "authority": announced.vehicles_by,
            "expected": 0,
            "found": int(each[measure].sum()) if each[measure].count() else None,
        }
        for measure in FAULTS
        if measure in each.columns
    ]
    table = (
        pl.LazyFrame(rows, schema_overrides={"expected": pl.Int64(), "found": pl.Int64()})
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
    about_totals = _remark_totals(recording, table, announced, dropped)
    about_vehicles = _remark_vehicles(recording, each, announced, dropped)
    return Completeness(table, tuple(note for note in (about_totals, about_vehicles) if note is not None))


def _compare_vehicles(vehicles: pl.DataFrame, announced: pl.DataFrame | None) -> pl.DataFrame:
    """One row per VEHICLE announced: vehicles, entries_announced, entries (0 = none), and FAULTS that can be judged.

    A fault is null where it cannot be told of the vehicle; its column is absent where it can be told of none.
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
            # An id that was split stands for several, each of which announces as many.
            pl.col("vehicles").max(),
            pl.col("entries").sum(),
            first_frame_found=pl.col("first_frame_found").min(),
            last_frame_found=pl.col("last_frame_found").max(),
        )
    )
    everyone = found.select(VEHICLE) if announced is None else announced
    each = (
        everyone.filter(pl.col("entries_announced").is_not_null())
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
    """Dropped rows by reason that could be some of those missing."""
    # What several files repeat is there once; a repetition within the only file may have been counted by others.
    no_loss = (*HOLD_NO_ENTRY, DUPLICATE, IN_FULLER_FILE) if log.height > 1 else HOLD_NO_ENTRY
    counts = log.explode("dropped_by_reason").select(pl.col("dropped_by_reason").struct.unnest()).drop_nulls("reason")
    counts = counts.filter(~pl.col("reason").is_in(no_loss)).group_by("reason").agg(pl.col("rows").sum())
    return dict(counts.sort("rows", "reason", descending=[True, False]).iter_rows())


def _remark_totals(recording: str, table: pl.DataFrame, announced: Announced, dropped: Mapping[str, int]) -> str | None:
    """What differs from the announced totals; the publisher's are given whole, since excerpts are to be expected."""
    by = table.filter(pl.col("authority") == announced.totals_by).sort("measure", descending=True)
    wrong = by.filter(~pl.col("agrees")).select("expected", "measure", "found").rows()
    if not wrong:
        return None
    if announced.totals_by != PUBLISHED:
        said = ", ".join(_number(expected, measure.removesuffix("s")) for expected, measure, _ in wrong)
        return (
            f"{recording}: {announced.totals_by} announces {said}, the tracks have "
            f"{', '.join(f'{found:,}' for *_, found in wrong)}"
        )
    totals = by.rows_by_key("measure", named=True, unique=True)
    rows, vehicles = totals["entries"], totals["vehicles"]
    share = floor(1000 * rows["found"] / rows["expected"]) / 10  # 100 % is what lacks nothing
    what = "an excerpt, or incomplete" if rows["found"] < rows["expected"] else "other than published"
    return (
        f"{recording}: {rows['found']:,} of {rows['expected']:,} published rows ({share or '< 0.1'} %) and "
        f"{vehicles['found']:,} of {vehicles['expected']:,} vehicles: {what}"
        f"{_explain(rows['expected'] - rows['found'], dropped)}"
    )


def _remark_vehicles(
    recording: str, each: pl.DataFrame, announced: Announced, dropped: Mapping[str, int]
) -> str | None:
    """What differs from what vehicles announce: how many of them, and one of each fault."""
    of_fault = {fault: each.filter(fault) for fault in FAULTS if fault in each.columns}
    said = [_tell(fault, faulty) for fault, faulty in of_fault.items() if not faulty.is_empty()]
    if not said:
        return None
    expected, found = int(each["entries_announced"].sum()), int(each["entries"].sum())
    return (
        f"{recording}: {announced.vehicles_by} announces {_number(expected, 'row')} of "
        f"{_number(int(each['vehicles'].sum()), 'vehicle')}, the tracks have {found:,}; {', '.join(said)}"
        f"{_explain(expected - found, dropped)}"
    )


def _tell(fault: str, vehicles: pl.DataFrame) -> str:
    one = vehicles.row(0, named=True)
    example, several = f"for example {one['source_vehicle_id']}", vehicles.height > 1
    who = _number(vehicles.height, "vehicle")
    if fault == "vehicles_without_rows":
        return f"{who} {'have' if several else 'has'} no row ({example})"
    if fault == "vehicles_incomplete":
        rows = f"{one['entries']:,} of {one['entries_announced']:,} rows"
        return f"{who} {'have' if several else 'has'} other than announced ({example}: {rows})"
    end, verb = ("first_frame", "begin") if fault == "first_frames_differ" else ("last_frame", "end")
    frames = f"frame {one[f'{end}_found']} instead of {one[end]}"
    return f"{who} {verb if several else f'{verb}s'} elsewhere than announced ({example}: {frames})"


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _explain(missing: int, dropped: Mapping[str, int]) -> str:
    """How far rows that were dropped may be the rows that are missing."""
    total = sum(dropped.values())
    if missing <= 0 or not total:
        return ""
    reasons = ", ".join(f"{reason}: {rows:,}" for reason, rows in list(dropped.items())[:3])
    more = ", ..." if len(dropped) > 3 else ""
    return f"; dropped rows ({reasons}{more}) may be {min(total, missing):,} of the {missing:,} missing"
