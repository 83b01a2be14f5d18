"""Lakes, trainings and scores of the study: each is made once and found again by its own settings and inputs."""

import csv
import gzip
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Any

import polars as pl

from study.plan import EVAL_BLOCK, Arm, Learner, Source, estimate_run
from tracklake.pipeline.cli.lane_forest import FOLDER as FOREST_FOLDER
from tracklake.pipeline.cli.lane_forest import SCORES as FOREST_SCORES
from tracklake.pipeline.cli.train import read_model_settings
from tracklake.pipeline.lake import load
from tracklake.pipeline.lake.files import MODELS, TENSORS
from tracklake.schemas.files import write_file
from tracklake.schemas.tensors import INDEX_FILE, RECORDED_POSITIONS
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.models import find_model
from tracklake.training.runs.run_folder import digest_tensors

ROOT = Path(__file__).resolve().parents[2]
TRUTH = "truth.parquet"
NOTES, SCORES, VEHICLES = "jobs.csv", "scores.csv", "vehicles.parquet"
"""Files of the study's folder: what was run, and of each run its scores and its errors by vehicle."""
EVIDENCE = ("--calibration", "--feasibility")
"""Options of `tracklake evaluate` for what is looked at besides the errors."""
LATER = {"lateral_positions": RECORDED_POSITIONS}
"""What the index did not state of a recording at first, and what it was then: no run is made again because of it."""
DONE = (0, 3)
"""Exit codes of a command that did its work; 3: some files or lines were refused, as those of a sample are meant to."""

Call = Callable[[list[str], dict[str, str]], int]
"""Runs a command of tracklake, with variables of the environment; returns its exit code."""


@dataclass(frozen=True)
class Lake:
    """One fold of an arm: its folder, the digest of its tensors and their index."""

    arm: Arm
    fold: int | None
    root: Path
    digest: str = ""
    index: Mapping[str, Any] | None = None
    variant: str = ""

    @property
    def name(self) -> str:
        """Name of the lake: its arm, what is trained in it alone, and the block that is left out."""
        parts = (self.arm.name, self.variant, "" if self.fold is None else f"block {self.fold}")
        return ", ".join(part for part in parts if part)

    @property
    def environment(self) -> dict[str, str]:
        """Settings of the lake."""
        left_out = {} if self.fold is None else {EVAL_BLOCK: str(self.fold)}
        return {**self.arm.settings, **left_out}

    @property
    def truth(self) -> Path:
        """File of the truth of a generated sample."""
        return self.root.parents[1] / "sources" / make_digest(self.arm.source.sample) / TRUTH

    @property
    def options(self) -> tuple[str, ...]:
        """Options by which a command finds the lake."""
        return ("--lake", str(self.root), "--protocol", self.arm.protocol)


@dataclass(frozen=True)
class Job:
    """A model that is scored on a lake and, where it learns, was trained with a seed on this one or another."""

    lake: Lake
    model: str
    learner: Learner | None = None
    seed: int | None = None
    home: Lake | None = None

    @property
    def trained_in(self) -> Lake:
        """The lake that it is trained in."""
        return self.home or self.lake

    @property
    def training(self) -> str:
        """Digest of all that decides the weights: settings of the training, and tensors."""
        own = self.learner
        training = [own.model, own.samples, own.epochs, own.options, self.seed] if own else [self.model]
        return make_digest([self.trained_in.root.name, self.trained_in.digest, training])

    @property
    def identity(self) -> str:
        """Digest of all that decides the scores."""
        tested = list(self.learner.tested) if self.learner else []
        if self.home is None and not tested:
            return self.training
        return make_digest([self.training, self.lake.root.name, self.lake.digest, tested])

    @property
    def run(self) -> str:
        """Name of the run in its lake: that of its model, without what a run's name cannot hold."""
        name = re.sub(r"[^\w.-]+", "-", self.model)
        return f"{name}-seed{self.seed}-{self.training}" if self.learner else self.model

    @property
    def run_folder(self) -> Path:
        """Folder of the run in the lake that it is trained in."""
        return self.trained_in.root / MODELS / self.run

    @property
    def scores(self) -> Path:
        """Folder of its scores, which exists once they are complete."""
        return self.lake.root.parents[1] / "scores" / self.identity

    @property
    def evidence(self) -> Path | None:
        """Folder of its calibration and feasibility; None: of networks, the first seed's alone are looked at.

        They are of all vehicles, so that an arm of some has none.
        """
        asked = make_digest(EVIDENCE)[:4]
        return (
            None
            if self.seed or self.lake.arm.is_unseen
            else self.lake.root.parents[1] / "evidence" / f"{self.identity}-{asked}"
        )

    @property
    def is_current(self) -> bool:
        """Whether its run, if it learns, has the parameters and the recipe that its model has now."""
        return self.learner is None or read_settings(self.run_folder) == resolve_settings(self.learner)

    @property
    def is_scored(self) -> bool:
        """Whether it has its scores, and they are those of its model as it is now."""
        return self.scores.exists() and self.is_current

    @property
    def is_done(self) -> bool:
        """Whether it has its scores and all that is looked at besides."""
        return self.is_scored and (self.evidence is None or self.evidence.exists())

    def discard(self) -> None:
        """Remove scores, and what was looked at besides."""
        for folder in filter(None, (self.scores, self.evidence)):
            shutil.rmtree(folder, ignore_errors=True)

    @property
    def seconds(self) -> float:
        """Estimate of the time it takes."""
        return estimate_run(self.learner) if self.learner else 0.0


