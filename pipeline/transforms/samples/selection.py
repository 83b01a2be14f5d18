"""Samples: which entries on a protocol's clock can serve as prediction origins, and why the others cannot."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.transforms.resample import bound_segments, cut_runs, find_stride, put_on_clock
from tracklake.pipeline.transforms.samples.maneuvers import label_maneuvers
from tracklake.pipeline.transforms.samples.nearest import find_nearest
from tracklake.pipeline.transforms.samples.neighbors import Neighborhood, find_neighbors
from tracklake.pipeline.transforms.samples.threads import map_in_threads
from tracklake.pipeline.transforms.starts.late_starts import find_would_be_neighbors
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.samples import NEIGHBORS, SAMPLE_COUNTS, SAMPLE_DROPS, SAMPLES

DROP_REASONS = (
    "excluded_subset",
    "no_lane",
    "short_history",
    "short_future",
    "early_vehicle",
    "would_be_neighbor",
    "error_finding",
)
"""In the order in which they are tested; an entry is dropped for the first that applies."""
TRACK_COLUMNS = ("vehicle_id", "frame", "x_m", "y_m", "lane")
"""What `draw_samples` reads of the tracks."""
LABELLED = ("vehicle_id", "tick", "frame", "lane", "lateral_maneuver", "longitudinal_maneuver")
PIECE_ROWS = 1 << 16
"""Entries judged and labelled at a time: their few MB stay in the processor's cache."""


@dataclass(frozen=True)
class SampleTables:
    """What `draw_samples` draws from one subset.

    Args:
        samples: schemas.SAMPLES.
        sample_drops: schemas.SAMPLE_DROPS; with the samples they add up to the counts' `entries_on_clock`.
        sample_counts: schemas.SAMPLE_COUNTS, one row.
        neighbors: schemas.NEIGHBORS, of the samples only.
    """

    samples: pl.DataFrame
    sample_drops: pl.DataFrame
    sample_counts: pl.DataFrame
    neighbors: pl.DataFrame


def draw_samples(
    tracks: pl.DataFrame,
    vehicle_starts: pl.DataFrame,
    missing_starts: pl.DataFrame,
    findings: pl.DataFrame,
    *,
    protocol: Protocol,
    dataset: str,
    subset: str,
    first_frame: int,
    frame_rate_hz: float,
    excluded: bool,
) -> SampleTables:
    """Keep or drop every entry on the protocol's clock, label the samples and find their neighbors (DESIGN section 7).

    - excluded_subset: validation excludes the whole subset.
    - no_lane: some entry has no lane: maneuvers and neighbors cannot be told, and the subset gives no samples.
    - short_history: fewer than `protocol.history_ticks` positions up to and with the entry, without a gap.
    - short_future: fewer than `protocol.min_future_ticks` positions after it, without a gap.
    - early_vehicle: the road ahead was not yet recorded when the vehicle entered.
    - would_be_neighbor: a vehicle whose track starts late is missing around the entry.
    - error_finding: its own vehicle breaks a rule of severity error in the history or the horizon; only where the
      protocol says so.

    Args:
        tracks: TRACK_COLUMNS of one subset, sorted by vehicle_id, frame.
        vehicle_starts: vehicle_id, early, from `judge_starts`.
        missing_starts: from `estimate_missing_starts`.
        findings: vehicle_id, severity, first_frame, last_frame of the subset's findings, in any order.
        protocol: the recipe.
        dataset: the subset's.
        subset: its name.
        first_frame: the recording's first frame, where tick 0 lies.
        frame_rate_hz: the source's.
        excluded: whether validation excludes the subset.

    Raises:
        ValueError: the protocol's clock is faster than the source.
    """
    rates: dict[str, Any] = {"first_frame": first_frame, "frame_rate_hz": frame_rate_hz, "rate_hz": protocol.rate_hz}
    clock = put_on_clock(tracks.select(TRACK_COLUMNS), **rates)
    names = {"protocol": protocol.name, "dataset": dataset, "subset": subset}
    whole_subset = "excluded_subset" if excluded else "no_lane" if tracks["lane"].null_count() else None
    if whole_subset or clock.is_empty():
        drops = {whole_subset: clock.height} if whole_subset else {}
        nobody = Neighborhood(NEIGHBORS.empty(), collisions=0, crowded_out=0)
        return _gather(clock.height, SAMPLES.empty(), drops, nobody, names)

    early_ids = vehicle_starts.filter("early")["vehicle_id"].implode()
    would_be = find_would_be_neighbors(clock, missing_starts, **rates)
    kept = np.ones(clock.height, np.bool_)

    def sift(bounds: tuple[int, int]) -> tuple[pl.DataFrame, dict[str, int]]:
        piece, good = clock[slice(*bounds)], kept[slice(*bounds)]
        row = np.arange(piece.height)
        first, last = bound_segments(piece)
        applies = {
            "short_history": row - first < protocol.history_ticks - 1,
            "short_future": last - row < protocol.min_future_ticks,
            "early_vehicle": piece["vehicle_id"].is_in(early_ids).to_numpy(),
            "would_be_neighbor": would_be[slice(*bounds)],
        }
        if protocol.drop_error_findings:
            applies["error_finding"] = find_faulty(piece, findings, protocol=protocol, **rates)
        drops = {}
        for reason in DROP_REASONS:
            if reason in applies:
                drops[reason] = int((good & applies[reason]).sum())
                good &= ~applies[reason]
        labelled = pl.concat((piece, label_maneuvers(piece, rate_hz=protocol.rate_hz)), how="horizontal")
        return labelled.select(LABELLED).filter(good), drops

    pieces = map_in_threads(sift, cut_runs(clock["segment"].to_numpy(), PIECE_ROWS))
    samples = pl.concat(piece for piece, _ in pieces)
    drops = {reason: sum(dropped.get(reason, 0) for _, dropped in pieces) for reason in DROP_REASONS}
    nearest = find_nearest(clock, protocol.nearest, kept) if protocol.nearest else pl.lit(None)
    clock = clock.select("vehicle_id", "tick", "x_m", "lane")  # the rest is room for the neighbors
    samples = samples.with_columns(nearest.alias("nearest"))
    return _gather(clock.height, samples, drops, find_neighbors(clock, kept), names)


