"""Ingestion against its floor: what bare Polars takes to turn the same CSV into Parquet.

    python benchmarks/ingest.py [--scale 0.1]

Each of the cases is generated at full size (times --scale), turned into Parquet by
`polars.scan_csv(schema).sink_parquet(zstd)` one file at a time, and ingested by `tracklake ingest` in a process of its
own against a standing Prefect server. Prefect's start-up is what an ingest of 1,000 rows takes, and shown apart.

The floor compresses as bare Polars does (zstd, level 3), ingestion at its own level 1: that choice is part of what is
compared. (At level 1 the floor would take about a sixth less CPU time on highD's format, for files an eighth larger.)
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import polars as pl
from raw_files import ngsim_rows, write_export, write_highd, write_text

from tracklake.pipeline.lake.files import ZSTD_LEVEL
from tracklake.pipeline.sources.ngsim_dialects import EXPORT_FIELDS
from tracklake.schemas.raw_highd import RAW_TRACKS_FIELDS

REPEATS = 3
FLOOR_LEVEL = 3
"""Level of zstd that bare Polars uses by default."""


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0, help="of the full sizes")
    parser.add_argument("--work", type=Path, help="folder for the generated files (several GB at scale 1)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.work) as work:
        environment = {**os.environ, "PREFECT_HOME": f"{work}/prefect"}
        with PrefectServer(environment) as address:
            environment["PREFECT_API_URL"] = address
            measure_all(Path(work), options.scale, environment)


class PrefectServer:
    """A standing server for the length of a block."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.environment = environment

    def __enter__(self) -> str:
        """Start it and wait until it answers; gives its address."""
        import socket
        from urllib.request import urlopen

        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        command = [str(Path(sys.executable).with_name("prefect")), "server", "start", "--port", str(port), "--no-ui"]
        environment = {**self.environment, "PREFECT_SERVER_ANALYTICS_ENABLED": "false", "DO_NOT_TRACK": "1"}
        self.process = subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        address = f"http://127.0.0.1:{port}/api"
        for _ in range(600):
            try:
                urlopen(f"{address}/health").close()
                return address
            except OSError:
                time.sleep(0.1)
        raise RuntimeError("the Prefect server did not start within a minute")

    def __exit__(self, *_: object) -> None:
        """Stop it with all its processes."""
        import signal

        os.killpg(self.process.pid, signal.SIGTERM)
        self.process.wait()


def measure_all(work: Path, scale: float, environment: dict[str, str]) -> None:
    """Generate, measure and print one case after the other."""
    tiny = work / "tiny"
    write_highd(tiny, recordings=1, rows=1_000)
    startup = min(ingest(tiny, work, environment)[0] for _ in range(2))
    print(f"floor: zstd level {FLOOR_LEVEL}, Polars' default; tracklake ingest: zstd level {ZSTD_LEVEL}")
    print(f"start-up (1,000 rows): {startup:.1f} s, shown apart below")
    print("| files | rows | CSV GB | floor s | ingest s | less start-up s | ratio | peak GiB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, make in CASES.items():
        folder = work / "raw"
        rows, floor_files = make(folder, scale)
        floor = min(measure_floor(floor_files, work) for _ in range(REPEATS))
        runs = [ingest(folder, work, environment) for _ in range(REPEATS)]
        seconds, peak = min(run[0] for run in runs), max(run[1] for run in runs)
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e9
        net = seconds - startup
        figures = (f"{size:.2f}", f"{floor:.1f}", f"{seconds:.1f}", f"{net:.1f}", f"{net / floor:.2f}", f"{peak:.2f}")
        print(f"| {name} | {rows:,} | {' | '.join(figures)} |", flush=True)
        shutil.rmtree(folder)
        for path in floor_files:
            path.unlink(missing_ok=True)


def make_highd(folder: Path, scale: float) -> tuple[int, list[Path]]:
    """20 recordings of 500,000 rows."""
    rows = write_highd(folder, recordings=20, rows=round(500_000 * scale))
    return rows, sorted(folder.glob("*_tracks.csv"))


def make_long_highd(folder: Path, scale: float) -> tuple[int, list[Path]]:
    """Four recordings of 2,020,000 rows, as many as highD's longest has (2,019,752)."""
    rows = write_highd(folder, recordings=4, rows=round(2_020_000 * scale))
    return rows, sorted(folder.glob("*_tracks.csv"))


def make_export(folder: Path, scale: float) -> tuple[int, list[Path]]:
    """The portal's one file: 11.85 million rows of nine recordings."""
    folder.mkdir()
    rows = ngsim_rows(round(11_850_000 * scale), recordings=9)
    write_export(folder / "export.csv", rows, EXPORT_FIELDS)
    return rows.height, [folder / "export.csv"]


def make_text(folder: Path, scale: float) -> tuple[int, list[Path]]:
    """Three 18-column text files of 1.5 million rows; their floor is the same rows as CSV."""
    folder.mkdir()
    rows = ngsim_rows(round(4_500_000 * scale), recordings=3)
    floors = []
    key = pl.col("Global_Time") - 100 * pl.col("Frame_ID")
    for number, part in enumerate(rows.with_columns(key=key).partition_by("key", include_key=False)):
        write_text(folder / f"{number}.txt", part)
        floors.append(folder.parent / f"floor-{number}.csv")
        part.write_csv(floors[-1])
    return rows.height, floors


CASES: dict[str, Callable[[Path, float], tuple[int, list[Path]]]] = {
    "highD, 20 recordings": make_highd,
    "highD, 4 recordings of the longest's size": make_long_highd,
    "NGSIM, 25-column export": make_export,
    "NGSIM, 18-column text": make_text,
}


def measure_floor(files: list[Path], work: Path) -> float:
    """Seconds for bare Polars: typed scan, zstd Parquet, one file at a time."""
    start = time.perf_counter()
    for file in files:
        with file.open() as handle:
            names = handle.readline().strip().lstrip("\ufeff").split(",")
        integers = ("frame", "id", "laneId", "Vehicle_ID", "Frame_ID", "Global_Time", "v_Class", "Lane_ID")
        quoted = ("Total_Frames", "Preceding", "Following", "Space_Headway", "Time_Headway", "Location")
        export = "Location" in names
        schema = {
            name: pl.Int64
            if name in integers or (name.endswith("Id") and name in RAW_TRACKS_FIELDS)
            else pl.String
            if export and (name in quoted or name in EXPORT_FIELDS[14:20])
            else pl.Float64
            for name in names
        }
        target = work / "floor.parquet"
        pl.scan_csv(file, schema=schema).sink_parquet(target, compression="zstd", compression_level=FLOOR_LEVEL)
        target.unlink()
    return time.perf_counter() - start


def ingest(source: Path, work: Path, environment: dict[str, str]) -> tuple[float, float]:
    """(seconds, peak GiB) of `tracklake ingest` in a process of its own."""
    lake = work / "lake"
    shutil.rmtree(lake, ignore_errors=True)
    # The high-water mark of the program itself: what getrusage tells includes this process, from which it was started.
    code = (
        "import pathlib, tracklake.pipeline.cli.app\n"
        "try:\n    tracklake.pipeline.cli.app.main()\n"
        "finally:\n    print(pathlib.Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
    )
    command = [sys.executable, "-c", code, "ingest", str(source), "--lake", str(lake), "--workers", "2", "--quiet"]
    start = time.perf_counter()
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    seconds = time.perf_counter() - start
    return seconds, int(done.stdout.strip().splitlines()[-1]) * 1024 / 2**30


if __name__ == "__main__":
    main()
