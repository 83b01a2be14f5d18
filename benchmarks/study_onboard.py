"""What an on-board view costs: models fed by overhead tracks and by what an instrumented vehicle perceives.

Two samples are generated: models are trained once, on overhead tracks of the first; vehicles of the second drive as
egos, again and again: with 0 to 100 % of the vehicles connected, with and without LiDAR, with plain GPS and DGPS. The
logs are read and fused by `tracklake ingest` and `tracklake fuse`, and the same futures predicted from both views.
What is finished in the study's folder is kept, so that an interrupted study goes on where it was.

    python benchmarks/study_onboard.py             writes docs/onboard-view.csv, .svg and .md
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import torch
from study_onboard_page import write_page

from tracklake.pipeline.lake.lake import Lake, open_lake
from tracklake.pipeline.synthetic import write_sample
from tracklake.pipeline.synthetic.onboard.instrument import instrument_drive
from tracklake.pipeline.synthetic.onboard.lidar import Lidar
from tracklake.pipeline.synthetic.onboard.motion import find_drives
from tracklake.pipeline.synthetic.onboard.sensing import InstrumentConfig, sense_drive
from tracklake.schemas.arrays import Floats
from tracklake.schemas.protocols import V2V
from tracklake.training.onboard import networks
from tracklake.training.onboard.collisions import NEVER, find_overlaps
from tracklake.training.onboard.feeds import Feeds, pair_feeds, select_feeds
from tracklake.training.onboard.models import NETWORKS, Forecaster, make_forecaster, predict_places, predict_turns
from tracklake.training.onboard.samples import FEATURE_NUMBER, Samples, build_samples, describe_truth, split_samples
from tracklake.training.onboard.scores import bootstrap_mean, measure_samples
from tracklake.training.onboard.training import run_network, train_network
from tracklake.training.runs.config import TrainConfig

ROOT = Path(__file__).resolve().parent.parent
PENETRATIONS = (0.0, 0.1, 0.3, 0.6, 1.0)
LEARNED = ("stacked-lstm",)
NEAR_M = 100.0
"""Distance along the road, either way, within which vehicles are judged."""
TRAINING_SAMPLES = 6000
"""Most samples, of both parts, that models learn from and are measured on."""
LEAST_TICKS = 80
"""Shortest drive of an ego of the study, in ticks."""
SUBSETS = ("01-lower", "01-upper", "02-lower", "02-upper")
COLUMNS = ("vehicle_id", "frame", "time_s", "x_m", "y_m", "lane", "speed_mps", "accel_mps2")


@dataclass(frozen=True)
class Condition:
    """One way to perceive."""

    penetration: float
    lidar: bool
    receiver: str

    @property
    def name(self) -> str:
        """Name of the condition in the names of its drives."""
        return f"p{round(100 * self.penetration):03d}-{'lidar' if self.lidar else 'v2v'}-{self.receiver}"

    @property
    def config(self) -> InstrumentConfig:
        """Instruments of the condition; a ray every 0.4 degrees halves the time."""
        scanner = Lidar(step_deg=0.4) if self.lidar else None
        return InstrumentConfig(penetration=self.penetration, receiver=self.receiver, lidar=scanner, camera=None)


CONDITIONS = tuple(
    Condition(penetration, lidar, receiver)
    for receiver, lidar, penetration in product(("plain", "dgps"), (False, True), PENETRATIONS)
)


def main() -> None:
    """Run what is missing of the study, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=ROOT / "study" / "onboard")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "onboard-view.csv")
    parser.add_argument("--egos", type=int, default=1, help="per subset")
    parser.add_argument("--epochs", type=int, default=6)
    options = parser.parse_args()
    began = time.monotonic()
    train, evaluation = (make_lake(options.work, name, seed) for name, seed in (("train", 2), ("eval", 1)))
    models = train_models(gather_truth(train, 6), options.epochs, options.work)
    print(f"{time.monotonic() - began:6.0f} s  models trained", flush=True)
    lake = make_drives(evaluation, options.work / f"drives-{options.egos}", options.egos)
    print(f"{time.monotonic() - began:6.0f} s  {lake.table('drives').collect().height} drives fused", flush=True)
    rows = [row for condition in CONDITIONS for row in score_condition(lake, condition, models)]
    pl.DataFrame(rows).write_csv(options.out, float_precision=4)
    write_page(options.out)
    print(f"{time.monotonic() - began:6.0f} s  {options.out} and the page beside it written")