def find_faulty(
    clock: pl.DataFrame,
    findings: pl.DataFrame,
    *,
    protocol: Protocol,
    first_frame: int,
    frame_rate_hz: float,
    rate_hz: int,
) -> NDArray[np.bool_]:
    """Tell around which entries on the clock their own vehicle has a finding of severity error.

    It counts where the finding's frames overlap those that the entry's history and horizon are made of, the first and
    the last included; a tick between two frames is made of both.

    Args:
        clock: vehicle_id, tick.
        findings: vehicle_id, severity, first_frame, last_frame.
        protocol: how far history and horizon reach.
        first_frame: the recording's first frame, where tick 0 lies.
        frame_rate_hz: the source's.
        rate_hz: the clock's.

    Returns:
        (N,) in the clock's order.
    """
    errors = findings.filter(pl.col("severity") == "error")
    stride = find_stride(frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    tick = clock["tick"].to_numpy().astype(np.int64)
    begins = first_frame + (tick - (protocol.history_ticks - 1)) * stride.numerator // stride.denominator
    ends = first_frame - (-(tick + protocol.horizon_ticks) * stride.numerator // stride.denominator)
    # Of a vehicle's findings those that begin in time, less those that are over before: what is left overlaps.
    own = clock["vehicle_id"].to_numpy()
    who = errors["vehicle_id"].to_numpy()
    begun = np.sort(_key(who, errors["first_frame"].to_numpy()))
    over = np.sort(_key(who, errors["last_frame"].to_numpy()))
    overlaps = np.searchsorted(begun, _key(own, ends), side="right") - np.searchsorted(over, _key(own, begins))
    faulty: NDArray[np.bool_] = overlaps > 0
    return faulty


def _key(vehicle_id: NDArray[np.int32], frame: NDArray[np.integer]) -> NDArray[np.int64]:
    """Vehicle and frame as one number of the same order, also for frames some way beyond those of Int32."""
    key: NDArray[np.int64] = (vehicle_id.astype(np.int64) << 32) + frame
    return key


def _gather(
    entries: int, samples: pl.DataFrame, drops: dict[str, int], around: Neighborhood, names: dict[str, str]
) -> SampleTables:
    """The tables of one subset, complete."""
    constants = [pl.lit(value).alias(name) for name, value in names.items()]
    dropped = [{**names, "reason": reason, "entries": entries} for reason, entries in sorted(drops.items()) if entries]
    counts = {
        **names,
        "entries_on_clock": entries,
        "samples": samples.height,
        "neighbors": around.neighbors.height,
        "collisions": around.collisions,
        "crowded_out": around.crowded_out,
    }
    return SampleTables(
        samples=SAMPLES.conform(samples.lazy().with_columns(constants)).collect(),
        sample_drops=pl.DataFrame(dropped, schema=SAMPLE_DROPS.dtypes),
        sample_counts=pl.DataFrame([counts], schema=SAMPLE_COUNTS.dtypes),
        neighbors=NEIGHBORS.conform(around.neighbors.lazy().with_columns(constants)).collect(),
    )
