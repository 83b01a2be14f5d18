"""Formats that are generated with noise and without defects: their writers, and their rows of the truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic import i24, tgsim
from tracklake.pipeline.synthetic.levelx import LEVELX_FORMATS
from tracklake.pipeline.synthetic.noise import DRONE, MAST, add_noise
from tracklake.pipeline.synthetic.scenarios import I24, TGSIM, Job
from tracklake.pipeline.synthetic.truth import FileCount


class PlainFormat(Protocol):
    """A module or an object that writes one format."""

    def list_jobs(self, minutes: float) -> list[Job]:
        """List the carriageways to simulate."""
        ...

    def write_files(self, folder: Path, tracks: dict[str, pl.DataFrame]) -> list[FileCount]:
        """Write the files, from noisy tracks by subset, and count their lines."""
        ...


PLAIN: Mapping[str, PlainFormat] = {**LEVELX_FORMATS, TGSIM: tgsim, I24: i24}
"""Writers by format."""


def write_format(
    folder: Path, name: str, jobs: Sequence[Job], clean: Mapping[str, pl.DataFrame], seed: int, noise: tuple[str, ...]
) -> tuple[list[FileCount], list[dict[str, object]]]:
    """Write one format from simulated tracks by subset; returns counts of lines, and rows of the truth."""
    drone = name in LEVELX_FORMATS
    tracks = _count_on(jobs, clean) if drone else {job.subset: clean[job.subset] for job in jobs}
    noisy = {
        job.subset: add_noise(
            tracks[job.subset],
            job.road,
            DRONE if drone else MAST,
            noise,
            np.random.default_rng([seed, job.index, 1]),
        )
        for job in jobs
    }
    counts = PLAIN[name].write_files(folder, noisy)
    return counts, [row for job in jobs for row in list_first_frames(tracks[job.subset], job)]


def _count_on(jobs: Sequence[Job], clean: Mapping[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """Count frames and vehicles from 0; vehicles of a recording's later carriageways go on from those before."""
    tracks, last = {}, dict.fromkeys((job.recording for job in jobs), -1)
    for job in jobs:
        tracks[job.subset] = clean[job.subset].with_columns(
            pl.col("vehicle") + pl.lit(last[job.recording], pl.Int32), pl.col("frame") - 1
        )
        last[job.recording] += clean[job.subset]["vehicle"].n_unique()
    return tracks


def list_first_frames(tracks: pl.DataFrame, job: Job) -> list[dict[str, object]]:
    """List the `first_frame` rows of the truth table of one subset."""
    firsts = tracks.group_by("vehicle", maintain_order=True).agg(
        pl.col("frame").min().alias("first"), pl.col("frame").max().alias("last"), pl.len(), pl.col("x").first()
    )
    return [
        {
            "kind": "first_frame", "dataset": job.dataset, "recording": job.recording, "subset": job.subset,
            "file": job.file, "vehicle_id": vehicle, "first_frame": first, "last_frame": last, "entries": entries,
            "value": x,
        }
        for vehicle, first, last, entries, x in firsts.iter_rows()
    ]  # fmt: skip
