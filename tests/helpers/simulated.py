"""Simulations, and counts of what the rules find, which the samples of a test session share: most of their time."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import polars as pl

from tracklake.pipeline.synthetic import simulation, truth
from tracklake.pipeline.synthetic.scenery import Entry, Key, Surface

simulate = simulation.simulate
simulated: dict[str, pl.DataFrame] = {}
"""Tracks by the arguments of the simulation that made them."""
count_rules = truth.count_rules
counted: dict[tuple[int, int, Surface], dict[str, tuple[int, int, int]]] = {}
"""Counts by a subset's entries, as their number and hash, and its surface."""


def look_up(home: Path, folder: Path, road: object, traffic: object, *, frames: int, seed: int) -> pl.DataFrame:
    """Simulate a carriageway, or return the tracks of the same simulation made before."""
    key = repr((road, traffic, frames, seed))
    if key not in simulated:
        simulated[key] = simulate(home, folder, road, traffic, frames=frames, seed=seed)
    return simulated[key]


def look_up_counts(entries: dict[Key, Entry], surface: Surface) -> dict[str, tuple[int, int, int]]:
    """Count what the rules find in a subset, or return the counts of the same entries."""
    key = len(entries), hash(tuple(entries.items())), surface
    if key not in counted:
        counted[key] = count_rules(entries, surface)
    return counted[key]


@contextmanager
def count_once() -> Iterator[None]:
    """Let samples made in this block share the counts of what the rules find."""
    with mock.patch.object(truth, "count_rules", look_up_counts):
        yield


@contextmanager
def simulate_once() -> Iterator[None]:
    """Let samples made in this block share their simulations and counts."""
    with count_once(), mock.patch.object(simulation, "simulate", look_up):
        yield