def run(*words: object) -> None:
    """Run a command of tracklake; exit code 3 says that lines of the sample were refused, as they are meant to be."""
    command = [sys.executable, "-m", "tracklake.pipeline.cli.app", *map(str, words), "--quiet"]
    done = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False)
    if done.returncode not in (0, 3):
        raise SystemExit(f"tracklake {' '.join(map(str, words))}: exit code {done.returncode}")


def make_lake(work: Path, name: str, seed: int) -> Lake:
    """Generate a sample of overhead recordings and ingest it."""
    raw = work / f"{name}-raw"
    if not raw.exists():
        write_sample(raw, formats=("highd",), minutes=0.5, seed=seed)
    run("ingest", raw, "--lake", work / name)
    return open_lake(work / name)


def read_subset(lake: Lake, subset: str) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Read tracks and vehicles of a subset."""
    own = pl.col("subset") == subset
    tracks, vehicles = (lake.table(name).filter(own).collect() for name in ("tracks", "vehicles"))
    return tracks.select(COLUMNS), vehicles


def choose_egos(tracks: pl.DataFrame, count: int) -> list[int]:
    """Choose vehicles that were recorded long enough, evenly over their ids."""
    drives = find_drives(tracks).filter(pl.col("last_tick") - pl.col("first_tick") >= LEAST_TICKS)
    ids = drives["vehicle_id"].to_list()
    return [ids[place] for place in np.linspace(0, len(ids) - 1, min(count + 2, len(ids))).astype(int)[1:-1]]


def gather_truth(lake: Lake, count: int) -> Samples:
    """Build the overhead samples around many egos of each subset, without instruments."""
    truths, drives = [], []
    for subset in SUBSETS:
        tracks, vehicles = read_subset(lake, subset)
        for ego in choose_egos(tracks, count):
            config = InstrumentConfig(lidar=None, camera=None)
            sensed = sense_drive(tracks, vehicles, {"dataset": "highd", "subset": subset}, ego, config)
            length_m, width_m, _ = sensed.motion.size_m[sensed.motion.ego]
            drives.append({"subset": f"{subset}-{ego}", "ego_length_m": length_m, "ego_width_m": width_m})
            place = {"dataset": pl.lit("v2v"), "subset": pl.lit(f"{subset}-{ego}")}
            truths.append(sensed.truth.with_columns(**place, vehicle_id=pl.col("truth_id")))
    truth = pl.concat(truths)
    samples = build_samples(describe_truth(truth), truth, pl.DataFrame(drives)).samples
    return samples.select(is_near(samples))


def is_near(samples: Samples) -> np.ndarray:
    """Find samples within NEAR_M along the road."""
    near: np.ndarray = np.abs(samples.feature[:, -1, FEATURE_NUMBER["rel_x_m"]]) <= NEAR_M
    return near


def train_models(samples: Samples, epochs: int, work: Path) -> list[Forecaster]:
    """Train every model once, on overhead samples alone; what was trained before is read again."""
    drawn = np.random.default_rng(0).permutation(len(samples))[:TRAINING_SAMPLES]
    parts = split_samples(samples.select(np.isin(np.arange(len(samples)), drawn)), seed=0)
    models = [make_forecaster("ctrv", predict_turns, parts.eval)]
    for name in LEARNED:
        kept = work / f"{name}-{epochs}-{parts.digest}.pt"
        if kept.exists():
            network = getattr(networks, NETWORKS[name][0])(V2V.horizon_ticks)
            network.load_state_dict(torch.load(kept, weights_only=True))
        else:
            network = train_network(name, parts, TrainConfig(epochs=epochs, seed=0, threads=1))
            torch.save(network.state_dict(), kept)
        # The spread of errors is measured on vehicles that were not learned from.
        models.append(make_forecaster(name, lambda given, network=network: run_network(network, given), parts.eval))
    return models


def make_drives(lake: Lake, work: Path, egos: int) -> Lake:
    """Instrument the egos under every condition, and read and fuse their logs in a lake of their own."""
    for subset in SUBSETS:
        tracks, vehicles = read_subset(lake, subset)
        for ego, condition in product(choose_egos(tracks, egos), CONDITIONS):
            out = work / "raw" / f"{subset}-{ego}-{condition.name}"
            formats = ("hex", "rosbag2") if condition.lidar else ("hex",)
            if not out.exists():
                facts = {"dataset": "highd", "subset": subset}
                instrument_drive(tracks, vehicles, facts, ego, condition.config, out, formats)
    run("ingest", work / "raw", "--lake", work / "lake")
    run("fuse", "--lake", work / "lake")
    return open_lake(work / "lake")


def read_feeds(lake: Lake, condition: Condition) -> Feeds:
    """Pair both views of a condition's drives, near the ego alone."""
    ends = pl.col("subset").str.ends_with(condition.name)
    surrounding, truth, drives = (
        lake.table(name).filter(ends).collect() for name in ("surrounding", "surrounding_truth", "drives")
    )
    feeds = pair_feeds(surrounding, truth, drives)
    near = select_feeds(feeds, is_near(feeds.overhead))
    return near._replace(ghosts=feeds.ghosts.select(is_near(feeds.ghosts)))


