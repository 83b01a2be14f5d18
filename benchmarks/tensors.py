"""Tensors of 10 million entries: seconds and memory of building them, samples a second of reading them.

    python benchmarks/tensors.py [--scale 0.1] [--seconds 3] [--work DIR]

Two cases: 20 free-flowing carriageways at 25 Hz (500,000 entries each) and 7 dense freeway recordings at 10 Hz (1.5
million each), on the protocol's 5 Hz. The tables that the tensors stage reads are generated and saved first. Everything
is then measured in processes of their own, each on one core and with one torch thread, best of three by processor time:

- building: reading the tables, putting the tracks on the clock, building the arrays, writing the folder;
- reading: histories, futures, masks, neighbors' histories, cells and maneuvers, by batches of 128 and of 1024, in the
  samples' own order and shuffled; from float32 and from int16 positions;
- beside it a dataset that reads one sample at a time, as the reference implementation's does: the 39 cells of its
  grid one by one, each vehicle's track searched for the frame, arrays filled row by row.

Memory is what the process allocates (RssAnon, at its highest while reading) and what it has mapped of the folder, which
is the system's page cache and shared.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from reference_loader import Reference

from tracklake.pipeline.lake.tensor_files import write_tensors
from tracklake.pipeline.transforms.resample import put_on_clock
from tracklake.pipeline.transforms.tensors.arrays import SubsetTensors, build_subset_tensors
from tracklake.pipeline.transforms.tensors.entries import TensorInputs
from tracklake.schemas.arrays import expand_ranges
from tracklake.schemas.columns import Table
from tracklake.schemas.findings import FINDINGS
from tracklake.schemas.protocols import CSP
from tracklake.schemas.samples import NEIGHBORS, SAMPLES
from tracklake.schemas.splits import SPLITS
from tracklake.schemas.vehicles import VEHICLES

REPEATS = 3
CASES = {
    "20 x 500,000 at 25 Hz, 3 lanes": {"subsets": 20, "entries": 500_000, "rate": 25.0, "lanes": 3, "apart_m": 45.0},
    "7 x 1,500,000 at 10 Hz, 6 lanes": {"subsets": 7, "entries": 1_500_000, "rate": 10.0, "lanes": 6, "apart_m": 11.0},
}
ORDERS: dict[str, int | None] = {"own": None, "shuffled": 1}
"""Seed of the shuffle for each order of reading."""
HALF_GRID_M, CELL_M = 27.432, 4.572


def main() -> None:
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0, help="of the number of entries")
    parser.add_argument("--seconds", type=float, default=3.0, help="of processor time for each measurement of reading")
    parser.add_argument("--work", type=Path, help="folder for the files (3 GB at scale 1)")
    for name in ("build", "read"):
        parser.add_argument(f"--{name}", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.build:
        report(build(**json.loads(options.build)))
        return
    if options.read:
        report(read(**json.loads(options.read), seconds=options.seconds))
        return
    building, reading = [], []
    for name, case in CASES.items():
        with tempfile.TemporaryDirectory(dir=options.work) as work:
            tables = Path(work) / "tables"
            for number in range(case["subsets"]):
                save(tables / f"{number:02}", number, case, options.scale)
            for storage in ("float32", "int16-decimetres"):
                out = Path(work) / storage
                built = best("--build", {"tables": str(tables), "out": str(out), "storage": storage})
                building.append((name, storage, built))
                for batch_size in (128, 1024):
                    for order in ORDERS if storage == "float32" else ("shuffled",):
                        request = {"folder": str(out), "batch_size": batch_size, "order": order}
                        reading.append((name, storage, best("--read", request, options.seconds) | request))
            request = {"folder": str(Path(work) / "float32"), "batch_size": 128, "order": "one at a time"}
            reading.append((name, "float32", best("--read", request, options.seconds) | request))
    show(building, reading)


def show(building: list[tuple[str, str, dict[str, Any]]], reading: list[tuple[str, str, dict[str, Any]]]) -> None:
    """Print both tables."""
    print("| entries | positions | samples | neighbors | seconds | processor s | peak GiB | GB written |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, storage, run in building:
        figures = (
            f"{run['samples']:,}", f"{run['neighbors']:,}", f"{run['seconds']:.1f}", f"{run['processor_s']:.1f}",
            f"{run['peak_gib']:.2f}", f"{run['bytes'] / 1e9:.2f}",
        )  # fmt: skip
        print(f"| {name} | {storage} | {' | '.join(figures)} |")
    print("\n| entries | positions | order | batch | samples/s | neighbors/sample | allocated MiB | mapped MiB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, storage, run in reading:
        figures = (
            f"{run['samples'] / run['processor_s']:,.0f}", f"{run['neighbors'] / run['samples']:.1f}",
            f"{run['anonymous_mib']:.0f}", f"{run['mapped_mib']:.0f}",
        )  # fmt: skip
        print(f"| {name} | {storage} | {run['order']} | {run['batch_size']} | {' | '.join(figures)} |", flush=True)


def best(flag: str, request: dict[str, Any], seconds: float = 0.0) -> dict[str, Any]:
    """Return the best of several runs, each in a process of its own on one core."""
    command = [sys.executable, __file__, flag, json.dumps(request), "--seconds", str(seconds)]
    environment = os.environ | {"POLARS_MAX_THREADS": "1", "OMP_NUM_THREADS": "1"}
    runs = [
        json.loads(subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout)
        for _ in range(REPEATS)
    ]
    return max(runs, key=lambda run: run["samples"] / run["processor_s"])


def report(found: dict[str, Any]) -> None:
    """Print one run's figures for the parent process."""
    print(json.dumps(found | {"peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20}))


def save(folder: Path, number: int, case: dict[str, Any], scale: float) -> None:
    """Write one subset's tracks, samples and neighbors: vehicles of a lane `apart_m` behind each other, lanes shifted.

    Everyone keeps speed, so that who stands in whose grid does not change, and the tables can be written down at once.
    """
    random = np.random.default_rng(number)
    rate, lanes, speed_mps, length_m = case["rate"], case["lanes"], 9.0, 640.0
    if rate == 25:
        speed_mps, length_m = 28.0, 420.0
    each = round(length_m / speed_mps * rate)
    vehicles = max(2 * lanes, round(case["entries"] * scale / each))
    own = np.arange(vehicles)
    place_m = -(own // lanes) * case["apart_m"] - (own % lanes) % 2 * case["apart_m"] / 2  # at frame 0
    first = np.ceil(-place_m / speed_mps * rate).astype(np.int64) + 1
    vehicle, step = np.repeat(own, each), np.tile(np.arange(each), vehicles)
    frame = first[vehicle] + step
    folder.mkdir(parents=True)
    pl.DataFrame(
        {
            "vehicle_id": vehicle.astype(np.int32), "frame": frame.astype(np.int32),
            "x_m": (place_m[vehicle] + frame * speed_mps / rate + random.normal(0, 0.05, len(frame))).round(3),
            "y_m": ((vehicle % lanes + 0.5) * 3.75 + random.normal(0, 0.3, len(frame))).round(3),
            "lane": (vehicle % lanes + 1).astype(np.int16),
            "speed_mps": np.full(len(frame), speed_mps, np.float32),
        }
    ).write_parquet(folder / "tracks.parquet")  # fmt: skip
    table(VEHICLES, vehicles, {"vehicle_id": own, "length_m": 4.5, "width_m": 1.9}).write_parquet(
        folder / "vehicles.parquet")  # fmt: skip
    broken = np.repeat(own, 5)  # a finding every fifth of a track
    begins = first[broken] + np.tile(np.arange(5) * (each // 5), vehicles)
    table(FINDINGS, len(broken), {
        "vehicle_id": broken, "severity": "warning", "first_frame": begins, "last_frame": begins + 2,
    }).write_parquet(folder / "findings.parquet")  # fmt: skip
    stride = rate / CSP.rate_hz
    low = np.ceil((first - 1) / stride).astype(np.int64)
    high = np.floor((first + each - 2) / stride).astype(np.int64)
    sampled, last = low + CSP.history_ticks - 1, high - CSP.min_future_ticks
    counts = np.maximum(last - sampled + 1, 0)
    who, tick = np.repeat(own, counts), expand_ranges(sampled, counts)[0]
    shown = {"protocol": CSP.name, "dataset": "highd", "subset": folder.name}
    table(SAMPLES, len(who), shown | {
        "vehicle_id": who, "tick": tick, "lane": who % lanes + 1,
        "lateral_maneuver": random.choice(["keep", "left", "right"], len(who)), "longitudinal_maneuver": "normal",
    }).write_parquet(folder / "samples.parquet")  # fmt: skip
    ahead = [(d, s) for d in range(-4, 5) for s in (-1, 0, 1) if (d, s) != (0, 0)]
    pairs = [pair(own, d, s, lanes, place_m) for d, s in ahead]
    one, other, cell = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    begin, end = np.maximum(sampled[one], low[other]), np.minimum(last[one], high[other])
    counts = np.maximum(end - begin + 1, 0)
    table(NEIGHBORS, int(counts.sum()), shown | {
        "vehicle_id": np.repeat(one, counts), "tick": expand_ranges(begin, counts)[0], "cell": np.repeat(cell, counts),
        "neighbor_id": np.repeat(other, counts), "dx_m": 0.0,
    }).sort("vehicle_id", "tick", "cell").write_parquet(folder / "neighbors.parquet")  # fmt: skip


def pair(
    own: np.ndarray, ranks: int, side: int, lanes: int, place_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vehicles so many ranks and lanes apart that stand in each other's grid: (one, other, cell)."""
    other = own + ranks * lanes + side
    exists = (own % lanes + side >= 0) & (own % lanes + side < lanes) & (other >= 0) & (other < len(own))
    one, other = own[exists], other[exists]
    dx_m = place_m[other] - place_m[one]
    near = np.abs(dx_m) < HALF_GRID_M
    cell = 13 * (side + 1) + np.round(dx_m / CELL_M).astype(np.int64) + 6
    return one[near], other[near], cell[near]


def table(declared: Table, rows: int, values: dict[str, Any]) -> pl.DataFrame:
    """A frame of a declared table; what is not given is null."""
    columns = {
        name: pl.Series(name, values[name], dtype=dtype)
        if isinstance(values.get(name), np.ndarray)
        else pl.repeat(values.get(name), rows, dtype=dtype, eager=True)
        for name, dtype in declared.dtypes.items()
    }
    return pl.DataFrame(columns)


def build(tables: str, out: str, storage: str) -> dict[str, Any]:
    """Read every saved subset, build its arrays and write the folder."""
    folders = sorted(Path(tables).iterdir())
    case = next(case for case in CASES.values() if case["subsets"] == len(folders))
    rows = [("bench", "highd", f.name, 0, 0, 2**31 - 1, None, None, ("train", "eval")[i % 2])
            for i, f in enumerate(folders)]  # fmt: skip
    splits = pl.DataFrame(rows, schema=SPLITS.dtypes, orient="row")
    target = Path(out)
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()

    def subsets() -> Iterator[tuple[dict[str, Any], list[SubsetTensors]]]:
        clock = {"first_frame": 1, "frame_rate_hz": case["rate"]}
        for folder in folders:
            tensors = build_subset_tensors(
                put_on_clock(pl.read_parquet(folder / "tracks.parquet"), rate_hz=CSP.rate_hz, **clock),
                pl.read_parquet(folder / "samples.parquet", columns=[
                    "protocol", "vehicle_id", "tick", "lateral_maneuver", "longitudinal_maneuver"]),
                pl.read_parquet(folder / "neighbors.parquet", columns=[
                    "protocol", "vehicle_id", "tick", "cell", "neighbor_id"]),
                TensorInputs(splits.filter(pl.col("subset") == folder.name),
                vehicles=pl.read_parquet(folder / "vehicles.parquet"), findings=pl.read_parquet(
                    folder / "findings.parquet"),
                protocol=CSP, storage=storage, **clock),
            )  # fmt: skip
            yield {"dataset": "highd", "subset": folder.name, "origin": "synthetic", "frame_rate_hz": case["rate"],
                   "lane_markings_m": None}, [tensors]  # fmt: skip

    start, before = time.perf_counter(), time.process_time()
    index = write_tensors(target, subsets(), splits, CSP, storage=storage)
    return {
        "samples": index["sizes"]["S"], "neighbors": index["sizes"]["K"], "seconds": time.perf_counter() - start,
        "processor_s": time.process_time() - before, "bytes": sum(file.stat().st_size for file in target.iterdir()),
    }  # fmt: skip


def read(folder: str, batch_size: int, order: str, seconds: float) -> dict[str, Any]:
    """Read batches of the training part for so long, starting over where it ends."""
    from tracklake.training.data.tensor_folder import TensorFolder

    opened = TensorFolder.open(Path(folder))
    if order == "one at a time":
        reference = Reference(opened)

        def batches() -> Iterator[tuple[int, int]]:
            return reference.batches("train", batch_size, seed=1)
    else:

        def batches() -> Iterator[tuple[int, int]]:
            for batch in opened.batches("train", batch_size, shuffle_seed=ORDERS[order]):
                yield len(batch), len(batch.neighbor_sample)

    samples, neighbors, watch = 0, 0, Watch()
    endless = (counts for _ in iter(int, 1) for counts in batches())
    for _ in range(20):  # the first pages, and NumPy's own buffers
        next(endless)
    start = time.process_time()
    with watch:
        while (spent := time.process_time() - start) < seconds:
            for _ in range(10):
                count, others = next(endless)
                samples, neighbors = samples + count, neighbors + others
        spent = time.process_time() - start
    return {"samples": samples, "neighbors": neighbors, "processor_s": spent,
            "anonymous_mib": watch.anonymous_mib, "mapped_mib": watch.mapped_mib}  # fmt: skip


class Watch:
    """Reads this process's memory ten times a second."""

    def __init__(self) -> None:
        self.anonymous_mib = self.mapped_mib = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> None:
        """Begin."""
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        """End."""
        self._stop.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._stop.wait(0.1):
            lines = Path("/proc/self/status").read_text().splitlines()
            kib = {
                key: int(rest.split()[0]) for key, _, rest in (line.partition(":") for line in lines) if "Rss" in key
            }
            self.anonymous_mib = max(self.anonymous_mib, kib["RssAnon"] / 1024)
            self.mapped_mib = max(self.mapped_mib, kib["RssFile"] / 1024)


if __name__ == "__main__":
    main()
