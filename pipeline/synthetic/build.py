"""Steps of making a sample: simulate, add noise, inject defects, write files, read them back, list the truth."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic import damaged_lines as damage
from tracklake.pipeline.synthetic import defects, drives, highd, ngsim, true_tracks, truth
from tracklake.pipeline.synthetic.drivers import UNIFORM
from tracklake.pipeline.synthetic.noise import DRONE, MAST, add_noise
from tracklake.pipeline.synthetic.plain_formats import PLAIN, list_first_frames, write_format
from tracklake.pipeline.synthetic.scenarios import (
    DRIVES,
    HIGHD,
    Dose,
    HighdScenario,
    Job,
    NgsimScenario,
    plan_dose,
)
from tracklake.pipeline.synthetic.simulation import NGSIM_FILES, find_driven, list_jobs, list_pair, simulate_all
from tracklake.pipeline.synthetic.sumo import find_sumo

BOM = b"\xef\xbb\xbf"
TRUTH_FILE, TRUE_TRACKS_FILE = "truth.parquet", "true_tracks.parquet"
README_FILE = "README.md"
README = """# A generated sample

These files have raw formats of publishers, but were not recorded: SUMO simulated the traffic, and tracking
noise and known defects were added. `tracklake sample` wrote them (seed {seed}, {minutes:g} minutes, {noise}).

- `NN_recordingMeta.csv`, `NN_tracksMeta.csv`, `NN_tracks.csv`: highD's format. `dhw` is bumper to bumper; the metadata
  describe the rows in the files.
