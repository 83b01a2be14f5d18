"""Time, memory, bytes and commits by the number of recordings, the place of the lake and the workers; cost per entry.

    python benchmarks/scale.py [--recordings 10 100 1000] [--workers 1 2 4] [--entries 10 20 50 100 200]

Two tables. The first: highD recordings of 5,000 rows are ingested and validated, in a folder and on an object store
(moto, an S3 server on this machine), by threads and by a local Dask cluster. The second, at --entries million rows:
recordings of 2,000,000 rows, as long as highD's longest, in a folder; 200 million take 24 GB of CSV. Commands run in
processes of their own. Processor time includes theirs and their workers', but not the store's; memory is the most that
one process and that all together held, looked at five times a second; MB are those of the live files; commits are
replacements of the manifest's root.
"""

from tracklake.pipeline.cli.memory import keep_freed_memory

keep_freed_memory()  # as each command does, before anything imports Polars

import argparse
import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import NamedTuple
from unittest import mock
from urllib.request import Request, urlopen

import psutil
from raw_files import write_highd

from tracklake.pipeline.cli import app
from tracklake.pipeline.lake import Manifest, load
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.store import LocalStore

SMALL_ROWS, LONG_ROWS = 5_000, 2_000_000
"""Rows of a recording of the first table, and of the second."""
STEPS = ("ingest", "validate")
"""Commands of a measurement."""
LOOK_S = 0.2
"""Time between two looks at the memory of the processes, in seconds."""


