"""What an on-board view costs: models fed by overhead tracks and by what an instrumented vehicle perceives.

Samples are generated: models are trained once, on overhead tracks of the first; vehicles of the others drive as egos,
again and again: with 0 to 100 % of the vehicles connected, with and without LiDAR, with plain GPS and DGPS. The logs
are read and fused by `tracklake ingest` and `tracklake fuse`, and the same futures predicted from both views. One group
of egos is spread over the recordings; around those of the other, warnings of collisions are due.
What is finished in the study's folder is kept, so that an interrupted study goes on where it was.

    python benchmarks/study_onboard.py             writes docs/onboard-view.csv, .svg and .md
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import torch
from study_onboard_page import DUE, MOST_TURN_DEG, NEAR_M, SPREAD, write_page
from study_onboard_scores import Judged, score_condition

from tracklake.pipeline.lake.lake import Lake, open_lake
from tracklake.pipeline.synthetic import write_sample
from tracklake.pipeline.synthetic.onboard.instrument import instrument_drive
from tracklake.pipeline.synthetic.onboard.lidar import Lidar
from tracklake.pipeline.synthetic.onboard.motion import find_drives
from tracklake.pipeline.synthetic.onboard.sensing import InstrumentConfig, sense_drive
from tracklake.schemas.arrays import Singles
from tracklake.schemas.protocols import V2V
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.onboard import networks
from tracklake.training.onboard.collisions import NEVER, find_overlaps
from tracklake.training.onboard.feeds import Feeds, pair_feeds, select_feeds
from tracklake.training.onboard.models import NETWORKS, Forecaster, make_forecaster, predict_turns
from tracklake.training.onboard.samples import FEATURE_NUMBER, Samples, build_samples, describe_truth, split_samples
from tracklake.training.onboard.training import run_network, train_network
from tracklake.training.runs.config import TrainConfig

ROOT = Path(__file__).resolve().parent.parent
PENETRATIONS = (0.0, 0.1, 0.3, 0.6, 1.0)
LEARNED = ("stacked-lstm", "lstm-encoder-decoder")
AROUND_TICKS = 40
"""Ticks of the drive before the first and after the last moment at which a warning is due: history, future and 2 s."""
LEAST_TICKS = 80
"""Shortest drive of an ego of the study, in ticks."""
SUBSETS = ("01-lower", "01-upper", "02-lower", "02-upper")
COLUMNS = ("vehicle_id", "frame", "time_s", "x_m", "y_m", "lane", "speed_mps", "accel_mps2")


@dataclass(frozen=True)
class Ego:
    """A vehicle that is instrumented, and the part of its drive, in ticks of the recording."""

    group: str
    dataset: str
    subset: str
    vehicle_id: int
    first_tick: int
    last_tick: int

    @property
    def name(self) -> str:
        """Name of the ego in the names of its drives."""
        return f"{self.subset}-{self.vehicle_id}"


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

    @property
    def others(self) -> dict[str, "Condition"]:
        """Conditions that lack one thing that this one has, by its name."""
        without = {"lidar": replace(self, lidar=False), "dgps": replace(self, receiver="plain")}
        return {name: other for name, other in without.items() if other != self}


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
    parser.add_argument("--due", type=int, default=6, help="egos around which a warning is due, at most")
    parser.add_argument("--epochs", type=int, default=6)
    options = parser.parse_args()
    began = time.monotonic()
    work = options.work
    train, evaluation = (make_lake(work, name, ("highd",), seed) for name, seed in (("train", 2), ("eval", 1)))
    lakes = {"highd": evaluation, "ngsim": make_lake(work, "congested", ("ngsim-text", "socrata"), 1)}
    models, learned = train_models(gather_truth(train, 6), options.epochs, work)
    print(f"{time.monotonic() - began:6.0f} s  models trained", flush=True)
    found = search_lakes(lakes, work / "due.parquet")
    egos = [*spread_egos(evaluation, options.egos), *choose_due(found, options.due)]
    print(f"{time.monotonic() - began:6.0f} s  {', '.join(ego.name for ego in egos)} chosen", flush=True)
    lake = make_drives(lakes, work / "drives", egos)
    print(f"{time.monotonic() - began:6.0f} s  {lake.table('drives').collect().height} drives fused", flush=True)
    about = {"training_samples": learned, "epochs": options.epochs}
    about |= {f"searched_{name}": found[name].sum() for name in ("pairs", "due_pairs", "overlapping_pairs")}
    with_due = found.filter(pl.col("moments") > 0)
    about |= {"searched_egos": found.height, "searched_egos_due": with_due.height}
    about |= {"searched_egos_turning": with_due.filter(pl.col("turn_deg") > MOST_TURN_DEG).height}
    rows = [{**row, **about} for row in score_egos(lake, egos, models)]
    pl.DataFrame(rows, infer_schema_length=None).write_csv(options.out, float_precision=4)
    write_page(options.out)
    print(f"{time.monotonic() - began:6.0f} s  {options.out} and the page beside it written")


def run(*words: object) -> None:
    """Run a command of tracklake; exit code 3 says that lines of the sample were refused, as they are meant to be."""
    command = [sys.executable, "-m", "tracklake.pipeline.cli.app", *map(str, words), "--quiet"]
    done = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False)
    if done.returncode not in (0, 3):
        raise SystemExit(f"tracklake {' '.join(map(str, words))}: exit code {done.returncode}")


def make_lake(work: Path, name: str, formats: tuple[str, ...], seed: int) -> Lake:
    """Generate a sample of overhead recordings and ingest it."""
    raw = work / f"{name}-raw"
    if not raw.exists():
        write_sample(raw, formats=formats, minutes=0.5, seed=seed)
    run("ingest", raw, "--lake", work / name)
    return open_lake(work / name)


def read_subset(lake: Lake, subset: str) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Read tracks and vehicles of a subset."""
    own = pl.col("subset") == subset
    tracks, vehicles = (lake.table(name).filter(own).collect() for name in ("tracks", "vehicles"))
    return tracks.select(COLUMNS), vehicles


