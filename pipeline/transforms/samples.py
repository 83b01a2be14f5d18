"""Samples: which entries on a protocol's clock can serve as prediction origins, and why the others cannot."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.transforms.late_starts import find_would_be_neighbors
from pipeline.transforms.maneuvers import label_maneuvers
from pipeline.transforms.neighbors import find_neighbors
from pipeline.transforms.resample import bound_segments, put_on_clock
from schemas.protocols import Protocol
from schemas.samples import NEIGHBORS, SAMPLE_DROPS, SAMPLES

DROP_REASONS = (
    "excluded_subset",
    "no_lane",
    "short_history",
    "short_future",
    "early_vehicle",
    "would_be_neighbor",
)
"""In the order in which they are tested; an entry is dropped for the first that applies."""


@dataclass(frozen=True)
class SampleTables:
    """What `draw_samples` draws from one subset.

    Args:
        samples: schemas.SAMPLES.
        sample_drops: schemas.SAMPLE_DROPS; with the samples they add up to `entries_on_clock`.
        neighbors: schemas.NEIGHBORS, of the samples only.
        entries_on_clock: how many entries there were to choose from.
        collisions: neighbors whose grid cell was taken by a nearer one, moved to the nearest free cell.
        crowded_out: of them, those who found no free cell and stand nowhere.
    """

    samples: pl.DataFrame
    sample_drops: pl.DataFrame
    neighbors: pl.DataFrame
    entries_on_clock: int
    collisions: int
    crowded_out: int


def draw_samples(
    tracks: pl.DataFrame,
    vehicle_starts: pl.DataFrame,
    missing_starts: pl.DataFrame,
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

    Args:
        tracks: vehicle_id, frame, x_m, y_m, lane, speed_mps of one subset, sorted by vehicle_id, frame.
        vehicle_starts: vehicle_id, early, from `judge_starts`.
        missing_starts: from `estimate_missing_starts`.
        protocol: the recipe.
        dataset: the subset's.
        subset: its name.
        first_frame: the recording's first frame, where tick 0 lies.
        frame_rate_hz: the source's.
        excluded: whether validation excludes the subset.

    Raises:
        ValueError: the protocol's clock is faster than the source.
    """
    clock = put_on_clock(tracks, first_frame=first_frame, frame_rate_hz=frame_rate_hz, rate_hz=protocol.rate_hz)
    names = {"protocol": protocol.name, "dataset": dataset, "subset": subset}
    whole_subset = "excluded_subset" if excluded else "no_lane" if tracks["lane"].null_count() else None
    if whole_subset or clock.is_empty():
        drops = {whole_subset: clock.height} if whole_subset and clock.height else {}
        return SampleTables(
            samples=SAMPLES.empty(),
            sample_drops=_tabulate_drops(drops, names),
            neighbors=NEIGHBORS.empty(),
            entries_on_clock=clock.height,
            collisions=0,
            crowded_out=0,
        )

    row = np.arange(clock.height)
    first, last = bound_segments(clock)
    early_ids = vehicle_starts.filter("early")["vehicle_id"].implode()
    applies = {
        "short_history": row - first < protocol.history_ticks - 1,
        "short_future": last - row < protocol.min_future_ticks,
        "early_vehicle": clock["vehicle_id"].is_in(early_ids).to_numpy(),
        "would_be_neighbor": find_would_be_neighbors(
            clock,
            missing_starts,
            first_frame=first_frame,
            frame_rate_hz=frame_rate_hz,
            rate_hz=protocol.rate_hz,
        ),
    }
    kept = np.ones(clock.height, np.bool_)
    drops = {}
    for reason in DROP_REASONS:
        if reason in applies:
            drops[reason] = int((kept & applies[reason]).sum())
            kept &= ~applies[reason]

    constants = [pl.lit(value).alias(name) for name, value in names.items()]
    samples = pl.concat((clock, label_maneuvers(clock, rate_hz=protocol.rate_hz)), how="horizontal").filter(kept)
    around = find_neighbors(clock, kept)
    return SampleTables(
        samples=SAMPLES.conform(samples.lazy().with_columns(constants)).collect(),
        sample_drops=_tabulate_drops(drops, names),
        neighbors=NEIGHBORS.conform(around.neighbors.lazy().with_columns(constants)).collect(),
        entries_on_clock=clock.height,
        collisions=around.collisions,
        crowded_out=around.crowded_out,
    )


def _tabulate_drops(drops: dict[str, int], names: dict[str, str]) -> pl.DataFrame:
    """`sample_drops` of one subset; reasons that dropped nothing have no row."""
    rows = [{**names, "reason": reason, "entries": entries} for reason, entries in sorted(drops.items()) if entries]
    return pl.DataFrame(rows, schema=SAMPLE_DROPS.dtypes)