def resolve_settings(own: Learner) -> dict[str, Any]:
    """Resolve what a training is recorded with now: its parameters and its recipe, defaults of the registry included.

    They are not part of a job's digest, since defaults are not in the plan; a run with others is not done.
    """
    entry = find_model(own.model)
    given = [word for option, word in pairwise(own.options) if option == "--set"]
    settings = read_model_settings(entry, given)
    parameters = entry.complete(settings.pop("parameters", {}))
    recipe = asdict(replace(entry.recipe, **settings)) if entry.recipe else None
    return dict(json.loads(json.dumps({"parameters": parameters, "recipe": recipe})))


def read_settings(run: Path) -> dict[str, Any] | None:
    """Read the same of a run; None where there is no run."""
    file = run / "config.json"
    if not file.exists():
        return None
    config = json.loads(file.read_text(encoding="utf-8"))
    return {name: config.get(name) for name in ("parameters", "recipe")}


def make_digest(what: object) -> str:
    """Digest plain values."""
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]


def call_command(words: list[str], environment: dict[str, str]) -> int:
    """Run a command of tracklake on one thread, in a process of its own."""
    own = {**os.environ, **environment, "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-m", "tracklake.pipeline.cli.app", *words], env=own, check=False).returncode


class Workshop:
    """The study's folder, and how its commands are run; every command is noted in jobs.csv with commit and seconds."""

    def __init__(self, work: Path, data: Path, *, at_once: int = 2, call: Call = call_command) -> None:
        self.work, self.data, self.at_once, self.call, self.lock = work, data, at_once, call, Lock()
        self.failed: list[str] = []
        self.runs: dict[Path, Lock] = {}
        said = [
            subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()
            for words in (("rev-parse", "--short=12", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        ]
        self.commit = f"{said[0]}{'+changes' if said[1] else ''}"

    def run(self, *words: object, environment: Mapping[str, str] | None = None) -> bool:
        """Run a command and note it; a failure is kept in `failed`."""
        command = [*map(str, words), "--quiet"]
        began = time.monotonic()
        done = self.call(command, dict(environment or {})) in DONE
        shown, took = " ".join(["tracklake", *command[:-1]]), time.monotonic() - began
        self.work.mkdir(parents=True, exist_ok=True)
        with self.lock, (self.work / NOTES).open("a", encoding="utf-8", newline="") as file:
            csv.writer(file).writerow([f"{took:.1f}", self.commit, "done" if done else "failed", shown])
        print(f"{took:7.1f} s  {shown}{'' if done else '  FAILED'}", flush=True)
        if not done:
            self.failed.append(shown)
        return done

    def has(self, source: Source) -> bool:
        """Whether the recordings of a source are at hand, or are generated."""
        return not source.file or (self.data / source.file).is_file()

    def find_lakes(self, arm: Arm) -> list[Lake]:
        """Find the lakes that an arm is scored on, one per fold, without a digest where they are not made yet."""
        if not self.has(arm.source):
            return []
        raw = digest_file(self.data / arm.source.file) if arm.source.file else list(arm.source.sample)
        lakes = [Lake(arm, fold, Path()) for fold in arm.folds or (None,)]
        named = [(lake, make_digest([raw, arm.source.lane_ft, arm.protocol, lake.environment])) for lake in lakes]
        return [read_lake(replace(lake, root=self.work / "lakes" / digest)) for lake, digest in named]

    def find_homes(self, arm: Arm, own: Learner) -> list[Lake]:
        """Find the lakes that a model is trained in, one per fold or one for all; none: those that it is scored on."""
        if own.source is None and not own.settings:
            return []
        return [replace(lake, variant=own.name) for lake in self.find_lakes(arm.find_home(own))]

    def list_lakes(self, arm: Arm) -> dict[Path, Lake]:
        """List all lakes of an arm by their folders."""
        found = [*(self.find_homes(arm, own) for own in arm.learners), self.find_lakes(arm)]
        return {lake.root: lake for lakes in found for lake in lakes}

    def list_jobs(self, arm: Arm) -> Iterator[Job]:
        """List the jobs of an arm, as far as its tensors are there."""
        lakes = [lake for lake in self.find_lakes(arm) if lake.index is not None]
        yield from (Job(lake, model) for lake in lakes for model in arm.plain)
        for own in arm.learners:
            homes = {home.fold: home for home in self.find_homes(arm, own)}
            for lake in lakes:
                home = homes.get(lake.fold, homes.get(None))
                if home is None or home.index is not None:
                    where = (home, None) if home and own.at_home else (lake, home)
                    yield from (Job(where[0], own.name, own, seed, where[1]) for seed in range(own.seeds))

    def make_lake(self, lake: Lake) -> Lake:
        """Make a lake's tensors, or bring them up to date."""
        lake.root.parent.mkdir(parents=True, exist_ok=True)
        source = self.provide(lake.arm.source)
        if source and self.run("run", source, *lake.options, environment=lake.environment):
            return read_lake(lake)
        return lake

    def provide(self, source: Source) -> Path | None:
        """Return the raw file or the generated sample of a source; None where it could not be made."""
        if not source.file:
            out = self.work / "sources" / make_digest(source.sample)
            made = (out / TRUTH).exists() or self.run("sample", "--out", out, *source.sample)
            return out if made else None
        raw = self.data / source.file
        if not source.lane_ft:
            return raw
        out = self.work / "sources" / raw.name.removesuffix(".gz")
        content = fill_lanes(raw, source.lane_ft).write_csv().encode()
        if not out.exists() or out.read_bytes() != content:  # of other lanes, or of a run that was interrupted
            out.parent.mkdir(parents=True, exist_ok=True)
            write_file(out, content)
        return out

    def work_on(self, jobs: Iterable[Job]) -> None:
        """Train and score what is not done yet: the shortest first, and of these one seed in all folds."""
        jobs = list(jobs)
        outdated = {job.training for job in jobs if not job.is_current and job.run_folder.exists()}
        for job in jobs:
            if job.training in outdated:
                job.discard()
        left = sorted(
            (job for job in jobs if not job.is_done), key=lambda job: (job.seconds, job.seed or 0, job.lake.name)
        )
        with ThreadPoolExecutor(self.at_once) as pool:
            list(pool.map(self.finish, left))

    def finish(self, job: Job) -> None:
        """Train one run, or go on with one that was interrupted, and score it."""
        if job.learner and not self.train(job, job.learner):
            return
        if job.home is not None:
            lend_run(job)
        due = {job.scores: ("--out", SCORES, "--vehicle-errors", VEHICLES)}
        if job.evidence is not None:
            due[job.evidence] = (*EVIDENCE, "--evidence", "")
        self.evaluate(job, {out: options for out, options in due.items() if not out.exists()})

    def evaluate(self, job: Job, due: Mapping[Path, tuple[str, ...]]) -> None:
        """Evaluate a run into folders that exist once they are complete; options that are files are put into them."""
        words = ["evaluate", job.run, *job.lake.options, "--no-published", *(job.learner.tested if job.learner else ())]
        aside = {out: out.with_name(f"{out.name}.unfinished") for out in due}
        for out, options in due.items():
            shutil.rmtree(aside[out], ignore_errors=True)
            aside[out].mkdir(parents=True)
            words += [word if word.startswith("--") else str(aside[out] / word) for word in options]
        if due and self.run(*words, environment=job.lake.environment):
            for out, unfinished in aside.items():
                unfinished.rename(out)

    def score_forest(self, lake: Lake, *, only_gather: bool) -> Path | None:
        """Fit and score the forests of a lake, unless that is done; returns their scores, None where there are none."""
        digest = make_digest([lake.root.name, lake.digest, lake.arm.forest])
        file = self.work / "scores" / f"forest-{digest}.json"
        words = ("lane-forest", "constant-velocity", *lake.options, *lake.arm.forest)
        is_due = lake.index is not None and not file.exists() and not only_gather
        if is_due and self.run(*words, environment=lake.environment):
            file.parent.mkdir(parents=True, exist_ok=True)
            write_file(file, (lake.root / MODELS / FOREST_FOLDER / FOREST_SCORES).read_bytes())
        return file if file.exists() else None

    def train(self, job: Job, own: Learner) -> bool:
        """Train a run if there is none yet; returns whether there is one. Of jobs that share a run, the others wait."""
        with self.lock:
            being_trained = self.runs.setdefault(job.run_folder, Lock())
        with being_trained:
            return job.is_current or self.train_alone(job, own)

    def train_alone(self, job: Job, own: Learner) -> bool:
        """Train a run, or go on with it."""
        begun = (job.run_folder.with_name(f".{job.run}.unfinished") / "checkpoint.pt").exists()
        how = ("--seed", job.seed, "--samples-per-epoch", own.samples, "--epochs", own.epochs, *own.options)
        words = ("train", own.model, *job.trained_in.options, "--name", job.run, *how, "--threads", 1)
        again = ("--anew",) if job.run_folder.exists() else ("--resume",) if begun else ()
        return self.run(*words, *again, environment=job.trained_in.environment)


def lend_run(job: Job) -> None:
    """Copy a run into the lake that it is scored on.

    Recordings of two samples have the same names. So that a run is not refused as one that was trained on what it is
    scored on, its copy states the blocks of that lake: samples of other traffic, or clean copies of blocks of its own
    evaluation part, are scored. It states that lake's protocol, too, which may take other tracks, recorded ones.
    """
    copy = job.lake.root / MODELS / job.run
    if read_settings(copy) != read_settings(job.run_folder):
        shutil.rmtree(copy, ignore_errors=True)
        aside = copy.with_name(f".{copy.name}.copy")
        shutil.rmtree(aside, ignore_errors=True)
        shutil.copytree(job.run_folder, aside)
        config = json.loads((aside / "config.json").read_text(encoding="utf-8"))
        config |= {name: (job.lake.index or {})[name] for name in ("blocks", "protocol")}
        (aside / "config.json").write_text(json.dumps(config), encoding="utf-8")
        aside.rename(copy)


def read_lake(lake: Lake) -> Lake:
    """Add digest and index of a lake's tensors, where it has some."""
    commit = load(lake.root).commits.get(TENSORS) if lake.root.exists() else None
    if commit is None or commit.info["path"] is None:
        return lake
    folder = TensorFolder.open(lake.root / commit.info["path"])
    index = json.loads((folder.path / INDEX_FILE).read_text(encoding="utf-8"))
    plain = [{key: own[key] for key in own if (key, own[key]) not in LATER.items()} for own in index["subsets"]]
    return replace(lake, digest=digest_tensors(replace(folder, index={**index, "subsets": plain})), index=index)


@cache
def digest_file(file: Path) -> str:
    """Digest the content of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()[:12]


def fill_lanes(raw: Path, lane_ft: float, lanes: int = 6) -> pl.DataFrame:
    """Read a file of NGSIM as text and add the lane, counted from the left edge; nothing else of it is changed."""
    lane = (pl.col("Local_X").cast(pl.Float64) / lane_ft).floor().clip(0, lanes - 1) + 1
    content = gzip.decompress(raw.read_bytes()) if raw.suffix == ".gz" else raw.read_bytes()
    return pl.read_csv(content, infer_schema=False).with_columns(Lane_ID=lane.cast(pl.Int64))