- `trajectories-*`, `*-export.csv`: NGSIM's formats, at times of the day that were never recorded.
- `exid/`, `ind/`, `round/`, if asked for: formats of exiD (with a map of location 0), inD and rounD, without defects.
- files of TGSIM and I-24 MOTION, if asked for, without defects.
- `drive-1`, `drive-2`: what two cars of recording 02 would have logged as instrumented vehicles, each with `truth.csv`.
- `truth.parquet`: every injected defect, every vehicle's true first frame, and what each rule has to find.
- `true_tracks.parquet`: where every vehicle truly was, without noise and defects, in the frame of the lake's `tracks`.
"""


def build_sample(
    folder: Path,
    formats: tuple[str, ...],
    minutes: float,
    seed: int,
    noise: tuple[str, ...],
    traffic: str,
    dose: Dose | None,
    progress: Callable[[str], None],
) -> tuple[int, int, float | None]:
    """Write a whole sample into an empty folder; the arguments are those of `write_sample`.

    Returns the number of data lines in files of tracks, and of recordings, and the share of vehicles with the defect.
    """
    home = find_sumo()
    recordings: tuple[HighdScenario, ...] = HIGHD if "highd" in formats else ()
    groups = [own for own in NGSIM_FILES if own[0] in formats]
    driven = DRIVES in formats
    plain = {name: PLAIN[name].list_jobs(minutes) for name in formats if name in PLAIN}
    listed = list_jobs(recordings if not driven or recordings else find_driven(), groups, minutes)
    listed += [job for own in plain.values() for job in own]
    jobs = [replace(job, traffic=replace(job.traffic, drivers=traffic)) for job in listed]
    progress(f"simulating {len(jobs)} carriageways")
    clean = simulate_all(home, jobs, seed, progress)
    if dose is not None:
        recordings = tuple(replace(scenario, damaged=False) for scenario in recordings)
        plans = (plan_dose(dose, clean[job.subset]["vehicle"].n_unique()) for job in jobs)
        jobs = [replace(job, traffic=replace(job.traffic, plan=plan)) for job, plan in zip(jobs, plans, strict=True)]
    sample = _Sample(folder, seed, noise, jobs, clean)
    for scenario in recordings:
        progress(f"writing highD recording {scenario.recording}")
        sample.add_highd(scenario)
    for kind, file, scenarios in groups:
        progress(f"writing {file}")
        sample.add_ngsim(kind, file, scenarios, damaged=dose is None)
    for name, own in plain.items():
        progress(f"writing {name}")
        counts, firsts = write_format(folder, name, own, clean, seed, noise)
        sample.found.files += counts
        sample.rows += firsts
    for drive in drives.SCENARIOS if driven else ():
        progress(f"writing {drive.folder}")
        sample.add_drive(drive)
    progress("writing the truth")
    rows = sample.rows + ([] if dose is None else _measure_dose(dose, jobs, sample.rows))
    # What each rule has to find is counted where today's tests compare it; the loops take as long as all the rest.
    sample.write_truth(rows, with_rules=traffic == UNIFORM and dose is None)
    named = " and ".join(noise) or "no"
    named += " noise" if traffic == UNIFORM else f" noise, {traffic} traffic"
    named += "" if dose is None else f", of the defects only {dose.defect}, of {dose.share:g} of the vehicles"
    text = README.format(seed=seed, minutes=minutes, noise=named)
    (folder / README_FILE).write_text(text, encoding="utf-8")
    lines = sum(count.read for count in sample.found.files if not count.file.endswith("Meta.csv"))
    count = len(recordings) + sum(len(scenarios) for _, _, scenarios in groups)
    count += len({job.recording for own in plain.values() for job in own})
    return lines, count + driven * len(drives.SCENARIOS), _find_share(rows) if dose is not None else None


@dataclass
class _Sample:
    """A sample as far as it is written: rows of its truth, its true tracks, and the contents read back."""

    folder: Path
    seed: int
    noise: tuple[str, ...]
    jobs: list[Job]
    clean: dict[str, pl.DataFrame]
    rows: list[dict[str, object]] = field(default_factory=list)
    true: list[pl.DataFrame] = field(default_factory=list)
    found: truth.Found = field(default_factory=truth.Found)

    def add_highd(self, scenario: HighdScenario) -> None:
        """Write a recording in highD's format."""
        pair = list_pair(self.jobs, scenario.recording)
        tracks = _number_vehicles(pair, self.clean)
        self.rows += _write_highd(self.folder, scenario, pair, tracks, self.seed, self.noise)
        truth.read_highd(self.folder, scenario.recording, self.found)
        self.true += [_find_true_tracks(job, tracks[job.subset], self.found) for job in pair]

    def add_ngsim(self, kind: str, file: str, scenarios: tuple[NgsimScenario, ...], *, damaged: bool) -> None:
        """Write an NGSIM file; `damaged` also inserts duplicates and malformed lines."""
        jobs = [job for job in self.jobs if job.file == file]
        tracks = _shift_vehicles(scenarios, jobs, self.clean)
        written = (self.folder, kind, file, scenarios, jobs, tracks, self.seed, self.noise)
        self.rows += _write_ngsim(*written, damaged=damaged)
        self.true += [_find_true_tracks(job, tracks[job.subset], self.found) for job in jobs]
        names = {ngsim.compute_time_key(each.start_time): ngsim.name_recording(each.start_time) for each in scenarios}
        truth.read_ngsim(self.folder / file, names, self.found)

    def add_drive(self, drive: drives.DriveScenario) -> None:
        """Write the drive of an instrumented vehicle."""
        pair = list_pair(self.jobs, drives.RECORDING)
        tracks = _number_vehicles(pair, self.clean)[drive.subset]
        self.rows += drives.write_drive(self.folder, drive, tracks, pair[0].road.rate_hz, self.seed)

    def write_truth(self, rows: list[dict[str, object]], *, with_rules: bool) -> None:
        """Write the truth and the true tracks; `with_rules` also counts what each rule has to find."""
        counted = self.found if with_rules else replace(self.found, entries={})
        truth.build_truth(rows + truth.list_counts(counted)).write_parquet(self.folder / TRUTH_FILE)
        pl.concat([pl.DataFrame(schema=true_tracks.TRUE_TRACKS_SCHEMA), *self.true]).sort(
            "dataset", "subset", "vehicle_id", "frame"
        ).write_parquet(self.folder / TRUE_TRACKS_FILE)


