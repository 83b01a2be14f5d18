"""The study: every model under every protocol, several seeds, and what came of it as `docs/results.md`.

Runs the commands a user would run (`sample`, `run`, `train`, `evaluate`, `lane-forest`), two trainings at a time, each
on one thread. Whatever is finished in the study's folder is kept, so that an interrupted study goes on where it was;
another commit or other options begin in another folder.

    python benchmarks/study.py                     what docs/results.md shows
    python benchmarks/study.py --minutes 0.3 --samples-per-epoch 2000 --seeds 1 --out /tmp/results.md      to try it
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import polars as pl
from study_forest import FOREST_SCORES
from study_page import EVALUATIONS, Study, write_page
from study_plan import ARMS, Arm, Learner

LANE_FT = 12.0
US101_LANES = 6
"""Five main lanes and the auxiliary one between the ramps."""
ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Run the arms one after the other and write the page."""
    options = read_options()
    began = time.monotonic()
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
    sample = work / "sample"
    if not (sample / "truth.parquet").exists():
        run("sample", "--out", sample, "--minutes", options.minutes, "--seed", options.sample_seed)
    for arm in arms:
        work_on(arm, work, sample if arm.source == "sample" else give_lane(options.us101, work), options)
    seconds = work / "seconds.json"
    spent = json.loads(seconds.read_text(encoding="utf-8")) if seconds.exists() else 0.0
    spent += time.monotonic() - began
    seconds.write_text(json.dumps(spent), encoding="utf-8")
    write_page(
        options.out,
        Study(
            arms=arms, work=work, digest=digest, plan=plan, commit=name_commit(), seconds=spent, command=name_command()
        ),
    )
    print(f"{options.out} written; {spent / 60:.0f} min of work in {work}")


def work_on(arm: Arm, work: Path, source: Path, options: argparse.Namespace) -> None:
    """One arm: its lake, its trainings, its evaluation."""
    lake = work / arm.name
    common = ("--lake", lake, "--protocol", arm.protocol)
    run("run", source, *common, environment=arm.environment)
    jobs = [(learner, seed) for learner in arm.learners for seed in range(options.seeds)]
    # The longest first: the last of two at a time then waits least.
    jobs.sort(key=lambda job: -job[0].share)
    with ThreadPoolExecutor(options.at_once) as pool:
        list(pool.map(lambda job: learn(arm, *job, lake, options), jobs))
    if arm.forest:
        for seed in range(options.seeds):
            learn_forest(arm, seed, lake)
    runs = [f"{learner.name}-seed{seed}" for learner, seed in jobs]
    out = ("--every-tick", "--out", lake / EVALUATIONS)
    run("evaluate", *arm.plain, *runs, *out, *common, environment=arm.environment)


def give_lane(excerpt: Path, work: Path) -> Path:
    """The excerpt of US-101 with the one column that samples need and it lacks: lanes, of 12 ft from the left edge."""
    out = work / "us-101-source" / "us101_with_lanes.csv"
    if not out.exists():
        out.parent.mkdir(exist_ok=True)
        lane = (pl.col("Local_X").cast(pl.Float64) / LANE_FT).floor().clip(0, US101_LANES - 1) + 1
        # As text: nothing of the file but this column is changed.
        pl.read_csv(excerpt, infer_schema=False).with_columns(Lane_ID=lane.cast(pl.Int64)).write_csv(out)
    return out


def learn(arm: Arm, learner: Learner, seed: int, lake: Path, options: argparse.Namespace) -> None:
    """One training, unless it is finished; one that was interrupted goes on."""
    name = f"{learner.name}-seed{seed}"
    if (lake / "models" / name / "metrics.json").exists():
        return
    settings = [part for setting in learner.settings for part in ("--set", setting)]
    samples = max(1, round(options.samples_per_epoch * learner.share))
    where = ("--lake", lake, "--protocol", arm.protocol, "--name", name)
    how = ("--seed", seed, "--samples-per-epoch", samples, "--threads", 1)
    begun = (lake / "models" / f".{name}.unfinished" / "checkpoint.pt").exists()
    run("train", learner.model, *where, *how, *settings, *(["--resume"] if begun else []), environment=arm.environment)


def learn_forest(arm: Arm, seed: int, lake: Path) -> None:
    """One forest and the cells of all runs; every seed's scores are kept beside each other."""
    curve = ["--learning-curve"] if seed == 0 else []
    where = ("--lake", lake, "--protocol", arm.protocol)
    run("lane-forest", "--seed", seed, *curve, *where, environment=arm.environment)
    scores = (lake / "models" / "lane-forest" / "lane_forest.json").read_text(encoding="utf-8")
    (lake / FOREST_SCORES.format(seed=seed)).write_text(scores, encoding="utf-8")


def run(*words: object, environment: dict[str, str] | None = None) -> None:
    """One command of tracklake's, printed before and its time after; a failure ends the study."""
    command = [str(Path(sys.executable).parent / "tracklake"), *(str(word) for word in words), "--quiet"]
    shown = " ".join(["tracklake", *command[1:-1]])
    began = time.monotonic()
    own = {**os.environ, **(environment or {}), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=own, cwd=ROOT, check=False)
    # 3: done, but some of the sample's recordings or lines were refused, as they are meant to be.
    if done.returncode not in (0, 3):
        raise SystemExit(f"{shown}: exit code {done.returncode}")
    print(f"{time.monotonic() - began:7.1f} s  {shown}", flush=True)


def name_commit() -> str:
    """The commit that the study ran on, marked where files differ from it."""
    return ask("git", "rev-parse", "--short=12", "HEAD") + ("+changes" if ask("git", "status", "--porcelain") else "")


def ask(*command: str) -> str:
    """What a command prints."""
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.strip()


def name_command() -> str:
    """How the study was started, without the folders it was given."""
    return " ".join(["make study", *shorten(sys.argv[1:])])


def shorten(words: Sequence[str]) -> list[str]:
    """Options as given; paths become their last part."""
    return [f'ARGS="{" ".join(Path(word).name if os.sep in word else word for word in words)}"'] if words else []


def read_options() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results.md", help="the page")
    parser.add_argument("--work", type=Path, default=ROOT / "study", help="folder of samples, lakes and runs")
    parser.add_argument("--minutes", type=float, default=5.0, help="of the generated recordings")
    parser.add_argument("--sample-seed", type=int, default=0, help="of the generated recordings")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each model")
    parser.add_argument("--samples-per-epoch", type=int, default=200_000, help="at most; slow models take a share")
    parser.add_argument("--at-once", type=int, default=2, help="trainings at a time, a thread each")
    parser.add_argument("--us101", type=Path, help="the public excerpt of US-101 (one lane, 290 vehicles)")
    options = parser.parse_args()
    for name in ("out", "work", "us101"):
        path = getattr(options, name)
        setattr(options, name, path and path.resolve())
    return options


if __name__ == "__main__":
    main()
