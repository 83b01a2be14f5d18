"""Tables of a subset from its canonical entries, the same for every source."""

from collections.abc import Mapping, Sequence
from typing import Any

import polars as pl

from tracklake.pipeline.sources.source import RawFile, Subset
from tracklake.pipeline.transforms.tracks.flow import compute_flow
from tracklake.pipeline.transforms.tracks.gaps import add_gaps
from tracklake.pipeline.transforms.tracks.kinematics import add_kinematics, central_difference
from tracklake.pipeline.transforms.tracks.leaders import derive_leaders
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.columns import Dataset


def assemble_subset(
    entries: pl.DataFrame,
    sizes: pl.DataFrame,
    *,
    dataset: Dataset,
    name: str,
    facts: Mapping[str, Any],
    use_recorded_headway: bool,
    files: Sequence[RawFile],
) -> Subset:
    """Compute the derived columns of oriented entries and cast everything to the schemas.

    `entries` are sorted by vehicle_id, frame and have x_m, y_m, lane, speed_mps, accel_mps2, and if the source has them
    leader_id, follower_id (else derived), headway_recorded_m, heading_rad, lateral_speed_mps; `sizes` have
    source_vehicle_id, class, length_m, width_m, entries_announced per vehicle_id, and if the source has them
    length_range_m, width_range_m, automated; `facts` are the columns of SUBSETS that do not follow from these. For
    `use_recorded_headway` see `add_gaps`.
    """
    rate_hz, first_frame = facts["frame_rate_hz"], facts["first_frame"]
    entries = add_kinematics(entries, rate_hz).with_columns(
        dataset=pl.lit(dataset), subset=pl.lit(name), time_s=(pl.col("frame") - first_frame) / rate_hz
    )
    if "leader_id" not in entries.columns:
        entries = derive_leaders(entries)
    entries = _add_absent(entries, "heading_rad", "headway_recorded_m")
    if "lateral_speed_mps" not in entries.columns:
        entries = entries.with_columns(lateral_speed_mps=central_difference("y_m", rate_hz))
    entries = add_gaps(entries, sizes, use_recorded_headway=use_recorded_headway)
    tracks = entries.lazy().pipe(TRACKS.conform).collect()
    del entries
    sizes = _add_absent(sizes, "length_range_m", "width_range_m", "automated")
    vehicles = _summarise_vehicles(tracks).join(sizes, on="vehicle_id", how="left", maintain_order="left")
    vehicles = (
        vehicles.with_columns(dataset=pl.lit(dataset), subset=pl.lit(name)).lazy().pipe(VEHICLES.conform).collect()
    )
    lanes, last_frame = facts["lanes"], tracks["frame"].max()
    # A recording may be announced shorter than its tracks are.
    recorded_s = max(facts["seconds"], tracks.select((pl.col("frame").max() - first_frame + 1) / rate_hz).item())
    row = {
        **facts,
        "dataset": dataset,
        "subset": name,
        "last_frame": last_frame,
        "vehicles": vehicles.height,
        "entries": tracks.height,
        "flow_vphpl": compute_flow(tracks, lanes=lanes, rate_hz=rate_hz, seconds=recorded_s),
        "vehicles_per_lane_s": None if lanes is None else vehicles.height / lanes / facts["seconds"],
        "source_files": [{"file": file.name, "sha256": file.sha256} for file in files],
    }
    return Subset(name, tracks, vehicles, pl.DataFrame([row], schema=SUBSETS.dtypes))


def _add_absent(frame: pl.DataFrame, *names: str) -> pl.DataFrame:
    """Add columns that the source does not have, without values."""
    return frame.with_columns(pl.lit(None).alias(name) for name in names if name not in frame.columns)


def _summarise_vehicles(tracks: pl.DataFrame) -> pl.DataFrame:
    lane = pl.col("lane")
    changes = (lane != lane.shift(1)).sum()
    return (
        tracks.lazy()
        .group_by("vehicle_id", maintain_order=True)
        .agg(
            first_frame=pl.col("frame").first(),
            last_frame=pl.col("frame").last(),
            entries=pl.len(),
            start_x_m=pl.col("x_m").first(),
            end_x_m=pl.col("x_m").last(),
            start_lane=lane.first(),
            mean_speed_mps=pl.col("speed_mps").cast(pl.Float64).mean(),
            lane_changes=pl.when(lane.is_not_null().all()).then(changes),
        )
        .collect()
    )
