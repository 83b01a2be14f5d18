"""Samples with their context: maneuvers, grid and samples of 10 million dense entries, and `tracklake export csp`.

    python benchmarks/context.py [--scale 0.1]

Traffic as dense as NGSIM's: 200 vehicles a frame at 10 Hz on six lanes of 640 m, with noise, lane changes, vehicles
that share a cell, gaps, late starts and findings. It is made first and saved; then, in a process of its own for every
run, each subset is read, drawn from as `tracklake samples` does it, and let go once drawn. Six subsets, as
recordings come, and the same number of entries in one; at the clock of `csp` (5 Hz) and at 10 Hz; with and without
the list of the nearest. Printed are the best of three runs by seconds, the time that reading took apart from the
drawing, and the peak memory of the whole process. `csp_lake.py` describes what is measured of `tracklake export csp`.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
from csp_lake import measure_export

from tracklake.pipeline.transforms.samples.selection import TRACK_COLUMNS, draw_samples
from tracklake.schemas import FINDINGS, MISSING_STARTS
from tracklake.schemas.protocols import CSP

ENTRIES = 10_000_000
REPEATS = 3
RATE_HZ, LANES, ROAD_M, SPEED_MPS, VEHICLES_A_FRAME = 10, 6, 640.0, 9.0, 200
LIMIT_S, LIMIT_GIB = 10.0, 1.5
PROTOCOLS = {
    "csp": replace(CSP, nearest=0),
    "csp, nearest 10": replace(CSP, nearest=10),
    "10 Hz": replace(CSP, name="csp10", rate_hz=10, nearest=0),
    "10 Hz, nearest 10": replace(CSP, name="csp10", rate_hz=10, nearest=10),
}


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0, help="of the number of entries")
    parser.add_argument("--draw", nargs=2, metavar=("FOLDER", "PROTOCOL"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.draw:
        draw_all(Path(options.draw[0]), options.draw[1])
        return
    for case in CASES:
        case(options.scale)


def measure_context(scale: float) -> None:
    """Case 1: `draw_samples`, the whole of it."""
    print("| entries | protocol | samples | neighbors | nearest | seconds | processor s | reading s | peak GiB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    over = []
    for subsets in (6, 1):
        with tempfile.TemporaryDirectory() as folder:
            for number in range(subsets):
                save(Path(folder) / str(number), number, round(ENTRIES * scale / subsets))
            for protocol in PROTOCOLS:
                best = run_best(["--draw", folder, protocol])
                entries = f"{subsets} x {best['entries'] / subsets:,.0f}"
                counts = (f"{best[name]:,.0f}" for name in ("samples", "neighbors", "nearest"))
                times = (f"{best[name]:.1f}" for name in ("seconds", "processor_s", "reading_s"))
                print(
                    f"| {entries} | {protocol} | {' | '.join((*counts, *times))} | {best['peak_gib']:.2f} |", flush=True
                )
                if best["seconds"] > LIMIT_S or best["peak_gib"] > LIMIT_GIB:
                    over.append(f"{entries}, {protocol}")
    print(f"over {LIMIT_S:g} s or {LIMIT_GIB:g} GiB: {'; '.join(over) or 'none'}")


CASES: tuple[Callable[[float], None], ...] = (measure_context, measure_export)
"""One table each; a case takes --scale and prints."""


def run_best(arguments: list[str]) -> dict[str, float]:
    """What a process of its own prints as JSON, of the fastest of three runs."""
    command = [sys.executable, __file__, *arguments]
    runs = [
        json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout) for _ in range(REPEATS)
    ]
    return min(runs, key=lambda run: run["seconds"])


def draw_all(folder: Path, protocol: str) -> None:
    """Draw from every saved subset, one after the other, and print what it took, as JSON."""
    found = dict.fromkeys(("entries", "samples", "neighbors", "nearest", "seconds", "processor_s", "reading_s"), 0.0)
    for place in sorted(folder.iterdir()):
        began = time.perf_counter()
        tables = {name: pl.read_parquet(place / f"{name}.parquet") for name in ("starts", "missing", "findings")}
        tracks = pl.read_parquet(place / "tracks.parquet", columns=list(TRACK_COLUMNS))
        found["reading_s"] += time.perf_counter() - began
        began, before = time.perf_counter(), os.times()
        drawn = draw_samples(
            tracks, tables["starts"], tables["missing"], tables["findings"], protocol=PROTOCOLS[protocol],
            dataset="ngsim", subset=place.name, first_frame=1, frame_rate_hz=float(RATE_HZ), excluded=False,
        )  # fmt: skip
        after = os.times()
        found["seconds"] += time.perf_counter() - began
        found["processor_s"] += after.user + after.system - before.user - before.system
        found["entries"] += tracks.height
        found["samples"] += drawn.samples.height
        found["neighbors"] += drawn.neighbors.height
        found["nearest"] += int(drawn.samples["nearest"].list.len().sum())
        del drawn, tracks
    peak_kib = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
    print(json.dumps({**found, "peak_gib": peak_kib / 2**20}))


def save(folder: Path, number: int, entries: int) -> None:
    """Write one subset's tracks, starts, missing starts and findings."""
    folder.mkdir()
    random = np.random.default_rng(number)
    each = round(ROAD_M / SPEED_MPS * RATE_HZ)
    vehicles = max(LANES, round(entries / each))
    ids = np.arange(vehicles)
    # Vehicles of a lane enter one after the other, 19 m apart in the mean, and keep 6 m and more without lane changes.
    headway = each * LANES / VEHICLES_A_FRAME
    entered = (ids // LANES + random.uniform(-0.34, 0.34, vehicles)) * headway + headway
    first_frame = 1 + entered.astype(np.int64)
    own, step = np.repeat(ids, each), np.tile(np.arange(each), vehicles)
    x = step * (SPEED_MPS / RATE_HZ) + 8 * np.sin((first_frame[own] + step) / 80) + random.normal(0, 0.05, own.size)
    changes = (ids % 15 == 0) * random.integers(each // 4, each, vehicles)
    changed = (changes[own] > 0) & (step >= changes[own])
    lane = ((ids % LANES)[own] + changed) % LANES + 1
    tracks = pl.DataFrame(
        {
            "vehicle_id": own.astype(np.int32), "frame": (first_frame[own] + step).astype(np.int32),
            "x_m": x.round(3), "y_m": ((lane - 0.5) * 3.7 + random.normal(0, 0.3, own.size)).round(3),
            "lane": lane.astype(np.int16),
        }
    )  # fmt: skip
    tracks.filter(pl.Series(random.random(own.size) > 1e-4)).write_parquet(folder / "tracks.parquet")
    pl.DataFrame({"vehicle_id": ids.astype(np.int32), "early": ids < VEHICLES_A_FRAME}).write_parquet(
        folder / "starts.parquet"
    )
    late = ids[ids % 200 == 199]
    missing = {
        "vehicle_id": late, "lane": late % LANES + 1, "cutoff_m": 2.0, "start_x_m": 60.0,
        "start_frame": first_frame[late], "first_missing_frame": np.maximum(1, first_frame[late] - 80),
    }  # fmt: skip
    pl.DataFrame(missing).cast({name: MISSING_STARTS.dtypes[name] for name in missing}).write_parquet(
        folder / "missing.parquet"
    )
    faulty = ids[ids % 20 == 7]
    findings = {
        "vehicle_id": faulty, "severity": np.where(faulty % 40 == 7, "error", "info"),
        "first_frame": first_frame[faulty] + 300, "last_frame": first_frame[faulty] + 320,
    }  # fmt: skip
    pl.DataFrame(findings).cast({name: FINDINGS.dtypes[name] for name in findings}).write_parquet(
        folder / "findings.parquet"
    )


if __name__ == "__main__":
    main()
