"""Samples: prediction origins with maneuvers, the nearest and the grid's neighbors; every entry dropped by reason."""

from collections.abc import Iterator

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage, StageResult
from tracklake.pipeline.transforms.samples.maneuvers import BRAKE_FUTURE_S, BRAKE_HISTORY_S, LANE_WINDOW_S
from tracklake.pipeline.transforms.samples.selection import TRACK_COLUMNS, add_counts, draw_samples
from tracklake.schemas import (
    MISSING_STARTS,
    NEIGHBORS,
    SAMPLE_COUNTS,
    SAMPLE_DROPS,
    SAMPLES,
    SUBSET_STATUS,
    TRACKS,
    VEHICLE_STARTS,
    Table,
)
from tracklake.schemas.protocols import FILTERED_TRACKS, LAST_LANES


def build(reader: SubsetReader, settings: Settings) -> Iterator[StageResult]:
    """Draw the samples of a subset, slice by slice."""
    protocol = settings.get_protocol()
    context_s = max(protocol.history_s, protocol.horizon_s, LANE_WINDOW_S, BRAKE_HISTORY_S, BRAKE_FUTURE_S) + 1.0
    has_lanes = None
    drawn: list[dict[Table, pl.DataFrame]] = []
    # Filtered positions depend on all that was before.
    is_whole = settings.tracks_from == FILTERED_TRACKS
    for each in [reader] if is_whole else reader.cut(settings, context_s, tracks_from=settings.tracks_from):
        if each.slice is not None and has_lanes is None:
            has_lanes = not reader.scan(TRACKS).select(pl.col("lane").null_count()).collect(engine="streaming").item()
        made = draw_samples(
            each.read_tracks(settings, *TRACK_COLUMNS),
            reader.table(VEHICLE_STARTS),
            reader.table(MISSING_STARTS),
            reader.read_findings(settings),
            protocol=protocol,
            last_lane=LAST_LANES.get(reader.facts["site"]) if protocol.fold_lanes else None,
            excluded=reader.table(SUBSET_STATUS)["excluded"][0],
            part=each.slice,
            has_lanes=has_lanes,
            **reader.partition,
            **reader.clock,
        )
        large = {table: made.pop(table) for table in (SAMPLES, NEIGHBORS)}
        drawn.append(made)
        yield StageResult(large, part=each.part)
    counts = add_counts(drawn)
    notes = []
    if not counts[SAMPLE_COUNTS]["samples"].sum():
        reasons = counts[SAMPLE_DROPS].sort("entries", descending=True)["reason"].to_list()
        notes.append(f"{reader.subset}: no samples ({', '.join(reasons) or 'no entries'})")
    yield StageResult(counts, notes=notes)


STAGE = Stage(
    name="samples",
    meaning="Draw samples with maneuvers and neighbors.",
    scope="freeway recording",
    after=(INGEST, "validate", "repair"),
    after_reconstruction=(RECONSTRUCTION, "revalidate"),
    settings=(lambda settings: {"protocol": settings.get_protocol().sampling_digest},),
    version=3,
    build=build,
)