class Cost(NamedTuple):
    """Cost of the commands: seconds, processor seconds, most GiB of one process and of all together, and commits."""

    seconds: float
    processor_s: float
    process_gib: float
    together_gib: float
    commits: int


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, nargs="*", default=[10, 100, 1000], help="of the first table")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4], help="of the first table")
    parser.add_argument("--runners", nargs="+", default=["threads", "dask"], help="of the first table")
    parser.add_argument(
        "--entries", type=int, nargs="*", default=[10, 20, 50, 100, 200], help="of the second, millions"
    )
    parser.add_argument("--work", type=Path, help="folder for the generated files")
    parser.add_argument("--command", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.command:
        run_and_count(Path(options.command[0]), options.command[1:])
        return
    with tempfile.TemporaryDirectory(dir=options.work) as folder, run_store() as store:
        if options.recordings:
            print("| recordings | lake | runner | workers | s | processor s | process GiB | all GiB | MB | commits |")
            print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
        for recordings in options.recordings:
            measure_recordings(Path(folder), recordings, options.runners, options.workers, store)
        if options.entries:
            print("\n| entries | s | processor s | process GiB | MB | processor us per entry |")
            print("| --- | --- | --- | --- | --- | --- |")
        for millions in options.entries:
            measure_entries(Path(folder), millions)


def measure_recordings(
    work: Path, recordings: int, runners: list[str], workers: list[int], store: dict[str, str]
) -> None:
    """Print the lines of one number of recordings."""
    raw = work / f"raw-{recordings}"
    write_highd(raw, recordings, SMALL_ROWS)
    os.sync()
    for place, runner, number in product(("folder", "store"), runners, workers):
        name = f"{recordings}-{place}-{runner}-{number}"
        lake = str(work / name) if place == "folder" else make_bucket(store, name)
        environment = {"TRACKLAKE_RUNNER": runner, "TRACKLAKE_WORKERS": str(number), **store}
        cost = run_commands(raw, lake, work / f"cache-{name}", environment)
        live_bytes = measure_lake(lake, environment)
        print(
            f"| {recordings:,} | {place} | {runner} | {number} | {cost.seconds:.1f} | {cost.processor_s:.1f} | "
            f"{cost.process_gib:.2f} | {cost.together_gib:.2f} | {live_bytes / 1e6:,.1f} | {cost.commits:,} |",
            flush=True,
        )


def measure_entries(work: Path, millions: int) -> None:
    """Print the line of one number of entries."""
    with tempfile.TemporaryDirectory(dir=work) as folder:
        raw, lake = Path(folder) / "raw", Path(folder) / "lake"
        rows = write_highd(raw, max(1, millions * 1_000_000 // LONG_ROWS), LONG_ROWS)
        os.sync()  # the files are on the disk before the commands start
        cost = run_commands(raw, str(lake), lake, {"TRACKLAKE_WORKERS": "2"})
        live_bytes = measure_lake(str(lake), {})
        print(
            f"| {rows:,} | {cost.seconds:.1f} | {cost.processor_s:.1f} | {cost.process_gib:.2f} | "
            f"{live_bytes / 1e6:,.0f} | {cost.processor_s / rows * 1e6:.2f} |",
            flush=True,
        )


def run_commands(raw: Path, lake: str, cache: Path, environment: dict[str, str]) -> Cost:
    """Run the commands one after the other, each in a process of its own, and return what they cost together."""
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    most = [0, 0]
    counts = cache.with_name(f"{cache.name}-commits")
    for step in STEPS:
        source = [str(raw)] if step == "ingest" else []
        command = [sys.executable, __file__, "--command", str(counts), step, *source, "--lake", lake, "--quiet"]
        own = {"TRACKLAKE_CACHE": str(cache), "PYTHONDONTWRITEBYTECODE": ""}  # modules are compiled once
        process = subprocess.Popen(command, env={**os.environ, **own, **environment})
        watcher = threading.Thread(target=watch_memory, args=(process.pid, most))
        watcher.start()
        if process.wait():
            raise SystemExit(f"{' '.join(command)} ended with code {process.returncode}")
        watcher.join()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    commits = len(counts.read_bytes())
    return Cost(time.perf_counter() - began, processor_s, most[0] / 2**30, most[1] / 2**30, commits)


def run_and_count(counts: Path, arguments: list[str]) -> None:
    """Run a command in this process, and append a byte to a file at each replacement of the lake's root."""
    is_remote = "://" in arguments[arguments.index("--lake") + 1]
    swap = CommitLog._swap

    def swap_and_count(log: CommitLog, manifest: Manifest) -> None:
        swap(log, manifest)
        if isinstance(log.store, LocalStore) is not is_remote:  # the copy of a lake elsewhere has a root of its own
            with counts.open("ab") as file:
                file.write(b".")

    with mock.patch.object(CommitLog, "_swap", swap_and_count), mock.patch("sys.argv", ["tracklake", *arguments]):
        app.main()


def watch_memory(pid: int, most: list[int]) -> None:
    """Keep the most bytes that one process of a command held, and all of them together, until the command ends."""
    while True:
        try:
            command = psutil.Process(pid)
            held = []
            for process in (command, *command.children(recursive=True)):
                try:
                    held.append(process.memory_info().rss)
                except psutil.NoSuchProcess:
                    continue
            most[:] = max(most[0], *held), max(most[1], sum(held))
            if command.status() == psutil.STATUS_ZOMBIE:
                return
        except (psutil.NoSuchProcess, TypeError):
            return
        time.sleep(LOOK_S)


def measure_lake(lake: str, environment: dict[str, str]) -> int:
    """Return the bytes of the live files of a lake."""
    with mock.patch.dict(os.environ, environment):
        return sum(
            file.bytes or 0
            for commit in load(lake if "://" in lake else Path(lake)).commits.values()
            for file in commit.all_files
        )


@contextmanager
def run_store() -> Iterator[dict[str, str]]:
    """Run an S3 server on this machine and yield the environment that leads to it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(300):
            try:
                urlopen(f"{address}/moto-api/").close()
                break
            except OSError:
                time.sleep(0.1)
        keys = {"AWS_ACCESS_KEY_ID": "benchmark", "AWS_SECRET_ACCESS_KEY": "benchmark", "AWS_REGION": "us-east-1"}
        yield {"AWS_ENDPOINT_URL": address, **keys}
    finally:
        server.terminate()
        server.wait()


def make_bucket(store: dict[str, str], name: str) -> str:
    """Make a bucket and return the address of a lake in it."""
    urlopen(Request(f"{store['AWS_ENDPOINT_URL']}/bucket-{name}", method="PUT")).close()
    return f"s3://bucket-{name}/lake"


if __name__ == "__main__":
    main()
