"""Tables of a subset from its canonical entries, the same for every source."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import polars as pl

from tracklake.pipeline.sources.source import DividedSubset, RawFile, Subset
from tracklake.pipeline.transforms.slices import Slice
from tracklake.pipeline.transforms.tracks.flow import FlowTally, compute_flow
from tracklake.pipeline.transforms.tracks.gaps import add_gaps
from tracklake.pipeline.transforms.tracks.kinematics import add_kinematics, central_difference
from tracklake.pipeline.transforms.tracks.leaders import derive_leaders
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.columns import Dataset

KINEMATICS_S = 0.3
"""Time before and after an entry on which its derived columns depend, in s: accelerations on the 10 Hz clock."""
SPEED_UNITS = 2**32
"""Whole numbers in 1 m/s, in which speeds of slices are added up."""


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
    tracks = _derive_tracks(entries, sizes, dataset, name, facts, use_recorded_headway=use_recorded_headway)
    del entries
    vehicles = _make_vehicles(_summarise_vehicles(tracks), sizes, dataset, name)
    rate_hz = facts["frame_rate_hz"]
    # A recording may be announced shorter than its tracks are.
    recorded_s = max(facts["seconds"], (tracks["frame"].max() - facts["first_frame"] + 1) / rate_hz)
    flow_vphpl = compute_flow(tracks, lanes=facts["lanes"], rate_hz=rate_hz, seconds=recorded_s)
    return Subset(name, tracks, vehicles, _make_facts(facts, vehicles, flow_vphpl, dataset, name, files))


def assemble_slices(
    slices: Iterable[tuple[Slice, pl.DataFrame]],
    sizes: pl.DataFrame,
    *,
    dataset: Dataset,
    name: str,
    facts: Mapping[str, Any],
    files: Sequence[RawFile],
) -> DividedSubset:
    """Do the same slice by slice, for a source without recorded headways.

    The entries of each slice are those of its own frames and of its context, at least KINEMATICS_S on either side.
    Sums are of whole numbers, so that they do not depend on how the subset is cut.
    """
    summaries: list[pl.DataFrame] = []
    flow = FlowTally()

    def derive() -> Iterator[tuple[str, pl.DataFrame]]:
        for part, entries in slices:
            tracks = _derive_tracks(entries, sizes, dataset, name, facts, use_recorded_headway=False)
            tracks = tracks.filter(part.is_own(pl.col("frame")))
            summaries.append(_summarise_slice(tracks))
            flow.add(tracks, facts["lanes"])
            yield part.name, tracks

    def conclude() -> tuple[pl.DataFrame, pl.DataFrame]:
        vehicles = _make_vehicles(_join_summaries(summaries), sizes, dataset, name)
        flow_vphpl = flow.compute(lanes=facts["lanes"], rate_hz=facts["frame_rate_hz"], seconds=facts["seconds"])
        return vehicles, _make_facts(facts, vehicles, flow_vphpl, dataset, name, files)

    return DividedSubset(name, derive(), conclude)


def _derive_tracks(
    entries: pl.DataFrame,
    sizes: pl.DataFrame,
    dataset: Dataset,
    name: str,
    facts: Mapping[str, Any],
    *,
    use_recorded_headway: bool,
) -> pl.DataFrame:
    """Return rows of TRACKS: entries with their derived columns."""
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
    return entries.lazy().pipe(TRACKS.conform).collect()


def _make_vehicles(summary: pl.DataFrame, sizes: pl.DataFrame, dataset: Dataset, name: str) -> pl.DataFrame:
    """Return rows of VEHICLES: what the tracks say of the vehicles, and their sizes."""
    sizes = _add_absent(sizes, "length_range_m", "width_range_m", "automated")
    vehicles = summary.join(sizes, on="vehicle_id", how="left", maintain_order="left")
    return vehicles.with_columns(dataset=pl.lit(dataset), subset=pl.lit(name)).lazy().pipe(VEHICLES.conform).collect()


def _make_facts(
    facts: Mapping[str, Any],
    vehicles: pl.DataFrame,
    flow_vphpl: float | None,
    dataset: Dataset,
    name: str,
    files: Sequence[RawFile],
) -> pl.DataFrame:
    """Return the row of SUBSETS."""
    lanes = facts["lanes"]
    row = {
        **facts,
        "dataset": dataset,
        "subset": name,
        "last_frame": vehicles["last_frame"].max(),
        "vehicles": vehicles.height,
        "entries": vehicles["entries"].cast(pl.Int64).sum(),
        "flow_vphpl": flow_vphpl,
        "vehicles_per_lane_s": None if lanes is None else vehicles.height / lanes / facts["seconds"],
        "source_files": [{"file": file.name, "sha256": file.sha256} for file in files],
    }
    return pl.DataFrame([row], schema=SUBSETS.dtypes)


def _add_absent(frame: pl.DataFrame, *names: str) -> pl.DataFrame:
    """Add columns that the source does not have, without values."""
    return frame.with_columns(pl.lit(None).alias(name) for name in names if name not in frame.columns)


def _summarise_slice(tracks: pl.DataFrame) -> pl.DataFrame:
    """Return what a slice says of the vehicles, for `_join_summaries`."""
    lane = pl.col("lane")
    return tracks.group_by("vehicle_id", maintain_order=True).agg(
        first_frame=pl.col("frame").first(),
        last_frame=pl.col("frame").last(),
        entries=pl.len(),
        start_x_m=pl.col("x_m").first(),
        end_x_m=pl.col("x_m").last(),
        start_lane=lane.first(),
        end_lane=lane.last(),
        has_lanes=lane.is_not_null().all(),
        lane_changes=(lane != lane.shift(1)).sum(),
        speeds=(pl.col("speed_mps").cast(pl.Float64) * SPEED_UNITS).round().cast(pl.Int64).sum(),
    )


def _join_summaries(summaries: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Return what all slices, in order of time, say of the vehicles."""
    between = (pl.col("start_lane") != pl.col("end_lane").shift(1)).sum()
    return (
        pl.concat(summaries)
        .group_by("vehicle_id", maintain_order=True)
        .agg(
            pl.col("first_frame", "start_x_m", "start_lane").first(),
            pl.col("last_frame", "end_x_m").last(),
            pl.col("entries").sum(),
            mean_speed_mps=pl.col("speeds").sum() / pl.col("entries").sum() / SPEED_UNITS,
            lane_changes=pl.when(pl.col("has_lanes").all()).then(pl.col("lane_changes").sum() + between),
        )
        .sort("vehicle_id")
    )


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
