"""Every rule over 10 million entries: seconds, processor seconds and peak memory of validation.

    python benchmarks/validate.py [--scale 0.1] [--workers 2]

Two cases: 20 free-flowing carriageways at 25 Hz (500,000 entries each) and 7 dense freeway recordings at 10 Hz (1.5
million each), with noise and defects enough that every rule that can be checked has something to find. Subsets are
generated and saved first; then, in a process of its own with as many threads as there are workers, each is read,
prepared, judged and scored, and what was found is written.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.quality_reports.rules.evaluate import judge, tracks_needed
from tracklake.quality_reports.rules.findings import judge_subset
from tracklake.quality_reports.rules.scene import Scene
from tracklake.schemas import TRACKS

REPEATS = 3
CASES = {
    "20 x 500,000, 25 Hz, 3 lanes": {"subsets": 20, "entries": 500_000, "rate": 25.0, "lanes": 3, "density": 0.02},
    "7 x 1,500,000, 10 Hz, 6 lanes": {"subsets": 7, "entries": 1_500_000, "rate": 10.0, "lanes": 6, "density": 0.05},
}


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0, help="of the number of entries")
    parser.add_argument("--workers", type=int, default=2, help="subsets judged at once")
    parser.add_argument("--judge", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.judge:
        judge_all(options.judge, options.workers)
        return
    print("| entries | findings | rules that fire | seconds | processor s | peak GiB |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, case in CASES.items():
        with tempfile.TemporaryDirectory() as folder:
            for number in range(case["subsets"]):
                save(Path(folder) / str(number), number, case, options.scale)
            command = [sys.executable, __file__, "--judge", folder, "--workers", str(options.workers)]
            best = min(
                (json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
                 for _ in range(REPEATS)), key=lambda run: run["seconds"],
            )  # fmt: skip
        figures = (f"{best['findings']:,}", f"{best['rules']}", f"{best['seconds']:.1f}", f"{best['processor_s']:.1f}")
        print(f"| {name} | {' | '.join(figures)} | {best['peak_gib']:.2f} |", flush=True)


def save(folder: Path, number: int, case: dict[str, float], scale: float) -> None:
    """Write one subset's tracks, vehicles and facts."""
    random = np.random.default_rng(number)
    rate, lanes, length_m = case["rate"], int(case["lanes"]), 420.0 if case["rate"] == 25 else 640.0
    speed_mps = 28.0 if rate == 25 else 9.0
    each = round(length_m / speed_mps * rate)
    vehicles = max(2, round(case["entries"] * scale / each))
    apart = each / (case["density"] * length_m)  # frames between two vehicles of one lane
    place, step = np.repeat(np.arange(vehicles), each), np.tile(np.arange(each), vehicles)
    lane = (place % lanes + 1 + (random.random(len(place)) < 0.0005)).clip(1, lanes)
    frame = ((place // lanes) * apart).astype(np.int64) + step + 1
    speed = speed_mps + random.normal(0, 0.3, len(place))
    x = step * speed_mps / rate + random.normal(0, 0.05, len(place))
    sizes = random.choice([4.6, 16.5, 30.0], vehicles, p=[0.85, 0.14, 0.01])
    leader = np.where(place >= lanes, place - lanes, -1)
    ahead = x + apart * speed_mps / rate
    seen = (leader >= 0) & (step < each - apart)
    frames = {
        "dataset": pl.repeat("highd" if rate == 25 else "ngsim", len(place), eager=True),
        "subset": pl.repeat(str(number), len(place), eager=True),
        "vehicle_id": place, "frame": frame, "time_s": (frame - 1) / rate, "x_m": x.round(3),
        "y_m": ((lane - 0.5) * 3.75 + random.normal(0, 0.5, len(place))).round(3), "lane": lane,
        "heading_rad": pl.repeat(0.0 if rate == 25 else None, len(place), dtype=pl.Float32, eager=True),
        "lateral_speed_mps": random.normal(0, 0.1, len(place)).round(2),
        "speed_mps": speed.round(2), "accel_mps2": random.normal(0, 0.6, len(place)).round(2),
        "speed_10hz_mps": speed + random.normal(0, 0.3, len(place)),
        "leader_id": pl.Series(leader).replace(-1, None),
        "gap_m": np.where(seen, ahead - x - 4.6, np.nan).round(3),
        "headway_recorded_m": np.where(seen, ahead - x + random.normal(0, 0.3, len(place)), np.nan).round(2),
    }  # fmt: skip
    tracks = pl.DataFrame(frames).with_columns(
        accel_10hz_mps2=pl.col("accel_mps2"), gap_m=pl.col("gap_m").fill_nan(None),
        headway_recorded_m=pl.col("headway_recorded_m").fill_nan(None),
    )  # fmt: skip
    tracks = spoil(tracks, random)
    folder.mkdir()
    tracks.cast({name: TRACKS.dtypes[name] for name in tracks.columns}).write_parquet(folder / "tracks.parquet")
    pl.DataFrame(
        {
            "vehicle_id": np.arange(vehicles, dtype=np.int32), "length_m": sizes.astype(np.float32),
            "width_m": np.full(vehicles, 1.8, np.float32), "class": np.where(sizes > 10, "truck", "car"),
            **dict.fromkeys(("length_range_m", "width_range_m"), np.zeros(vehicles, np.float32)),
        }
    ).write_parquet(folder / "vehicles.parquet")  # fmt: skip
    markings = [3.75 * marking for marking in range(lanes + 1)] if rate == 25 else None
    facts = {
        "frame_rate_hz": rate, "lane_markings_m": markings, "lanes": lanes,
        "first_frame": 1, "last_frame": tracks["frame"].max(),
    }  # fmt: skip
    (folder / "facts.json").write_text(json.dumps(facts))


def spoil(tracks: pl.DataFrame, random: np.random.Generator) -> pl.DataFrame:
    """Put defects that noise does not make into one entry of a thousand each, and lose as many."""
    draw = pl.Series("draw", random.integers(0, 1000, tracks.height))
    broken = {
        0: {"speed_mps": 1.0, "accel_mps2": 0.0},
        1: {"speed_mps": -0.5},
        2: {"accel_mps2": 5.0},
        3: {"gap_m": -1.0},
        4: {"headway_recorded_m": 1.0},
    }
    for number, values in broken.items():
        tracks = tracks.with_columns(
            pl.when(draw == number).then(pl.lit(value)).otherwise(name).alias(name) for name, value in values.items()
        )
    jumping = tracks.with_columns(x_m=pl.when(draw == 5).then(pl.col("x_m") + 4).otherwise("x_m"))
    return jumping.filter(draw != 6)


def judge_all(folder: Path, workers: int) -> None:
    """Judge every saved subset and print what it took, as JSON."""
    start, before = time.perf_counter(), os.times()
    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(judge_one, sorted(folder.iterdir())))
    seconds, after = time.perf_counter() - start, os.times()
    print(
        json.dumps(
            {
                "findings": sum(count for count, _ in found),
                "rules": len(set().union(*(rules for _, rules in found))),
                "seconds": seconds,
                "processor_s": after.user + after.system - before.user - before.system,
                # Of the program itself: what getrusage tells includes the process from which it was started.
                "peak_gib": int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 2**20,
            }
        )
    )


def judge_one(folder: Path) -> tuple[int, set[str]]:
    """Read, prepare and judge one subset and write what was found; how many findings, of which rules."""
    facts = json.loads((folder / "facts.json").read_text())
    tracks = pl.read_parquet(folder / "tracks.parquet", columns=list(tracks_needed()))
    vehicles = pl.read_parquet(folder / "vehicles.parquet")
    lacking = () if facts["lane_markings_m"] else ("lane_markings_m", "heading_rad")
    judged = judge(Scene(tracks, vehicles, **facts), lacking)
    judge_subset(tracks)
    judged.findings.write_parquet(folder / "findings.parquet")
    judged.vehicle_scores.write_parquet(folder / "vehicle_scores.parquet")
    return judged.findings.height, set(judged.findings["rule"].unique())


if __name__ == "__main__":
    main()
