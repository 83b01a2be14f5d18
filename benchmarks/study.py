"""The study: the models of the registry under the protocols they were published for, and what came of it.

Runs the commands a user would run (`sample`, `run`, `train`, `evaluate`, `lane-forest`), two trainings at a time, each
on one thread, and writes `docs/results.md`. Whatever is finished in the study's folder is kept, so that an interrupted
study goes on where it was; other options begin in another folder. Every command is noted in `jobs.csv` there, with the
commit that it ran at and how long it took.

    python benchmarks/study.py                     what docs/results.md shows
    python benchmarks/study.py --minutes 0.3 --samples-per-epoch 600 --seeds 1 --out /tmp/results.md      to try it
"""

import argparse
import csv
import hashlib
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from threading import Lock

import polars as pl
from study_forest import FOREST_SCORES
from study_page import EVALUATIONS, JOBS, NEAREST, SCENES, Study, write_page
from study_plan import ARMS, Arm, Learner

ROOT = Path(__file__).resolve().parent.parent
EXCERPT = ROOT.parent / "shared" / "data" / "ngsim" / "us101_0750_290_vehicles.csv.gz"
LANE_FT = 12.0
US101_LANES = 6
"""Five main lanes and the auxiliary one between the ramps."""


def main() -> None:
    """Run the arms one after the other and write the page."""
    options = read_options()
    arms = [arm for arm in ARMS if arm.source == "sample" or options.us101]
    plan = {
        "minutes": options.minutes,
        "sample_seed": options.sample_seed,
        "samples_per_epoch": options.samples_per_epoch,
        "seeds": options.seeds,
        "arms": [asdict(arm) for arm in arms],
    }
    digest = hashlib.sha256(json.dumps(plan, sort_keys=True).encode()).hexdigest()[:12]
    work = options.work / digest
    work.mkdir(parents=True, exist_ok=True)
    (work / "plan.json").write_text(json.dumps(plan, indent=1), encoding="utf-8")
    runner = Runner(work / JOBS)
    sample = work / "sample"
    if not (sample / "truth.parquet").exists():
        runner.run("sample", "--out", sample, "--minutes", options.minutes, "--seed", options.sample_seed)
    for arm in arms:
        source = sample if arm.source == "sample" else give_lane(options.us101, work)
        work_on(arm, work / arm.name, source, options, runner)
    write_page(options.out, Study(arms=arms, work=work, digest=digest, plan=plan))
    print(f"{options.out} written from {work}")


class Runner:
    """Runs commands of tracklake's and notes them: seconds, commit, command."""

    def __init__(self, jobs: Path) -> None:
        self.jobs, self.lock = jobs, Lock()
        differs = bool(ask("git", "status", "--porcelain", "--untracked-files=no"))
        self.commit = ask("git", "rev-parse", "--short=12", "HEAD") + ("+changes" if differs else "")

    def run(self, *words: object, environment: dict[str, str] | None = None) -> None:
        """One command; a failure ends the study."""
        command = [str(Path(sys.executable).parent / "tracklake"), *(str(word) for word in words), "--quiet"]
        shown = " ".join(["tracklake", *command[1:-1]])
        began = time.monotonic()
        own = {**os.environ, **(environment or {}), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=own, cwd=ROOT, check=False)
        # 3: done, but some of the sample's recordings or lines were refused, as they are meant to be.
        if done.returncode not in (0, 3):
            raise SystemExit(f"{shown}: exit code {done.returncode}")
        took = time.monotonic() - began
        with self.lock, self.jobs.open("a", encoding="utf-8", newline="") as file:
            csv.writer(file).writerow([f"{took:.1f}", self.commit, shown])
        print(f"{took:7.1f} s  {shown}", flush=True)


