"""Traffic: tables for traffic research, derived from the tracks of freeways."""

from collections.abc import Mapping

import polars as pl

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.pipeline.transforms.traffic.car_following import find_episodes
from tracklake.pipeline.transforms.traffic.scene import COLUMNS, Scene
from tracklake.schemas import CAR_FOLLOWING, TRACKS, TRAFFIC_SKIPS, VEHICLES, Table
from tracklake.schemas.traffic import SKIPPED

Derived = Mapping[Table, tuple[pl.DataFrame, Mapping[str, int]]]
"""Rows of derived tables without dataset and subset, and numbers of what they leave out by reason."""
MADE = (CAR_FOLLOWING,)
"""Tables that this stage writes, besides `traffic_skips`."""


def build(reader: SubsetReader, settings: Settings) -> StageResult:
    """Derive the tables of a subset; those of an arterial are empty."""
    if reader.facts["freeway"]:
        derived = _derive(open_scene(reader), settings)
        return StageResult(_complete(derived, reader.partition))
    left_out: Derived = {table: (table.empty(), {"arterial": reader.facts["entries"]}) for table in MADE}
    return StageResult(_complete(left_out, reader.partition))


def open_scene(reader: SubsetReader) -> Scene:
    """Read what the derived tables need of a subset."""
    facts, rate_hz = reader.facts, reader.facts["frame_rate_hz"]
    end_s = max(facts["seconds"] - 1 / rate_hz, (facts["last_frame"] - facts["first_frame"]) / rate_hz)
    vehicles = reader.table(VEHICLES, "vehicle_id", "length_m")
    return Scene(reader.table(TRACKS, *COLUMNS), vehicles, rate_hz, facts["first_frame"], end_s)


def _derive(scene: Scene, settings: Settings) -> Derived:
    return {CAR_FOLLOWING: find_episodes(scene, min_s=settings.car_following_min_s)}


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
        table: table.conform(frame.lazy().with_columns(place).sort(table.key)).collect()
        for table, (frame, _) in derived.items()
    }
    return {**made, TRAFFIC_SKIPS: skips}


STAGE = Stage(
    name="traffic",
    meaning="Derive tables for traffic research: car following, lane changes, safety, detectors, flow and density.",
    scope="recording",
    after=(INGEST,),
    settings=("car_following_min_s",),
    version=1,
    build=build,
)
