"""A million V2V messages from their files to the tables of a drive, in each format.

    python benchmarks/v2v_messages.py [--messages 1000000] [--format bsmp1] [--repeats 3]

Two hundred vehicles send at 10 Hz, each with another temporary id after five minutes. Reading turns the file into rows,
assembling puts them on one clock, finds senders, repeated and lost messages. Ingestion is all of it in this process,
with recognition, hashes, validation, Parquet and the commit; Prefect's start-up is not in it (benchmarks/ingest.py).
Processor time is that of ingestion on all cores: on a machine that does other work it says more than the clock.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import polars as pl

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import Digests, discover
from tracklake.pipeline.lake import open_for_writing
from tracklake.pipeline.sources.accounting import FILE
from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.assembly import assemble_messages, date_messages
from tracklake.pipeline.sources.v2v.bsmp1 import read_bsmp1
from tracklake.pipeline.sources.v2v.messages import MESSAGE_SCHEMA, RawMessages
from tracklake.pipeline.sources.v2v.pilot_json import read_pilot_json
from tracklake.pipeline.synthetic.onboard.bsmp1_files import write_bsmp1
from tracklake.pipeline.synthetic.onboard.hex_files import write_hex
from tracklake.pipeline.synthetic.onboard.pilot_files import write_pilot

Result = TypeVar("Result")
VEHICLES = 200
START_US = 1_600_000_000_000_000
METRES_PER_DEGREE = 111_195.0
FORMATS: dict[str, tuple[Callable[[Path, pl.DataFrame], None], Callable[[RawFile], RawMessages]]] = {
    "bsmp1": (write_bsmp1, read_bsmp1),
    "wyoming": (lambda path, rows: write_pilot(path, rows, "wyoming"), read_pilot_json),
    "tampa": (lambda path, rows: write_pilot(path, rows, "tampa"), read_pilot_json),
    "hex": (write_hex, read_pilot_json),
}


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--format", choices=FORMATS, help="only this one")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    messages = make_messages(options.messages)
    print(f"best and median of {options.repeats}, in s")
    print("| format | messages | MB | read | assemble | ingest | processor time |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in [options.format] if options.format else FORMATS:
        with tempfile.TemporaryDirectory() as work:
            measure(name, messages, Path(work), options.repeats)


def make_messages(count: int) -> pl.DataFrame:
    """Make messages of vehicles that drive north side by side; the first is the ego."""
    random = np.random.default_rng(1)
    ticks = count // VEHICLES
    vehicle, tick = np.tile(np.arange(VEHICLES), ticks), np.repeat(np.arange(ticks), VEHICLES)
    speed = random.uniform(20, 34, VEHICLES)[vehicle]
    along_m = 7.0 * (vehicle // 4) + speed * tick / 10
    utc_us = START_US + 100_000 * tick + 1000 * (vehicle % 100)
    size = len(vehicle)
    columns = {
        "line": np.arange(1, size + 1),
        "utc_us": utc_us,
        "received_us": utc_us + 1000 * random.integers(5, 60, size),
        "own": vehicle == 0,
        "message_count": (tick + vehicle) % 128,
        "lat_deg": 40 + along_m / METRES_PER_DEGREE,
        "lon_deg": -83 + 3.5 * (vehicle % 4) / 85_000,
        "elevation_m": random.normal(200, 1, size),
        "speed_mps": speed,
        "heading_deg": random.uniform(0, 0.5, size),
        **{f"{name}accel_mps2": random.normal(0, 0.3, size) for name in ("", "lateral_", "vertical_")},
        "yaw_rate_degps": random.normal(0, 0.5, size),
        "steering_angle_deg": random.normal(0, 4, size),
        "semi_major_m": np.full(size, 2.0),
        "semi_minor_m": np.full(size, 1.5),
        "orientation_deg": np.full(size, 45.0),
        "length_m": 4.0 + 0.01 * vehicle,
        "width_m": np.full(size, 1.9),
    }
    changed = tick >= 3000 + vehicle
    names = np.array([f"{1 + number:08X}" for number in range(2 * VEHICLES)])
    frame = pl.DataFrame(columns).with_columns(
        pl.Series("temporary_id", names[vehicle + VEHICLES * changed]),
        receiver=None,
        sender=None,
        second_mark_ms=None,
        transmission=pl.lit("forwardGears"),
    )
    return frame.select(pl.col(name).cast(dtype) for name, dtype in MESSAGE_SCHEMA.items())


def measure(name: str, messages: pl.DataFrame, work: Path, repeats: int) -> None:
    """Write one file, take it in several times and print its row."""
    write, read = FORMATS[name]
    path = work / "source" / f"drive.{'csv' if name == 'bsmp1' else 'json'}"
    path.parent.mkdir()
    write(path, messages)
    seconds: dict[str, list[float]] = {"read": [], "assemble": [], "ingest": [], "processor": []}
    for repeat in range(repeats):
        raw, taken = time_call(lambda: read(RawFile(path, path.name)))
        seconds["read"].append(taken)
        rows = raw.frame.with_columns(pl.lit(0, pl.Int64).alias(FILE))
        assembled, taken = time_call(lambda rows=rows: assemble_messages(date_messages(rows), START_US))
        seconds["assemble"].append(taken)
        assert assembled.bsm.height == messages.height, assembled.rejects
        assert assembled.stations.height == VEHICLES, assembled.stations
        del raw, rows, assembled
        before = time.process_time()
        _, taken = time_call(lambda repeat=repeat: ingest_folder(path.parent, work / f"lake-{repeat}"))
        seconds["ingest"].append(taken)
        seconds["processor"].append(time.process_time() - before)
    figures = (f"{min(taken):.1f} ({statistics.median(taken):.1f})" for taken in seconds.values())
    print(f"| {name} | {messages.height:,} | {path.stat().st_size / 1e6:.0f} | {' | '.join(figures)} |", flush=True)


def time_call(call: Callable[[], Result]) -> tuple[Result, float]:
    """Call a function; returns its result and the seconds it took."""
    start = time.perf_counter()
    result = call()
    return result, time.perf_counter() - start


def ingest_folder(folder: Path, lake: Path) -> None:
    """Ingest a folder into a new lake, without Prefect."""
    with open_for_writing(lake) as writer:
        for job in ingest.plan(discover(folder, digest=Digests(lake)), writer.manifest):
            writer.commit(ingest.build(lake, job))


if __name__ == "__main__":
    main()
