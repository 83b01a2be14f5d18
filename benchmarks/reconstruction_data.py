"""Samples with the truth for the comparison of reconstructions: generated, ingested, and put beside the truth."""

import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import polars as pl
from reconstruction_methods import Motion, average, find_runs
from reconstruction_scores import Scene

from tracklake.pipeline import synthetic
from tracklake.pipeline.lake import load, scan
from tracklake.pipeline.synthetic import simulation
from tracklake.pipeline.transforms.reconstruction.config import BOUNDS, DEFAULT_CLASS, ReconstructionConfig
from tracklake.pipeline.transforms.reconstruction.reconstruction import reconstruct
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES

FORMATS = ("highd", "ngsim-text", "socrata")
"""Formats of the samples: 25 Hz and 10 Hz."""
LEAST_S = 1.0
"""Least time in which a vehicle is recorded that is judged, in s."""
STEADY_S = 0.5
"""Time over which the true acceleration is averaged where the simulator's own changes from frame to frame, in s."""


@dataclass(frozen=True)
class Recording:
    """One subset: its tables as ingested, and the same rows beside the truth."""

    tracks: pl.DataFrame
    vehicles: pl.DataFrame
    facts: Mapping[str, Any]
    scene: Scene


def write_samples(folder: Path, models: Mapping[str, tuple[str, ...]], minutes: float, seed: int) -> None:
    """Write and ingest a sample and a lake by noise model; all have the same traffic, which is simulated once."""
    simulated: dict[str, pl.DataFrame] = {}
    simulate = simulation.simulate

    def look_up(home: Path, inside: Path, road: object, traffic: object, *, frames: int, seed: int) -> pl.DataFrame:
        key = repr((road, traffic, frames, seed))
        if key not in simulated:
            simulated[key] = simulate(home, inside, road, traffic, frames=frames, seed=seed)
        return simulated[key]

    with mock.patch.object(simulation, "simulate", look_up):
        for name, noise in models.items():
            source = folder / f"{name}-{seed}"
            if not source.exists():
                synthetic.write_sample(source, formats=FORMATS, minutes=minutes, seed=seed, noise=noise)
    for name in models:
        if not (folder / f"{name}-{seed}-lake").exists():
            ingest(folder / f"{name}-{seed}", folder / f"{name}-{seed}-lake")


def ingest(source: Path, lake: Path) -> None:
    """Ingest files into a lake, in a process of its own."""
    command = [sys.executable, "-m", "tracklake.pipeline.cli.app", "ingest", source, "--lake", lake, "--quiet"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def read_tables(lake: Path, rate_hz: float) -> list[tuple[pl.DataFrame, pl.DataFrame, dict[str, Any]]]:
    """Read the tracks, vehicles and facts of all subsets of one frame rate."""
    manifest = load(lake)
    subsets = scan(lake, manifest, SUBSETS).collect().filter(frame_rate_hz=rate_hz).sort("dataset", "subset")
    found = []
    for facts in subsets.iter_rows(named=True):
        place = {key: facts[key] for key in ("dataset", "subset")}
        tracks, vehicles = (
            scan(lake, manifest, table).filter(**place).collect().sort(table.key) for table in (TRACKS, VEHICLES)
        )
        found.append((tracks, vehicles, facts))
    return found


def read_recordings(folder: Path, name: str, seed: int, rate_hz: float, *, defects: bool = False) -> list[Recording]:
    """Read all subsets of one frame rate of a sample, with the truth.

    Vehicles with an injected defect are left out of what is judged, unless `defects` are to count.
    """
    source = folder / f"{name}-{seed}"
    true = pl.read_parquet(source / "true_tracks.parquet")
    injected = pl.read_parquet(source / "truth.parquet").filter(pl.col("vehicle_id").is_not_null(), kind="defect")
    found = []
    for tracks, vehicles, facts in read_tables(folder / f"{name}-{seed}-lake", rate_hz):
        place = {key: facts[key] for key in ("dataset", "subset")}
        damaged = [] if defects else injected.filter(**place)["vehicle_id"].unique().to_list()
        scene = build_scene(tracks, vehicles, true.filter(**place), damaged, rate_hz)
        found.append(Recording(tracks, vehicles, facts, scene))
    return found


def build_scene(
    tracks: pl.DataFrame, vehicles: pl.DataFrame, true: pl.DataFrame, damaged: list[int], rate_hz: float
) -> Scene:
    """Put a subset's entries beside the truth; vehicles that are damaged are not judged."""
    key = ["vehicle_id", "frame"]
    names = ("x_m", "speed_mps", "accel_mps2")
    joined = (
        tracks.with_row_index("row")
        .join(true.select(*key, *names), on=key, how="left", suffix="_true", maintain_order="left")
        .join(vehicles.select("vehicle_id", "length_m", "class"), on="vehicle_id", how="left", maintain_order="left")
    )
    leaders = joined.select(leader_id="vehicle_id", frame="frame", leader_row="row", leader_length="length_m")
    joined = joined.join(leaders, on=["leader_id", "frame"], how="left", maintain_order="left")
    runs = find_runs(joined["vehicle_id"].to_numpy(), joined["frame"].to_numpy(), rate_hz)
    columns = {
        suffix: Motion(*(joined[name + suffix].cast(pl.Float64).to_numpy() for name in names))
        for suffix in ("", "_true")
    }
    classes = list(BOUNDS)
    kind = joined["class"].fill_null(DEFAULT_CLASS).replace_strict(classes, range(len(classes)), return_dtype=pl.Int64)
    return Scene(
        x=columns[""].x,
        recorded=columns[""],
        true=columns["_true"],
        steady_accel=average(columns["_true"].accel, runs, np.ones(1 + round(STEADY_S * rate_hz / 2))),
        leader=joined["leader_row"].cast(pl.Int64).fill_null(-1).to_numpy(),
        leader_length=joined["leader_length"].cast(pl.Float64).fill_null(0).to_numpy(),
        vehicle=joined["vehicle_id"].rle_id().cast(pl.Int64).to_numpy(),
        runs=runs,
        kind=kind.to_numpy(),
        judged=joined.select(~pl.col("vehicle_id").is_in(damaged) & (pl.len().over("vehicle_id") >= LEAST_S * rate_hz))
        .to_series()
        .to_numpy(),
    )


def apply_reconstruction(recording: Recording, config: ReconstructionConfig) -> Motion:
    """Reconstruct a recording; entries that are left out stay as recorded."""
    entries = reconstruct(recording.tracks, recording.vehicles, recording.facts, config).entries
    names = ("x_m", "speed_mps", "accel_mps2")
    joined = recording.tracks.select("vehicle_id", "frame", *names).join(
        entries.select("vehicle_id", "frame", *names),
        on=["vehicle_id", "frame"],
        how="left",
        suffix="_new",
        maintain_order="left",
    )
    columns = (pl.coalesce(f"{name}_new", name).cast(pl.Float64) for name in names)
    return Motion(*(series.to_numpy() for series in joined.select(*columns)))
