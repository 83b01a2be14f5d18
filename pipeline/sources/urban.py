"""inD and rounD: drone recordings of German crossroads and roundabouts, 25 Hz, three CSV files per recording."""

from collections.abc import Sequence
from functools import partial

import polars as pl

from tracklake.pipeline.sources.levelx import KINDS
from tracklake.pipeline.sources.levelx_plane import (
    URBAN_FORMAT,
    build_subset,
    finish_recording,
    fit_to_entries,
    place_entries,
    split_impossible,
    split_motor_vehicles,
    summarise_vehicles,
    trace_longest,
)
from tracklake.pipeline.sources.levelx_recognition import SIGNATURE, describe_columns, detect, group
from tracklake.pipeline.sources.source import Canonical, Part, Source
from tracklake.pipeline.transforms.tracks.carriageways import name_movements
from tracklake.schemas import references
from tracklake.schemas.columns import Dataset

PARKED_M, PARKED_MPS = 5.0, 0.5
"""Distance between a track's outermost positions and median speed below which a vehicle is taken to be parked."""
PARKED = "vehicle is parked: it stays within 5 m"
NO_DRIVE = "no vehicle drives this way for long enough to give it an axis"
COMMON_CLASSES = ("van", "truck", "trailer")
"""Classes that recordings of rounD are expected to have."""
MAYBE_UNID = (
    "read as rounD by its classes, without van, truck and trailer; uniD's files look the same, and are cited otherwise"
)
MISSING = ("lane", "leader_id", "follower_id", "gap_m", "headway_recorded_m")
"""Columns of tracks that the files do not have."""


def to_canonical(parts: Sequence[Part], recording: str, dataset: Dataset) -> Canonical:
    """Turn a recording's three files into its tables: a subset for each way over the junction, by its own axis."""
    files = [part.file for part in parts]
    read, entries = URBAN_FORMAT.read_recording(parts[: len(KINDS)], recording)
    entries, dropped = split_motor_vehicles(entries, read.vehicles)
    sizes, notes = summarise_vehicles(entries, read.vehicles)
    if dataset == "round" and not read.vehicles["class"].str.to_lowercase().is_in(COMMON_CLASSES).any():
        notes = (*notes, MAYBE_UNID)
    entries, parked = _split_parked(entries)
    dropped += [(parked, PARKED)] if not parked.is_empty() else []
    subsets = []
    for movement, way in _part_movements(entries):
        axis = trace_longest(way)
        if axis is None:
            dropped.append((way, NO_DRIVE))
            continue
        placed, impossible = split_impossible(place_entries(way, fit_to_entries(axis, way)))
        dropped += impossible
        if placed.is_empty():
            continue
        empty = {"lane": pl.Int16, "leader_id": pl.Int32, "follower_id": pl.Int32, "headway_recorded_m": pl.Float64}
        facts = {
            "freeway": False,
            "lanes": None,
            "on_ramp_lanes": [],
            "lane_markings_m": None,
            "columns_missing": [*MISSING],
            "left_m": 0.0,
        }
        subsets.append(
            build_subset(
                placed.with_columns(pl.lit(None, dtype).alias(name) for name, dtype in empty.items()),
                sizes,
                read.meta,
                files,
                dataset=dataset,
                recording=recording,
                direction=movement,
                facts=facts,
            )
        )
    return finish_recording(dataset, recording, read, dropped, subsets, notes, left_out=parked)


def _split_parked(entries: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split the rows of vehicles that drive from those of parked ones."""
    span = pl.max_horizontal(pl.col(name).max() - pl.col(name).min() for name in ("xCenter", "yCenter"))
    speed = (pl.col("xVelocity") ** 2 + pl.col("yVelocity") ** 2).sqrt().median()
    parked = (
        entries.group_by("trackId")
        .agg(span=span, speed=speed)
        .filter(pl.col("span") < PARKED_M, pl.col("speed") < PARKED_MPS)
    )
    return (
        entries.join(parked, on="trackId", how="anti", maintain_order="left"),
        entries.join(parked, on="trackId", how="semi", maintain_order="left"),
    )


def _part_movements(entries: pl.DataFrame) -> list[tuple[str, pl.DataFrame]]:
    """Part the entries by their vehicles' ways over the junction, by the first and the last heading of each."""
    if entries.is_empty():
        return []
    ends = entries.group_by("trackId", maintain_order=True).agg(
        start=pl.col("heading").first().radians(), end=pl.col("heading").last().radians()
    )
    names = pl.Series("way", name_movements(ends["start"].to_numpy(), ends["end"].to_numpy()))
    parted = entries.join(ends.select("trackId", names), on="trackId", how="left", maintain_order="left")
    return [(str(name), rows.drop("way")) for (name,), rows in sorted(parted.partition_by("way", as_dict=True).items())]


IND = Source(
    name="ind",
    title="inD: trajectories of road users at German intersections",
    licence="non-commercial, on request from levelXdata (ind-dataset.com)",
    citation=references.BOCK.full,
    signature=SIGNATURE,
    version=1,
    detect=detect,
    group=partial(group, only="ind"),
    to_canonical=partial(to_canonical, dataset="ind"),
    describe_columns=describe_columns,
)
ROUND = Source(
    name="round",
    title="rounD: trajectories of road users at German roundabouts",
    licence="non-commercial, on request from levelXdata (round-dataset.com)",
    citation=references.KRAJEWSKI_2020.full,
    signature=SIGNATURE,
    version=1,
    detect=detect,
    group=partial(group, only="round"),
    to_canonical=partial(to_canonical, dataset="round"),
    describe_columns=describe_columns,
)