def work_on(arm: Arm, lake: Path, source: Path, options: argparse.Namespace, runner: Runner) -> None:
    """One arm: its lake, its trainings, its evaluation."""
    jobs = [(learner, seed) for learner in arm.learners for seed in range(options.seeds)]
    left = [job for job in jobs if not (lake / "models" / name_run(*job) / "metrics.json").exists()]
    common = ("--lake", lake, "--protocol", arm.protocol)
    if left:
        runner.run("run", source, *common, environment=arm.environment)
    # The slowest networks, which are those that take a share, first: the last of two at a time then waits least.
    left.sort(key=lambda job: job[0].share)
    with ThreadPoolExecutor(options.at_once) as pool:
        list(pool.map(lambda job: learn(arm, *job, lake, options, runner), left))
    if arm.forest:
        for seed in range(options.seeds):
            learn_forest(arm, seed, lake, runner)
    runs = [name_run(*job) for job in jobs]
    if not (lake / EVALUATIONS).exists():
        runner.run(
            "evaluate",
            *arm.plain,
            *runs,
            "--every-tick",
            *("--out", lake / EVALUATIONS),
            *common,
            environment=arm.environment,
        )
    scenes = [name_run(learner, seed) for learner, seed in jobs if learner.model in arm.scenes]
    for nearest in NEAREST if scenes else ():
        out = lake / SCENES.format(nearest=nearest)
        if not out.exists():
            shown = ("--nearest", nearest, "--no-published", "--out", out)
            runner.run("evaluate", *scenes, *shown, *common, environment=arm.environment)


def name_run(learner: Learner, seed: int) -> str:
    """What a run is called in its lake."""
    return f"{learner.name}-seed{seed}"


def give_lane(excerpt: Path, work: Path) -> Path:
    """The excerpt of US-101 with the one column that samples need and it lacks: lanes, of 12 ft from the left edge."""
    out = work / "us-101-source" / "us101_with_lanes.csv"
    if not out.exists():
        out.parent.mkdir(exist_ok=True)
        lane = (pl.col("Local_X").cast(pl.Float64) / LANE_FT).floor().clip(0, US101_LANES - 1) + 1
        # As text: nothing of the file but this column is changed.
        pl.read_csv(excerpt, infer_schema=False).with_columns(Lane_ID=lane.cast(pl.Int64)).write_csv(out)
    return out


def learn(arm: Arm, learner: Learner, seed: int, lake: Path, options: argparse.Namespace, runner: Runner) -> None:
    """One training; one that was interrupted goes on."""
    name = name_run(learner, seed)
    settings = [part for setting in learner.settings for part in ("--set", setting)]
    samples = max(1, round(options.samples_per_epoch * learner.share))
    where = ("--lake", lake, "--protocol", arm.protocol, "--name", name)
    epochs = ("--epochs", arm.epochs) if arm.epochs else ()
    how = ("--seed", seed, "--samples-per-epoch", samples, *epochs, "--threads", 1, *settings)
    begun = (lake / "models" / f".{name}.unfinished" / "checkpoint.pt").exists()
    runner.run("train", learner.model, *where, *how, *(["--resume"] if begun else []), environment=arm.environment)


def learn_forest(arm: Arm, seed: int, lake: Path, runner: Runner) -> None:
    """One forest and the cells of all runs; every seed's scores are kept beside each other."""
    kept = lake / FOREST_SCORES.format(seed=seed)
    if kept.exists():
        return
    curve = ["--learning-curve"] if seed == 0 else []
    where = ("--lake", lake, "--protocol", arm.protocol)
    runs = [name_run(learner, seed) for learner in arm.learners]  # whose columns are also that forest's
    runner.run("lane-forest", *runs, "--seed", seed, *curve, *where, environment=arm.environment)
    scores = lake / "models" / "lane-forest" / "lane_forest.json"
    kept.write_text(scores.read_text(encoding="utf-8"), encoding="utf-8")


def ask(*command: str) -> str:
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.strip()


def read_options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results.md", help="the page")
    parser.add_argument("--work", type=Path, default=ROOT / "study", help="folder of samples, lakes and runs")
    parser.add_argument("--minutes", type=float, default=4.0, help="of the generated recordings")
    parser.add_argument("--sample-seed", type=int, default=0, help="of the generated recordings")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each model")
    parser.add_argument("--samples-per-epoch", type=int, default=50_000, help="at most; slow models take a share")
    parser.add_argument("--at-once", type=int, default=2, help="trainings at a time, a thread each")
    parser.add_argument("--us101", type=Path, default=EXCERPT, help="the public excerpt of US-101 (290 vehicles)")
    parser.add_argument("--without-us101", action="store_true", help="leave its part out")
    options = parser.parse_args()
    for name in ("out", "work", "us101"):
        setattr(options, name, getattr(options, name).resolve())
    if options.without_us101:
        options.us101 = None
    elif not options.us101.is_file():
        parser.error(f"{options.us101}: no such file; give the excerpt by --us101, or leave it out by --without-us101")
    return options


if __name__ == "__main__":
    main()
