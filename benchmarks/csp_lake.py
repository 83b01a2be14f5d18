"""`tracklake export csp` of 8.7 million entries: NGSIM's six freeway recordings, as dense as they are.

The lake is generated: six recordings of the published lengths together, 200 vehicles a frame at 10 Hz on six lanes of
640 m, with noise, lane changes, vehicles that share a cell, and gaps. Then the command runs in a process of its own;
printed are the best of three runs by seconds, the processor's time, and the program's own peak of memory.
`context.py` calls it.
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.lake import Commit, load, open_for_writing, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources.assembly import assemble_subset
from tracklake.pipeline.sources.source import RawFile, Subset
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.columns import FOOT_M

RECORDINGS = {
    "us-101-0750": 1_180_598,
    "us-101-0805": 1_403_095,
    "us-101-0820": 1_515_240,
    "i-80-1600": 1_262_678,
    "i-80-1700": 1_549_918,
    "i-80-1715": 1_753_791,
}
"""The published ones and their entries; 8,665,320 together."""
RATE_HZ, LANES, ROAD_M, SPEED_MPS, VEHICLES_A_FRAME = 10, 6, 640.0, 9.0, 200
FINGERPRINT = "0" * 16
REPEATS = 3
OPTIONS: tuple[tuple[str, ...], ...] = ((), ("--full-future",), ("--clean",))
NEEDED_BY_CLEAN = ("validate", "repair", "samples", "split")


def measure_export(scale: float) -> None:
    """Print the table; --clean reads what other stages make, which is made first."""
    with tempfile.TemporaryDirectory() as work:
        lake = Path(work) / "lake"
        make_lake(lake, scale)
        print("| entries | options | seconds | processor s | peak GiB | GB written |")
        print("| --- | --- | --- | --- | --- | --- |")
        entries = sum(file.rows or 0 for file in load(lake).live(TRACKS.name))
        for options in OPTIONS:
            if "--clean" in options:
                run_stages(lake)
            runs = [export(lake, Path(work) / "out", options) for _ in range(REPEATS)]
            seconds, processor_s, peak_gib, written = min(runs)
            figures = (f"{seconds:.1f}", f"{processor_s:.1f}", f"{peak_gib:.2f}", f"{written:.2f}")
            print(f"| {entries:,} | {' '.join(options) or '-'} | {' | '.join(figures)} |", flush=True)


def export(lake: Path, out: Path, options: tuple[str, ...]) -> tuple[float, float, float, float]:
    """(seconds, processor seconds, peak GiB, GB written) of the command in a process of its own."""
    shutil.rmtree(out, ignore_errors=True)
    # The high-water mark of the program itself: what getrusage tells includes this process, from which it was started.
    code = (
        "import pathlib, tracklake.pipeline.cli.app\n"
        "try:\n    tracklake.pipeline.cli.app.main()\n"
        "finally:\n    print(pathlib.Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
    )
    command = [sys.executable, "-c", code, "export", "csp", "--lake", str(lake), "--out", str(out), *options, "--quiet"]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=dict(os.environ))
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    peak_gib = int(done.stdout.strip().splitlines()[-1]) * 1024 / 2**30
    return seconds, processor_s, peak_gib, sum(file.stat().st_size for file in out.iterdir()) / 1e9


def make_lake(root: Path, scale: float) -> None:
    """Write tracks, vehicles and subsets as ingestion commits them."""
    with open_for_writing(root) as writer:
        for number, (name, entries) in enumerate(RECORDINGS.items()):
            subset = make_subset(number, name, round(entries * scale))
            values = {"dataset": "ngsim", "subset": name}
            tables = ((TRACKS, subset.tracks), (VEHICLES, subset.vehicles), (SUBSETS, subset.facts))
            files = {
                table.name: write_table(root, table, frame, values, FINGERPRINT, where=name) for table, frame in tables
            }
            info = {"dataset": "ngsim", "recording": name, "subsets": [{"subset": name, "freeway": True}]}
            writer.commit(Commit(f"ingest/ngsim/{name}", FINGERPRINT, files, {"sources": []}, info))


def make_subset(number: int, name: str, entries: int) -> Subset:
    """One recording: vehicles of a lane enter about 19 m apart, change lanes now and then, and skip frames rarely."""
    random = np.random.default_rng(number)
    each = round(ROAD_M / SPEED_MPS * RATE_HZ)
    vehicles = max(LANES, round(entries / each))
    ids = np.arange(vehicles)
    headway = each * LANES / VEHICLES_A_FRAME
    entered = (ids // LANES + random.uniform(-0.34, 0.34, vehicles)) * headway + headway
    first_frame = 1 + entered.astype(np.int64)
    own, step = np.repeat(ids, each), np.tile(np.arange(each), vehicles)
    waves_m = 8 * np.sin((first_frame[own] + step) / 80)
    x_ft = (20 + (step * (SPEED_MPS / RATE_HZ) + waves_m + random.normal(0, 0.05, own.size)) / FOOT_M).round(3)
    changes = (ids % 15 == 0) * random.integers(each // 4, each, vehicles)
    changed = (changes[own] > 0) & (step >= changes[own])
    lane = ((ids % LANES)[own] + changed) % LANES + 1
    tracks = pl.DataFrame(
        {
            "vehicle_id": (own + 1).astype(np.int32), "frame": (first_frame[own] + step).astype(np.int32),
            "x_m": x_ft * FOOT_M, "y_m": (12 * (lane - 0.5) + random.normal(0, 1, own.size)).round(3) * FOOT_M,
            "lane": lane.astype(np.int16), "speed_mps": np.full(own.size, SPEED_MPS, np.float32),
            "accel_mps2": np.zeros(own.size, np.float32),
        }
    ).with_columns(
        pl.lit(None, pl.Int32).alias(name) for name in ("leader_id", "follower_id", "headway_recorded_m")
    ).filter(pl.Series(random.random(own.size) > 1e-4))  # fmt: skip
    sizes = pl.DataFrame({"vehicle_id": (ids + 1).astype(np.int32)}).with_columns(
        source_vehicle_id="vehicle_id",
        entries_announced=pl.lit(each, pl.Int32),
        length_m=4.5,
        width_m=1.9,
        **{"class": pl.lit("car")},
    )
    frames = int(tracks["frame"].max()) - int(tracks["frame"].min()) + 1
    facts = {
        "recording": name, "site": "us-101" if name.startswith("us") else "i-80", "direction": "south",
        "origin": "synthetic", "freeway": True, "frame_rate_hz": float(RATE_HZ), "lanes": LANES,
        "seconds": frames / RATE_HZ,
        "first_frame": int(tracks["frame"].min()), "on_ramp_lanes": [7], "lane_markings_m": None, "ids_split": 0,
        "columns_missing": [],
    }  # fmt: skip
    files = [RawFile(Path("generated"), "generated", sha256="0")]
    return assemble_subset(
        tracks, sizes, dataset="ngsim", name=name, facts=facts, use_recorded_headway=False, files=files
    )


def run_stages(lake: Path) -> None:
    """What --clean reads, made one after the other."""
    settings = Settings(lake=lake)
    with open_for_writing(lake) as writer:
        for name in NEEDED_BY_CLEAN:
            for job in Planner(lake, writer.manifest, settings).plan(name):
                writer.commit(build_job(STAGE_BY_NAME[name], lake, job, settings))