def find_egos(tracks: pl.DataFrame) -> pl.DataFrame:
    """Find vehicles that were recorded long enough: `vehicle_id`, `first_tick`, `last_tick`."""
    return find_drives(tracks).filter(pl.col("last_tick") - pl.col("first_tick") >= LEAST_TICKS)


def choose_evenly(drives: pl.DataFrame, count: int) -> pl.DataFrame:
    """Choose vehicles evenly over their ids."""
    rows = np.linspace(0, drives.height - 1, min(count + 2, drives.height)).astype(int)[1:-1]
    chosen: pl.DataFrame = drives[rows.tolist()]
    return chosen


def spread_egos(lake: Lake, count: int) -> list[Ego]:
    """Choose so many egos of each subset, evenly over their ids."""
    return [
        Ego(SPREAD, "highd", subset, *row)
        for subset in SUBSETS
        for row in choose_evenly(find_egos(read_subset(lake, subset)[0]), count).iter_rows()
    ]


def observe(
    tracks: pl.DataFrame, vehicles: pl.DataFrame, facts: dict[str, str], egos: Sequence[int]
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return `surrounding_truth` and `drives` of egos of a subset, without instruments, with the egos' largest turn."""
    truths, drives = [], []
    for ego in egos:
        sensed = sense_drive(tracks, vehicles, facts, ego, InstrumentConfig(lidar=None, camera=None))
        length_m, width_m, _ = sensed.motion.size_m[sensed.motion.ego]
        name = f"{facts['subset']}-{ego}"
        yaw_rad = sensed.motion.yaw_rad[:, sensed.motion.ego]
        turn_deg = np.degrees(np.abs(yaw_rad[V2V.horizon_ticks :] - yaw_rad[: -V2V.horizon_ticks]).max())
        drives.append({"subset": name, "ego_length_m": length_m, "ego_width_m": width_m, "turn_deg": turn_deg})
        place = {"dataset": pl.lit("v2v"), "subset": pl.lit(name)}
        truths.append(sensed.truth.with_columns(**place, vehicle_id=pl.col("truth_id")))
    return pl.concat(truths), pl.DataFrame(drives)


def build_overhead(truth: pl.DataFrame, drives: pl.DataFrame) -> Samples:
    """Build the samples of true vehicles near their egos."""
    samples = build_samples(describe_truth(truth), truth, drives).samples
    return samples.select(is_near(samples))


def gather_truth(lake: Lake, count: int) -> Samples:
    """Build the overhead samples around many egos of each subset."""
    observed = []
    for subset in SUBSETS:
        tracks, vehicles = read_subset(lake, subset)
        egos = choose_evenly(find_egos(tracks), count)["vehicle_id"].to_list()
        observed.append(observe(tracks, vehicles, {"dataset": "highd", "subset": subset}, egos))
    truths, drives = zip(*observed, strict=True)
    return build_overhead(pl.concat(truths), pl.concat(drives))


def search_lakes(lakes: dict[str, Lake], kept: Path) -> pl.DataFrame:
    """Search all recordings for egos around which a warning is due; what was found before is read again."""
    if not kept.exists():
        found = []
        for dataset, lake in lakes.items():
            for subset in lake.table("subsets").select("subset").collect()["subset"].sort():
                tracks, vehicles = read_subset(lake, subset)
                found.append(search_subset(tracks, vehicles, {"dataset": dataset, "subset": subset}))
        pl.concat(found).write_parquet(kept)
    return pl.read_parquet(kept)


def search_subset(tracks: pl.DataFrame, vehicles: pl.DataFrame, facts: dict[str, str]) -> pl.DataFrame:
    """Count, for each ego, the vehicles near it, those with a warning due by the true futures, and their moments.

    Vehicles whose body overlaps the ego's are errors of the recording: they are counted, and no reason to choose it.
    `turn_deg` is how far the ego turns within the horizon at most.
    """
    drives = find_egos(tracks)
    truth, observed = observe(tracks, vehicles, facts, drives["vehicle_id"].to_list())
    samples = build_overhead(truth, observed)
    due = find_overlaps(samples, samples.place_m) > NEVER
    gap_m = np.abs(samples.place_m[..., 0]) - (samples.size_m[:, :1] + samples.ego_size_m[:, :1]) / 2
    touches = ((gap_m < 0) & (np.abs(samples.place_m[..., 1]) < NOMINAL_LANE_M / 2)).any(axis=1)
    ego = pl.Series("vehicle_id", samples.subset).str.split("-").list.last().cast(drives["vehicle_id"].dtype)
    moments = pl.DataFrame(
        [ego, *map(pl.Series, ("track", "tick", "due", "touches"), (samples.track, samples.tick, due, touches))]
    )
    dues = pl.col("tick").filter("due")
    pairs = moments.group_by("vehicle_id", "track").agg(
        dues.len().alias("moments"), dues.min().alias("first"), dues.max().alias("last"), pl.col("touches").any()
    )
    is_due, sound = pl.col("moments") > 0, (pl.col("moments") > 0) & ~pl.col("touches")
    counts = pairs.group_by("vehicle_id").agg(
        pl.len().alias("pairs"),
        is_due.sum().alias("due_pairs"),
        (is_due & pl.col("touches")).sum().alias("overlapping_pairs"),
        pl.col("moments").filter(sound).sum(),
        pl.col("first").filter(sound).min(),
        pl.col("last").filter(sound).max(),
    )
    about = (pl.lit(value).alias(name) for name, value in facts.items())
    turning = drives.with_columns(observed["turn_deg"]).join(counts, on="vehicle_id")
    return turning.sort("vehicle_id").select(*about, pl.all())


def choose_due(found: pl.DataFrame, count: int) -> list[Ego]:
    """Choose the egos with the most moments at which a warning is due, and the part of their drive around these.

    Egos that turn further than MOST_TURN_DEG are left out.
    """
    order = ("moments", "dataset", "subset", "vehicle_id")
    sound = found.filter(pl.col("moments") > 0, pl.col("turn_deg") <= MOST_TURN_DEG)
    most = sound.sort(order, descending=[True, False, False, False]).head(count)
    begin = pl.col("first_tick")
    part = (
        pl.max_horizontal(begin, begin + pl.col("first") - AROUND_TICKS),
        pl.min_horizontal("last_tick", begin + pl.col("last") + AROUND_TICKS).alias("end"),
    )
    return [Ego(DUE, *row) for row in most.select("dataset", "subset", "vehicle_id", *part).iter_rows()]


def is_near(samples: Samples) -> np.ndarray:
    """Find samples within NEAR_M along the road."""
    near: np.ndarray = np.abs(samples.feature[:, -1, FEATURE_NUMBER["rel_x_m"]]) <= NEAR_M
    return near


def train_models(samples: Samples, epochs: int, work: Path) -> tuple[list[Forecaster], int]:
    """Train every model once, on so many overhead samples alone; what was trained before is read again."""
    parts = split_samples(samples, seed=0)
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
    return models, len(parts.train)


def make_drives(lakes: dict[str, Lake], work: Path, egos: Sequence[Ego]) -> Lake:
    """Instrument the egos under every condition, and read and fuse their logs in a lake of their own."""
    for ego in egos:
        tracks, vehicles = read_subset(lakes[ego.dataset], ego.subset)
        tick = pl.col("time_s") * V2V.rate_hz
        is_other = pl.col("vehicle_id") != ego.vehicle_id
        tracks = tracks.filter(is_other | tick.is_between(ego.first_tick - 0.5, ego.last_tick + 0.5))
        for condition in CONDITIONS:
            out = work / "raw" / f"{ego.name}-{condition.name}"
            formats = ("hex", "rosbag2") if condition.lidar else ("hex",)
            if not out.exists():
                facts = {"dataset": ego.dataset, "subset": ego.subset}
                instrument_drive(tracks, vehicles, facts, ego.vehicle_id, condition.config, out, formats)
    run("ingest", work / "raw", "--lake", work / "lake")
    run("fuse", "--lake", work / "lake")
    return open_lake(work / "lake")


def read_feeds(lake: Lake, condition: Condition, egos: Sequence[Ego]) -> Feeds:
    """Pair both views of the egos' drives under a condition, near the ego alone."""
    own = pl.col("subset").is_in([f"{ego.name}-{condition.name}" for ego in egos])
    surrounding, truth, drives = (
        lake.table(name).filter(own).collect() for name in ("surrounding", "surrounding_truth", "drives")
    )
    feeds = pair_feeds(surrounding, truth, drives)
    near = select_feeds(feeds, is_near(feeds.overhead))
    return near._replace(ghosts=feeds.ghosts.select(is_near(feeds.ghosts)))


def score_egos(lake: Lake, egos: Sequence[Ego], models: list[Forecaster]) -> Iterator[dict[str, object]]:
    """Score all models on both views of each group of egos under each condition."""
    seen: dict[tuple[str, bytes], Singles] = {}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for group in (SPREAD, DUE):
            own = [ego for ego in egos if ego.group == group]
            judged: dict[Condition, Judged] = {}
            for condition in CONDITIONS:
                feeds = read_feeds(lake, condition, own)
                others = {name: judged[other] for name, other in condition.others.items()}
                judged[condition], rows = score_condition(feeds, models, seen, others)
                about = {"group": group, **describe_feeds(feeds, condition)}
                yield from ({**about, **row, "seconds": V2V.scored_s[-1]} for row in rows)
    finally:
        torch.set_num_threads(threads)


def describe_feeds(feeds: Feeds, condition: Condition) -> dict[str, object]:
    """State a condition, and how many samples and vehicles it is judged by."""
    overhead = feeds.overhead
    due = find_overlaps(overhead, overhead.place_m) > NEVER
    return {
        **{"penetration": condition.penetration, "lidar": condition.lidar, "receiver": condition.receiver},
        **{"egos": len(np.unique(overhead.subset)), "vehicles": len(np.unique(overhead.vehicle))},
        **{"samples": len(overhead), "warnings_due": int(due.sum())},
        **{"vehicles_due": len(np.unique(overhead.vehicle[due])), "n": len(feeds.perceived)},
    }


if __name__ == "__main__":
    main()