def score_condition(lake: Lake, condition: Condition, models: list[Forecaster]) -> Iterator[dict[str, object]]:
    """Score all models on both views under one condition."""
    feeds = read_feeds(lake, condition)
    overhead, perceived = feeds.overhead, feeds.perceived
    missed = np.ones(len(overhead))
    missed[feeds.shared] = 0.0
    due = find_overlaps(overhead, overhead.place_m) > NEVER
    about = {"penetration": condition.penetration, "lidar": condition.lidar, "receiver": condition.receiver}
    about |= {"egos": len(np.unique(overhead.subset)), "vehicles": len(np.unique(overhead.vehicle))}
    about |= {"samples": len(overhead), "missed_vehicles": int(missed.sum()), "false_vehicles": len(feeds.ghosts)}
    about |= bound("missed_share", missed[:, None], overhead, squared=False)
    for model in models:
        warned = np.zeros(len(overhead), bool)
        warned[feeds.shared] = warns(model, perceived)
        figures = {"overhead": overhead.select(feeds.shared), "perceived": perceived}
        row = {**about, "model": model.name, "warnings_due": int(due.sum())}
        row |= {"overhead_missed_warnings": int((due & ~warns(model, overhead)).sum())}
        row |= {"overhead_false_warnings": int((~due & warns(model, overhead)).sum())}
        row |= {"perceived_missed_warnings": int((due & ~warned).sum())}
        row |= {"perceived_false_warnings": int((~due & warned).sum() + warns(model, feeds.ghosts).sum())}
        for feed, samples in figures.items():
            measured = measure_samples(model, samples, predict_places(model.name, model.predict, samples))
            row |= bound(f"{feed}_rmse_m", measured["rmse_m"][:, -1:], samples, squared=True)
            row |= bound(f"{feed}_nll_nats", measured["nll_nats"][:, -1:], samples, squared=False)
        yield {**row, "n": len(perceived), "seconds": V2V.scored_s[-1]}


def warns(model: Forecaster, samples: Samples) -> np.ndarray:
    """Find the samples that a model warns of."""
    if not len(samples):
        return np.zeros(0, bool)
    return find_overlaps(samples, predict_places(model.name, model.predict, samples)) > NEVER


def bound(name: str, values: Floats, samples: Samples, *, squared: bool) -> dict[str, float | None]:
    """Return the mean of (B, 1) values with its 95 % interval over vehicles; the root of all three for squares."""
    names = (name, f"{name}_low", f"{name}_high")
    if not len(values):
        return dict.fromkeys(names)
    vehicle = np.unique(samples.vehicle, return_inverse=True)[1]
    low, high = bootstrap_mean(values, vehicle)
    figures = (float(values.mean()), float(low[0]), float(high[0]))
    return dict(zip(names, (figure**0.5 if squared else figure for figure in figures), strict=True))


if __name__ == "__main__":
    main()
