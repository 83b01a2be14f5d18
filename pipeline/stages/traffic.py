"""Traffic: tables for traffic research, derived from the tracks of freeways."""

from collections.abc import Mapping

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage, StageResult
from tracklake.pipeline.transforms.traffic.car_following import find_episodes
from tracklake.pipeline.transforms.traffic.detectors import count_passages
from tracklake.pipeline.transforms.traffic.edie import measure_cells
from tracklake.pipeline.transforms.traffic.lane_changes import find_lane_changes
from tracklake.pipeline.transforms.traffic.safety import find_exposures
from tracklake.pipeline.transforms.traffic.scene import COLUMNS, Scene
from tracklake.schemas import (
    CAR_FOLLOWING,
    EDIE,
    LANE_CHANGE_EVENTS,
    SAFETY,
    TRAFFIC_SKIPS,
    VEHICLES,
    VIRTUAL_DETECTORS,
    Table,
)
from tracklake.schemas.traffic import DERIVED_TABLES, SAFETY_THRESHOLDS, SKIPPED

Derived = Mapping[Table, tuple[pl.DataFrame, Mapping[str, int]]]
"""Rows of derived tables without dataset and subset, and numbers of what they leave out by reason."""


def build(reader: SubsetReader, settings: Settings) -> StageResult:
    """Derive the tables of a subset; those of an arterial are empty."""
    if reader.facts["freeway"]:
        derived = _derive(open_scene(reader, settings), settings)
        notes = _explain_empty(derived, reader.subset, reader.facts["entries"])
        return StageResult(_complete(derived, reader.partition), notes=notes)
    left_out: Derived = {table: (table.empty(), {"arterial": reader.facts["entries"]}) for table in DERIVED_TABLES}
    note = f"{reader.subset}: traffic tables are skipped: an arterial, and they are of freeways"
    return StageResult(_complete(left_out, reader.partition), notes=[note])


def open_scene(reader: SubsetReader, settings: Settings) -> Scene:
    """Read what the derived tables need of a subset."""
    facts, rate_hz = reader.facts, reader.facts["frame_rate_hz"]
    end_s = max(facts["seconds"] - 1 / rate_hz, (facts["last_frame"] - facts["first_frame"]) / rate_hz)
    vehicles = reader.table(VEHICLES, "vehicle_id", "length_m")
    return Scene(reader.read_tracks(settings, *COLUMNS), vehicles, rate_hz, facts["first_frame"], end_s)


def _derive(scene: Scene, settings: Settings) -> Derived:
    changes = find_lane_changes(scene, lateral_mps=settings.lane_change_lateral_mps)
    return {
        CAR_FOLLOWING: find_episodes(scene, min_s=settings.car_following_min_s),
        LANE_CHANGE_EVENTS: changes,
        SAFETY: find_exposures(scene, changes[0], thresholds={**SAFETY_THRESHOLDS, **settings.safety_thresholds}),
        VIRTUAL_DETECTORS: count_passages(
            scene, spacing_m=settings.detector_spacing_m, interval_s=settings.detector_interval_s
        ),
        EDIE: measure_cells(scene, cell_m=settings.edie_cell_m, cell_s=settings.edie_cell_s),
    }


def _explain_empty(derived: Derived, subset: str, entries: int) -> list[str]:
    """Return a note for each reason that leaves tables of a subset without rows since most of its entries lack it."""
    empty: dict[str, list[str]] = {}
    for table, (rows, skipped) in derived.items():
        reason, number = max(skipped.items(), key=lambda item: item[1])
        if rows.is_empty() and number > entries / 2:
            empty.setdefault(f"{number:,} {SKIPPED[reason]}", []).append(table.name)
    return [f"{subset}: no rows in {', '.join(names)}: {reason}" for reason, names in empty.items()]


def _complete(derived: Derived, partition: Mapping[str, str]) -> dict[Table, pl.DataFrame]:
    """Add dataset and subset to the derived rows, and the table of what they leave out."""
    place = [pl.lit(value).alias(name) for name, value in partition.items()]
    rows = [
        {**partition, "derived_table": table.name, "reason": reason, "counted": SKIPPED[reason], "number": number}
        for table, (_, skipped) in derived.items()
        for reason, number in skipped.items()
        if number
    ]
    skips = pl.DataFrame(rows, schema=TRAFFIC_SKIPS.dtypes).sort(TRAFFIC_SKIPS.key)
    made = {
        table: table.conform(
            (frame if frame.width else table.empty()).lazy().with_columns(place).sort(table.key)
        ).collect()
        for table, (frame, _) in derived.items()
    }
    return {**made, TRAFFIC_SKIPS: skips}


STAGE = Stage(
    name="traffic",
    meaning="Derive tables for traffic research: car following, lane changes, safety, detectors, flow and density.",
    scope="recording",
    after=(INGEST,),
    after_reconstruction=(RECONSTRUCTION,),
    settings=(
        "car_following_min_s",
        "lane_change_lateral_mps",
        "safety_thresholds",
        "detector_spacing_m",
        "detector_interval_s",
        "edie_cell_m",
        "edie_cell_s",
    ),
    version=3,
    build=build,
)
