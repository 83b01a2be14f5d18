"""Peak memory of each step on one long recording, by its length: a corridor of I-24 MOTION, ingested in slices.

    python benchmarks/slices.py                          # 4 and 12 million entries
    python benchmarks/slices.py --entries 30e6 --slice-entries 2e6

Each step runs in a process of its own, with one worker. Memory is the process's peak, imports included: all that is
resident, and what of it is its own (RssAnon of Linux), without the pages of files that are mapped into it, which the
system takes back where it needs them.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import discover
from tracklake.pipeline.lake import load, open_for_writing
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.sources.csv import hash_raw
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.registry import STAGE_BY_NAME

STEPS = ("read", "ingest", "validate", "repair", "reconstruct", "revalidate", "traffic", "samples", "split", "tensors")
RATE_HZ = 25
START_S = 1_669_118_400
DRIVE_ENTRIES = 6_000
"""Entries of a vehicle: 4 minutes on the road."""
HEADWAY_FRAMES = 45
"""Frames between two vehicles that enter a lane."""
LANES_FT = (18.0, 30.0, 42.0, 54.0)


def list_documents(entries: int) -> Iterator[str]:
    """Write the documents of both carriageways, in the order in which the vehicles enter."""
    rng = np.random.default_rng(3)
    steps = np.arange(DRIVE_ENTRIES)
    for number in range(round(entries / DRIVE_ENTRIES)):
        sign, lane = (1, -1)[number % 2], number // 2 % 4
        first = number // 8 * HEADWAY_FRAMES + int(rng.integers(0, HEADWAY_FRAMES // 2))
        way = 80 * steps / RATE_HZ + 40 * np.sin(steps / 400 + number) + rng.normal(0, 0.01, DRIVE_ENTRIES)
        change = 6 * np.tanh((steps - rng.integers(500, 5500)) / 40) + 6 if lane == 1 and number % 3 == 0 else 0
        document = {
            "_id": {"$oid": f"73796e746865746963{number:06x}"},
            "timestamp": np.round(START_S + (first + steps) / RATE_HZ, 3).tolist(),
            "x_position": np.round((59 if sign == 1 else 63) * 5280 + sign * way, 2).tolist(),
            "y_position": np.round(LANES_FT[lane] + change + rng.normal(0, 0.02, DRIVE_ENTRIES), 2).tolist(),
            "length": 15.0,
            "width": 6.0,
            "height": 5.0,
            "coarse_vehicle_class": 0,
            "direction": sign,
        }
        yield json.dumps(document, separators=(",", ":"))


def write_corridor(file: Path, entries: int) -> None:
    """Write a list of trajectories with about so many entries."""
    with file.open("w", encoding="utf-8") as out:
        for number, document in enumerate(list_documents(entries)):
            out.write(("[" if number == 0 else ",\n") + document)
        out.write("]\n")


def watch_memory(found: list[int]) -> None:
    """Measure the memory of this process again and again, in MB."""
    while True:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        found.append(next(int(line.split()[1]) // 1024 for line in lines if line.startswith("RssAnon")))
        time.sleep(0.02)


def run_step(folder: Path, step: str, slice_entries: int) -> None:
    """Run one step in this process and print its peaks of memory, in MB."""
    memory: list[int] = []
    threading.Thread(target=watch_memory, args=[memory], daemon=True).start()
    root = folder / "lake"
    settings = Settings(slice_entries=slice_entries, workers=1)
    found = discover(folder / "raw", recording="corridor", digest=hash_raw)
    with open_for_writing(root) as writer:
        if step == "read":
            for source, file in ingest.find_unread_files(found, writer.manifest):
                writer.remember_sources({file.sha256: ingest.read_file(root, source.name, file)})
            # The end of a session clears the staging folder: the rows are kept for the next step.
            (root / ".staging" / "spilled").rename(folder / "spilled")
        elif step == "ingest":
            (root / ".staging").mkdir(exist_ok=True)
            (folder / "spilled").rename(root / ".staging" / "spilled")
            for job in ingest.plan(found, writer.manifest):
                writer.commit(ingest.build(root, job, slice_entries))
        else:
            for job in Planner(root, writer.manifest, settings).plan(step):
                writer.commit(build_job(STAGE_BY_NAME[step], root, job, settings))
    entries = sum(file.rows or 0 for file in load(root).live("tracks"))
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(json.dumps({"entries": entries, "mb": f"{resident} ({max(memory)})"}))


def main() -> None:
    """Measure all steps for each length."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--entries", type=float, nargs="+", default=[4e6, 12e6])
    parser.add_argument("--slice-entries", type=float, default=1e6)
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.step:
        run_step(arguments.folder, arguments.step, int(arguments.slice_entries))
        return
    print(f"slices of {arguments.slice_entries:,.0f} entries with their context; peak MB (own)")
    print("| entries |", " | ".join(STEPS), "|")
    print("| --- |" + " --- |" * len(STEPS))
    for entries in arguments.entries:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "raw").mkdir()
            write_corridor(folder / "raw" / "corridor.json", int(entries))
            peaks = []
            for step in STEPS:
                options = ["--step", step, "--folder", name, "--slice-entries", str(arguments.slice_entries)]
                done = subprocess.run(
                    [sys.executable, __file__, *options], stdout=subprocess.PIPE, text=True, check=True
                )
                peaks.append(json.loads(done.stdout.splitlines()[-1]))
            print(f"| {peaks[-1]['entries']:,} |", " | ".join(peak["mb"] for peak in peaks), "|", flush=True)


if __name__ == "__main__":
    main()
