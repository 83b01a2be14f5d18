"""Carriageways of a sample, each simulated by itself."""

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed, wait
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic import drives, ngsim
from tracklake.pipeline.synthetic.scenarios import (
    FREEWAY,
    HIGHD,
    NGSIM_CSV,
    NGSIM_SOCRATA,
    NGSIM_TEXT,
    HighdScenario,
    Job,
    NgsimScenario,
)
from tracklake.pipeline.synthetic.sumo import simulate, stop_programs

NgsimFile = tuple[str, str, tuple[NgsimScenario, ...]]
"""Format and name of an NGSIM file, and the recordings in it."""
NGSIM_FILES: tuple[NgsimFile, ...] = (
    ("ngsim-text", "trajectories-us-101-0930.txt", NGSIM_TEXT),
    ("socrata", "us-101-export.csv", NGSIM_SOCRATA),
    ("ngsim-csv", "trajectories-us-101-1015.csv", NGSIM_CSV),
)
"""NGSIM files of a sample in all formats."""
AT_ONCE = 2
"""Simulations that run at the same time; each is a process with one thread."""
STOP_POLL_S = 0.05
"""Time between two attempts to end what is still simulated, in seconds."""


def find_driven() -> tuple[HighdScenario, ...]:
    """Return the recording whose vehicles are instrumented."""
    return tuple(scenario for scenario in HIGHD if scenario.recording == drives.RECORDING)


def list_pair(jobs: list[Job], recording: str) -> list[Job]:
    """Return both carriageways of a recording in highD's format."""
    return [job for job in jobs if job.dataset == "highd" and job.recording == recording]


def list_jobs(recordings: tuple[HighdScenario, ...], groups: Sequence[NgsimFile], minutes: float) -> list[Job]:
    """List the carriageways of all recordings, in the order of their files."""
    jobs = []
    for place, scenario in enumerate(HIGHD):
        if scenario not in recordings:
            continue
        frames = max(1, round(scenario.share * minutes * 60 * scenario.road.rate_hz))
        for side, traffic in (("upper", scenario.upper), ("lower", scenario.lower)):
            name, index = scenario.recording, 2 * place + (side == "lower")
            file = f"{name}_tracks.csv"
            jobs.append(Job("highd", name, f"{name}-{side}", file, index, scenario.road, traffic, frames))
    order = {each.start_time: 100 + i for i, each in enumerate(NGSIM_TEXT + NGSIM_SOCRATA + NGSIM_CSV)}
    for _, file, scenarios in groups:
        for each in scenarios:
            frames = max(1, round(each.share * minutes * 60 * FREEWAY.rate_hz))
            name = ngsim.name_recording(each.start_time)
            jobs.append(Job("ngsim", name, name, file, order[each.start_time], FREEWAY, each.traffic, frames))
    return jobs


def simulate_all(home: Path, jobs: list[Job], seed: int, progress: Callable[[str], None]) -> dict[str, pl.DataFrame]:
    """Simulate all carriageways, some at the same time: their tracks by subset."""

    def simulate_job(job: Job, folder: Path) -> pl.DataFrame:
        own_folder = folder / job.subset
        own_folder.mkdir()
        # SUMO's seed is a non-negative 32-bit number.
        own_seed = int(np.random.default_rng([seed, job.index, 0]).integers(2**31))
        return simulate(home, own_folder, job.road, job.traffic, frames=job.frames, seed=own_seed)

    with TemporaryDirectory(prefix="tracklake-sample-") as folder, ThreadPoolExecutor(AT_ONCE) as pool:
        # Congested traffic takes longest and starts first.
        slowest = sorted(jobs, key=lambda job: job.traffic.bottleneck_mps is None)
        waiting = {pool.submit(simulate_job, job, Path(folder)): job.subset for job in slowest}
        try:
            for done, future in enumerate(as_completed(waiting), start=1):
                future.result()
                progress(f"simulated {waiting[future]} ({done}/{len(waiting)})")
        except BaseException:
            _stop(waiting)
            raise
    return {subset: future.result() for future, subset in waiting.items()}


def _stop(simulations: Collection[Future[pl.DataFrame]]) -> None:
    """End simulations at once, or an interrupt would wait for the longest of them."""
    for simulation in simulations:
        simulation.cancel()
    while wait(simulations, timeout=STOP_POLL_S).not_done:
        stop_programs()
