"""Traffic: tables for traffic research, derived from the tracks of freeways."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage, StageResult
from tracklake.pipeline.transforms.traffic.car_following import find_episodes
from tracklake.pipeline.transforms.traffic.detectors import Passages, find_passages, gather_passages
from tracklake.pipeline.transforms.traffic.edie import divide_tracks, gather_cells
from tracklake.pipeline.transforms.traffic.lane_changes import find_lane_changes
from tracklake.pipeline.transforms.traffic.safety import find_exposures, join_exposures
from tracklake.pipeline.transforms.traffic.scene import COLUMNS, Scene, Whole
from tracklake.schemas import (
    CAR_FOLLOWING,
    EDIE,
    LANE_CHANGE_EVENTS,
    SAFETY,
    TRACKS,
    TRAFFIC_SKIPS,
    VEHICLES,
    VIRTUAL_DETECTORS,
    Table,
)
from tracklake.schemas.protocols import RECORDED
from tracklake.schemas.traffic import DERIVED_TABLES, SAFETY_THRESHOLDS, SKIPPED

Derived = Mapping[Table, tuple[pl.DataFrame, Mapping[str, int]]]
"""Rows of derived tables without dataset and subset, and numbers of what they leave out by reason."""
OWN_SHARE = 4
"""A scene's own vehicles have a fourth of the entries that a worker holds; the rest is for leaders and followers."""


def build(reader: SubsetReader, settings: Settings) -> StageResult:
    """Derive the tables of a subset; those of an arterial are empty."""
    if reader.facts["freeway"]:
        derived = _join([_derive(scene, settings) for scene in open_scenes(reader, settings)], settings)
        notes = _explain_empty(derived, reader.subset, reader.facts["entries"])
        return StageResult(_complete(derived, reader.partition), notes=notes)
    left_out: Derived = {table: (table.empty(), {"arterial": reader.facts["entries"]}) for table in DERIVED_TABLES}
    note = f"{reader.subset}: traffic tables are skipped: an arterial, and they are of freeways"
    return StageResult(_complete(left_out, reader.partition), notes=[note])


def open_scene(reader: SubsetReader, settings: Settings) -> Scene:
    """Read what the derived tables need of a subset."""
    return _make_scene(reader, reader.read_tracks(settings, *COLUMNS))


def open_scenes(reader: SubsetReader, settings: Settings) -> Iterator[Scene]:
    """Read what the derived tables need of a subset: of a long one some vehicles at a time.

    Their tracks are whole. With them come their leaders and followers at the same time, and so much longer as
    encroachments are looked for.
    """
    if not reader.is_long(settings) or settings.tracks_from != RECORDED:
        yield open_scene(reader, settings)
        return
    x_m, leader = pl.col("x_m"), pl.col("leader_id")
    bounds = reader.scan(TRACKS).select(least=x_m.min(), most=x_m.max(), leads=leader.is_not_null().any())
    least, most, has_leaders = bounds.collect(engine="streaming").row(0)
    steps = ceil(_list_thresholds(settings)["pet_s"] * reader.facts["frame_rate_hz"]) + 2
    vehicles = reader.table(VEHICLES, "vehicle_id", "entries", "first_frame", "last_frame")
    group = pl.col("entries").cast(pl.Int64).cum_sum() // max(1, settings.slice_entries // OWN_SHARE)
    for _, own in vehicles.sort("first_frame", "vehicle_id").group_by(group, maintain_order=True):
        first, last = own["first_frame"].min() - steps, own["last_frame"].max() + steps
        rows = reader.scan(TRACKS).select(COLUMNS).filter(pl.col("frame").is_between(first, last))
        is_own = pl.col("vehicle_id").is_in(own["vehicle_id"].implode())
        tracks = rows.filter(is_own).collect()
        others = pl.concat([tracks["leader_id"], tracks["follower_id"]]).drop_nulls().unique()
        is_other = pl.col("vehicle_id").is_in(others.implode()) & ~pl.col("vehicle_id").is_in(
            own["vehicle_id"].implode()
        )
        tracks = pl.concat([tracks, rows.filter(is_other).collect()]).sort("vehicle_id", "frame")
        road_m = (least, most) if least < most else None
        ids = own["vehicle_id"].sort().cast(pl.Int64).to_numpy()
        yield replace(_make_scene(reader, tracks), whole=Whole(road_m, has_leaders, ids))


def _make_scene(reader: SubsetReader, tracks: pl.DataFrame) -> Scene:
    facts, rate_hz = reader.facts, reader.facts["frame_rate_hz"]
    end_s = max(facts["seconds"] - 1 / rate_hz, (facts["last_frame"] - facts["first_frame"]) / rate_hz)
    return Scene(tracks, reader.table(VEHICLES, "vehicle_id", "length_m"), rate_hz, facts["first_frame"], end_s)


def _list_thresholds(settings: Settings) -> dict[str, float]:
    """Return the thresholds of the measures of safety."""
    return {**SAFETY_THRESHOLDS, **settings.safety_thresholds}


@dataclass(frozen=True)
class _Found:
    """What one scene gives: rows of three tables, what the other two are made of, and what is left out of each."""

    rows: Mapping[Table, pl.DataFrame]
    passages: Passages | None
    by_vehicle: pl.DataFrame
    end_s: float
    road_m: tuple[float, float] | None
    skipped: Mapping[Table, Mapping[str, int]]


def _derive(scene: Scene, settings: Settings) -> _Found:
    changes, unseen = find_lane_changes(scene, lateral_mps=settings.lane_change_lateral_mps)
    episodes, alone = find_episodes(scene, min_s=settings.car_following_min_s)
    exposures, safe = find_exposures(scene, changes, thresholds=_list_thresholds(settings))
    passages, beside = find_passages(scene, spacing_m=settings.detector_spacing_m)
    by_vehicle, outside = divide_tracks(scene, cell_m=settings.edie_cell_m, cell_s=settings.edie_cell_s)
    return _Found(
        rows={CAR_FOLLOWING: episodes, LANE_CHANGE_EVENTS: changes, SAFETY: exposures},
        passages=passages,
        by_vehicle=by_vehicle,
        end_s=scene.end_s,
        road_m=scene.road_m,
        skipped=dict(zip(DERIVED_TABLES, (alone, unseen, safe, beside, outside), strict=True)),
    )


def _join(found: Sequence[_Found], settings: Settings) -> Derived:
    """Join what the scenes of a subset give."""
    spacing_m, interval_s = settings.detector_spacing_m, settings.detector_interval_s
    cell_m, cell_s, road_m, end_s = settings.edie_cell_m, settings.edie_cell_s, found[0].road_m, found[0].end_s
    rows = {table: pl.concat([each.rows[table] for each in found]) for table in found[0].rows}
    rows[SAFETY] = join_exposures([rows[SAFETY]])
    rows[VIRTUAL_DETECTORS] = gather_passages(
        [each.passages for each in found], end_s, spacing_m=spacing_m, interval_s=interval_s
    )
    rows[EDIE] = gather_cells([each.by_vehicle for each in found], road_m, end_s, cell_m=cell_m, cell_s=cell_s)
    return {
        table: (rows[table], {reason: sum(each.skipped[table][reason] for each in found) for reason in skipped})
        for table, skipped in found[0].skipped.items()
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
