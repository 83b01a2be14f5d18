"""Simulations shared by the samples of a test session: SUMO takes most of a sample's time."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import polars as pl

from tracklake.pipeline.synthetic import build

simulate = build.simulate
simulated: dict[str, pl.DataFrame] = {}
"""Tracks by the arguments of the simulation that made them."""


def look_up(home: Path, folder: Path, road: object, traffic: object, *, frames: int, seed: int) -> pl.DataFrame:
    """Simulate a carriageway, or return the tracks of the same simulation made before."""
    key = repr((road, traffic, frames, seed))
    if key not in simulated:
        simulated[key] = simulate(home, folder, road, traffic, frames=frames, seed=seed)
    return simulated[key]


@contextmanager
def simulate_once() -> Iterator[None]:
    """Let samples made in this block share their simulations."""
    with mock.patch.object(build, "simulate", look_up):
        yield
