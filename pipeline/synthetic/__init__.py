"""The generator of sample recordings: simulated traffic in the raw formats, with noise, known defects and the truth."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from tracklake.pipeline.synthetic.build import README_FILE, TRUE_TRACKS_FILE, TRUTH_FILE, build_sample
from tracklake.pipeline.synthetic.drivers import TRAFFICS, UNIFORM
from tracklake.pipeline.synthetic.noise import NOISE_MODELS, SMOOTH
from tracklake.pipeline.synthetic.plain_formats import PLAIN
from tracklake.pipeline.synthetic.scenarios import (
    DEFAULT_FORMATS,
    DOSED,
    DRIVES,
    FORMATS,
    HIGHD_ONLY,
    LEAST_MINUTES,
    MOST_MINUTES,
    Dose,
)
from tracklake.pipeline.synthetic.sumo import SumoError
from tracklake.pipeline.synthetic.truth import TRUTH_SCHEMA
from tracklake.schemas.errors import UsageError
from tracklake.schemas.files import replace_folder

ALL_FORMATS = FORMATS
DEFAULT_MINUTES = 1.0
"""Length of the recordings in minutes, unless set."""
DEFAULT_NOISE = (SMOOTH,)
"""Noise models of a sample, unless set."""
__all__ = [
    "ALL_FORMATS",
    "DEFAULT_FORMATS",
    "DEFAULT_MINUTES",
    "DEFAULT_NOISE",
    "DOSED",
    "NOISE_MODELS",
    "TRAFFICS",
    "UNIFORM",
    "SampleSummary",
    "SumoError",
    "write_sample",
]


@dataclass(frozen=True)
class SampleSummary:
    """The result of writing a sample: its files, data lines of tracks with damaged ones, recordings, and time.

    `dose` is the share of the vehicles that have the defect, where one was asked for by dose.
    """

    files: tuple[Path, ...]
    rows: int
    recordings: int
    seconds: float
    dose: float | None = None


def write_sample(
    out: Path,
    *,
    formats: tuple[str, ...] = DEFAULT_FORMATS,
    minutes: float = DEFAULT_MINUTES,
    seed: int = 1,
    noise: tuple[str, ...] = DEFAULT_NOISE,
    traffic: str = UNIFORM,
    defect: str | None = None,
    dose: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> SampleSummary:
    """Write a sample: raw files, `truth.parquet`, `true_tracks.parquet` and a README.

    The folder appears whole or not at all: the files are written to a hidden folder, which is renamed. Some of
    ALL_FORMATS are written into `out`, which is missing, empty, or holds only an earlier sample, which is replaced.
    Recordings last 0.4 to 1.9 times `minutes`; the same seed, formats and minutes give the same bytes. `noise` are some
    of NOISE_MODELS, whose errors add up; with none, positions are exact but for the defects. `traffic` is one of
    TRAFFICS. With `defect`, a name from DOSED, the share `dose` of the vehicles has it, and there are no other defects.
    `progress` is called with a description of each step.

    Raises:
        UsageError: an argument is invalid, or `out` holds other files.
        SumoError: SUMO is not installed, or failed.
    """
    unknown = [name for name in formats if name not in ALL_FORMATS]
    if unknown or not formats:
        raise UsageError(f"formats: expected some of {', '.join(ALL_FORMATS)}, got {', '.join(unknown) or 'none'}")
    if not LEAST_MINUTES <= minutes <= MOST_MINUTES:
        raise UsageError(f"minutes: expected {LEAST_MINUTES:g} to {MOST_MINUTES:g}, got {minutes}")
    if seed < 0:
        raise UsageError(f"seed: expected a whole number from 0, got {seed}")
    models = tuple(name for name in NOISE_MODELS if name in noise)
    if unknown := [name for name in noise if name not in models]:
        raise UsageError(f"noise: expected some of {', '.join(NOISE_MODELS)}, got {', '.join(unknown)}")
    if traffic not in TRAFFICS:
        raise UsageError(f"traffic: expected one of {', '.join(TRAFFICS)}, got {traffic}")
    dosed = _read_dose(defect, dose, formats)
    out = Path(out).absolute()
    _require_replaceable(out)
    began = time.perf_counter()
    with replace_folder(out) as aside:
        report = progress or (lambda _: None)
        rows, recordings, reached = build_sample(aside, formats, minutes, seed, models, traffic, dosed, report)
        _require_replaceable(out)
    return SampleSummary(tuple(sorted(out.iterdir())), rows, recordings, time.perf_counter() - began, reached)


def _read_dose(defect: str | None, dose: float | None, formats: tuple[str, ...]) -> Dose | None:
    """Check a defect and its dose; both or none are given."""
    if defect is None and dose is None:
        return None
    if defect is None or dose is None:
        raise UsageError("a defect and its dose belong together, such as --defect frame_gap --dose 0.05")
    if defect not in DOSED:
        raise UsageError(f"defect: expected one of {', '.join(DOSED)}, got {defect}")
    if not 0 <= dose <= 1:
        raise UsageError(f"dose: expected a share of the vehicles from 0 to 1, got {dose}")
    if plain := [name for name in formats if name in PLAIN]:
        raise UsageError(f"{', '.join(plain)}: generated without defects; leave --defect out, or choose other formats")
    if set(formats) <= {DRIVES}:
        raise UsageError(
            f"{defect}: drives do not have it by dose; add --format highd, or another of overhead recordings"
        )
    others = [name for name in formats if name not in ("highd", DRIVES)]
    if defect in HIGHD_ONLY and others:
        raise UsageError(f"{defect} cannot be recorded in {', '.join(others)}; choose --format highd")
    return Dose(defect, dose)


def _require_replaceable(out: Path) -> None:
    """Refuse a folder that holds anything but an earlier sample."""
    if not out.exists():
        return
    if not out.is_dir():
        raise UsageError(f"{out} is a file; expected a missing or empty folder. Name another one with --out.")
    if not any(out.iterdir()):
        return
    advice = "Name another folder with --out, or empty this one."
    truth = out / TRUTH_FILE
    if not truth.is_file():
        raise UsageError(f"{out} is not empty and holds no sample ({TRUTH_FILE} is missing). {advice}")
    try:
        table = pl.read_parquet(truth)
    except pl.exceptions.ComputeError as error:
        raise UsageError(f"{truth} cannot be read, so {out} is not known to be a sample. {advice}") from error
    if table.schema != pl.Schema(TRUTH_SCHEMA):
        raise UsageError(f"{truth} is not that of a sample of this version. {advice}")
    known = set(table["file"].drop_nulls()) | {TRUTH_FILE, TRUE_TRACKS_FILE, README_FILE}
    present = {file.relative_to(out).as_posix() for file in out.rglob("*") if not file.is_dir()}
    foreign = sorted(present - known)
    if foreign:
        raise UsageError(f"{out} holds a sample, but also {foreign[0]}, which would be lost. {advice}")
