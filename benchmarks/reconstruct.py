"""Ten million entries at 10 Hz reconstructed: seconds, processor seconds and peak memory of `tracklake reconstruct`.

    python benchmarks/reconstruct.py [--scale 0.1] [--keep DIR]

Congested traffic with waves is simulated once, SIMULATED_S long, and follows itself in seven recordings until they
hold 1.4 million entries each, as NGSIM's do, with smooth and autocorrelated noise. They are written as NGSIM's text and
ingested.
Then the stage runs in a process of its own with two workers, start-up included.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.lake import load, scan
from tracklake.pipeline.synthetic import ngsim
from tracklake.pipeline.synthetic.noise import MAST, SMOOTH, add_noise
from tracklake.pipeline.synthetic.noise_models import AUTOCORRELATED
from tracklake.pipeline.synthetic.scenarios import FREEWAY, NGSIM_SOCRATA
from tracklake.pipeline.synthetic.sumo import find_sumo, simulate
from tracklake.schemas import RECONSTRUCTED, RECONSTRUCTION_QUALITY

ENTRIES, RECORDINGS = 10_000_000, 7
SIMULATED_S = 120.0
LIMIT_S = 180.0
"""Time that ten million entries may take, in s."""


def main() -> None:
    """Write, ingest, reconstruct and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0, help="of the number of entries")
    parser.add_argument("--keep", type=Path, help="folder of the lake, which is kept and used again")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        source, lake = folder / "raw", folder / "lake"
        if not lake.exists():
            source.mkdir(parents=True)
            write_recordings(source, round(ENTRIES * options.scale))
            run("ingest", str(source), "--lake", str(lake), "--workers", "2", "--quiet")
        seconds, processor_s, peak_gib = run("reconstruct", "--lake", str(lake), "--workers", "2", "--quiet")
        manifest = load(lake)
        quality = scan(lake, manifest, RECONSTRUCTION_QUALITY).collect()
        rows = scan(lake, manifest, RECONSTRUCTED).select(pl.len()).collect().item()
    entries, moved = quality["entries"].sum(), quality["constrained_entries"].sum()
    print("| entries | rows written | moved by bounds | seconds | processor s | peak GiB |")
    print("| --- | --- | --- | --- | --- | --- |")
    print(f"| {entries:,} | {rows:,} | {moved / entries:.1%} | {seconds:.1f} | {processor_s:.1f} | {peak_gib:.2f} |")
    limit_s = LIMIT_S * options.scale
    print(f"over {limit_s:g} s" if seconds > limit_s else f"within {limit_s:g} s")


def write_recordings(folder: Path, entries: int) -> None:
    """Write recordings that begin an hour apart, each in a file."""
    with tempfile.TemporaryDirectory() as inside:
        frames = round(SIMULATED_S * FREEWAY.rate_hz)
        tracks = simulate(find_sumo(), Path(inside), FREEWAY, NGSIM_SOCRATA[0].traffic, frames=frames, seed=1)
    models, random = (SMOOTH, AUTOCORRELATED), np.random.default_rng(1)
    noisy = add_noise(tracks, FREEWAY, MAST, models, random).with_columns(lost=pl.lit(False))
    for number in range(RECORDINGS):
        rows = ngsim.build_rows(noisy, f"{10 + number}:00")
        path = folder / f"trajectories-{number}.txt"
        with path.open("w", encoding="utf-8") as file:
            for copy in follow_itself(rows, frames, entries // RECORDINGS):
                file.write("\n".join(ngsim.format_text(copy)) + "\n")


def follow_itself(rows: pl.DataFrame, frames: int, entries: int) -> Iterator[pl.DataFrame]:
    """Yield the rows again and again, each time later and under other ids, until there are enough."""
    ids = int(rows.select(pl.col("Vehicle_ID").max()).item())
    for number, first in enumerate(range(0, entries, rows.height)):
        later, beyond = number * frames, number * ids
        yield rows.head(entries - first).with_columns(
            pl.col("Frame_ID") + later,
            pl.col("Global_Time") + later * round(1000 / FREEWAY.rate_hz),
            *(pl.when(pl.col(name) > 0).then(pl.col(name) + beyond).otherwise(0).alias(name)
              for name in ("Vehicle_ID", "Preceding", "Following")),
        )  # fmt: skip


def run(*arguments: str) -> tuple[float, float, float]:
    """Run a command in a process of its own; returns its seconds, processor seconds and peak memory in GiB."""
    code = (
        "import pathlib, sys\nfrom tracklake.pipeline.cli.app import main\ntry:\n    main()\nfinally:\n"
        "    print(pathlib.Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
    )
    began, before = time.perf_counter(), os.times()
    done = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
    after, seconds = os.times(), time.perf_counter() - began
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return seconds, used, int(done.stdout.strip().splitlines()[-1]) / 2**20


if __name__ == "__main__":
    main()
