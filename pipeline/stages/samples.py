"""Samples: prediction origins with maneuvers, the nearest and the grid's neighbors; every entry dropped by reason."""

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage, StageResult
from tracklake.pipeline.transforms.samples.selection import TRACK_COLUMNS, draw_samples
from tracklake.schemas import (
    MISSING_STARTS,
    SAMPLE_DROPS,
    SAMPLES,
    SUBSET_STATUS,
    VEHICLE_STARTS,
)
from tracklake.schemas.protocols import LAST_LANES


def build(reader: SubsetReader, settings: Settings) -> StageResult:
    """Draw the samples of a subset."""
    protocol = settings.get_protocol()
    drawn = draw_samples(
        reader.read_tracks(settings, *TRACK_COLUMNS),
        reader.table(VEHICLE_STARTS),
        reader.table(MISSING_STARTS),
        reader.read_findings(settings),
        protocol=protocol,
        last_lane=LAST_LANES.get(reader.facts["site"]) if protocol.fold_lanes else None,
        excluded=reader.table(SUBSET_STATUS)["excluded"][0],
        **reader.partition,
        **reader.clock,
    )
    notes = []
    if drawn[SAMPLES].is_empty():
        reasons = drawn[SAMPLE_DROPS].sort("entries", descending=True)["reason"].to_list()
        notes.append(f"{reader.subset}: no samples ({', '.join(reasons) or 'no entries'})")
    return StageResult(drawn, notes=notes)


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