def _measure_dose(dose: Dose, jobs: list[Job], rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Measure the dose reached in each subset, by the rows of truth about its vehicles and defects."""
    table = truth.build_truth(rows)
    measured = []
    for job in jobs:
        own = table.filter(subset=job.subset)
        vehicles, damaged = own.filter(kind="first_frame"), own.filter(kind="defect", name=dose.defect)
        if vehicles.is_empty():  # simulated for drives alone
            continue
        reached = damaged["vehicle_id"].n_unique()
        measured.append(
            {
                "kind": "dose", "dataset": job.dataset, "recording": job.recording, "subset": job.subset,
                "file": job.file, "name": dose.defect, "entries": int(damaged["entries"].sum()), "vehicles": reached,
                "value": reached / vehicles.height,
            }
        )  # fmt: skip
    return measured


def _find_share(rows: list[dict[str, object]]) -> float:
    """Find the share of all vehicles that have the defect."""
    table = truth.build_truth(rows)
    return float(table.filter(kind="dose")["vehicles"].sum() / max(1, table.filter(kind="first_frame").height))


def _damage_tracks(
    tracks: pl.DataFrame, job: Job, seed: int, noise: tuple[str, ...], next_vehicle: int | None = None
) -> tuple[pl.DataFrame, list[dict[str, object]]]:
    """Add noise and defects; also return the truth about them. `next_vehicle` is the first unused id."""
    random = np.random.default_rng([seed, job.index, 1])
    is_ngsim = job.dataset == "ngsim"
    noisy = add_noise(tracks, job.road, MAST if is_ngsim else DRONE, noise, random)
    injected = defects.inject_defects(
        noisy,
        job.traffic.plan,
        rate_hz=job.road.rate_hz,
        on_ramp_lane=job.road.lanes + 2 if job.road.ramp else None,
        unseen_leaders=is_ngsim and job.traffic.plan.lost_leader,
        random=random,
        next_vehicle=next_vehicle,
    )
    declared: list[dict[str, object]] = [
        {
            "kind": "defect", "dataset": job.dataset, "recording": job.recording, "subset": job.subset,
            "file": job.file, "vehicle_id": each.vehicle, "name": each.name, "first_frame": each.first_frame,
            "last_frame": each.last_frame, "entries": each.entries, "value": each.value,
        }
        for each in injected.defects
    ]  # fmt: skip
    return injected.tracks, list_first_frames(tracks, job) + _list_lane_changes(tracks, job) + declared


def _list_lane_changes(tracks: pl.DataFrame, job: Job) -> list[dict[str, object]]:
    changes = tracks.drop_nulls("change_begin").select("vehicle", "change_begin", "change_end", "change_side").unique()
    return [
        {
            "kind": "lane_change", "dataset": job.dataset, "recording": job.recording, "subset": job.subset,
            "file": job.file, "vehicle_id": vehicle, "name": "left" if side < 0 else "right",
            "first_frame": math.ceil(begin), "last_frame": math.floor(end), "value": (end - begin) / job.road.rate_hz,
        }
        for vehicle, begin, end, side in changes.sort("vehicle", "change_begin").iter_rows()
    ]  # fmt: skip


def _list_line_defects(
    found: list[damage.LineDefect], dataset: str, recording: str | None, file: str
) -> list[dict[str, object]]:
    return [
        {
            "kind": "defect", "dataset": dataset, "recording": recording, "file": file, "line": each.line,
            "name": each.name, "entries": 1,
        }
        for each in found
    ]  # fmt: skip


def _number_vehicles(pair: list[Job], clean: dict[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """Return tracks by subset under the ids of highD's files, which count over both carriageways by first frame."""
    both = [clean[job.subset].with_columns(side=pl.lit(i)) for i, job in enumerate(pair)]
    numbered = (
        pl.concat(both)
        .group_by("side", "vehicle")
        .agg(pl.col("frame").min())
        .sort("frame", "side", "vehicle")
        .with_columns(number=pl.int_range(1, pl.len() + 1, dtype=pl.Int32))
    )
    return {
        job.subset: clean[job.subset]
        .join(numbered.filter(pl.col("side") == side).select("vehicle", "number"), on="vehicle", maintain_order="left")
        .with_columns(vehicle=pl.col("number"))
        .drop("number")
        .sort("vehicle", "frame")
        for side, job in enumerate(pair)
    }


def _shift_vehicles(
    scenarios: tuple[NgsimScenario, ...], jobs: list[Job], clean: dict[str, pl.DataFrame]
) -> dict[str, pl.DataFrame]:
    """Return tracks by subset under the ids of an NGSIM file."""
    return {
        job.subset: clean[job.subset].with_columns(pl.col("vehicle") + pl.lit(scenario.first_vehicle_id - 1, pl.Int32))
        for scenario, job in zip(scenarios, jobs, strict=True)
    }


def _find_true_tracks(job: Job, tracks: pl.DataFrame, found: truth.Found) -> pl.DataFrame:
    """Find a subset's true tracks by its simulated ones under the file's ids, and by its file, read back."""
    # On the upper carriageway x_m counts from the hindmost recorded position.
    counted = job.subset.endswith("-upper")
    start_m = job.road.window_m + found.hindmost[job.recording] if counted else 0.0
    rows = true_tracks.build_true_tracks(tracks, job.road.rate_hz, start_m=start_m, pointed=job.dataset == "highd")
    place = {"dataset": job.dataset, "recording": job.recording, "subset": job.subset}
    return rows.with_columns(pl.lit(value).alias(name) for name, value in place.items()).select(
        pl.col(name).cast(dtype) for name, dtype in true_tracks.TRUE_TRACKS_SCHEMA.items()
    )


def _write_highd(
    folder: Path,
    scenario: HighdScenario,
    pair: list[Job],
    tracks: dict[str, pl.DataFrame],
    seed: int,
    noise: tuple[str, ...],
) -> list[dict[str, object]]:
    both_damaged, rows = [], []
    unused = sum(each["vehicle"].n_unique() for each in tracks.values()) + 1
    for job in pair:
        damaged, declared = _damage_tracks(tracks[job.subset], job, seed, noise, unused)
        unused += job.traffic.plan.second_tracks
        both_damaged.append(damaged)
        rows += declared
    files = highd.build_recording(scenario, *both_damaged, frames=pair[0].frames)
    if scenario.damaged:
        random = np.random.default_rng([seed, pair[0].index, 2])
        dialect = damage.Dialect(header=True, separator=",", number_field=6)
        lines, extra = damage.damage_lines(files["tracks"].splitlines(), dialect, random)
        rows += _list_line_defects(extra, "highd", scenario.recording, pair[0].file)
        files["tracks"] = "\n".join(lines) + "\n"
    for suffix, content in files.items():
        (folder / f"{scenario.recording}_{suffix}.csv").write_bytes(content.encode())
    return rows


def _write_ngsim(
    folder: Path,
    kind: str,
    file: str,
    scenarios: tuple[NgsimScenario, ...],
    jobs: list[Job],
    tracks: dict[str, pl.DataFrame],
    seed: int,
    noise: tuple[str, ...],
    *,
    damaged: bool,
) -> list[dict[str, object]]:
    """Write an NGSIM file, and list its defects; `damaged` also inserts duplicates and malformed lines."""
    written, rows = [], []
    for scenario, job in zip(scenarios, jobs, strict=True):
        injected, declared = _damage_tracks(tracks[job.subset], job, seed, noise)
        written.append(ngsim.build_rows(injected, scenario.start_time))
        rows += declared
    random = np.random.default_rng([seed, jobs[0].index, 2])
    together = pl.concat(written)
    if kind == "ngsim-text":
        lines, dialect = ngsim.format_text(together), damage.Dialect(header=False, separator=None, number_field=5)
    elif kind == "ngsim-csv":
        lines, dialect = ngsim.format_csv(together), damage.Dialect(header=True, separator=",", number_field=5)
    else:
        lines = ngsim.format_portal(ngsim.shuffle_rows(together, random))
        dialect = damage.Dialect(header=True, separator=",", number_field=5, quotes=True)
    lines, extra = damage.damage_lines(lines, dialect, random) if damaged else (lines, [])
    recording = jobs[0].recording if len(jobs) == 1 else None
    rows += _list_line_defects(extra, "ngsim", recording, file)
    end, start = ("\r\n", BOM) if kind == "socrata" else ("\n", b"")
    (folder / file).write_bytes(start + (end.join(lines) + end).encode())
    return rows
