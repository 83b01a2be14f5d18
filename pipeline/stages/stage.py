"""What a stage is: a declaration, the jobs planned from it, and what its build function returns."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import polars as pl

from tracklake.pipeline.lake import Commit, LakeFile, Manifest
from tracklake.pipeline.settings import Settings
from tracklake.schemas import SCHEMA_VERSION, Table
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.hashing import hash_values
from tracklake.schemas.protocols import RECONSTRUCTED_TRACKS, RECORDED

RECONSTRUCTION = "reconstruct"
"""Name of the stage whose tracks later stages read where the setting `tracks_from` is "reconstructed"."""
INGEST = "ingest"
"""Name of the stage that makes the recordings; every other stage works on what it committed."""
Scope = Literal["recording", "freeway recording", "drive", "lake"]


class StageError(TracklakeError):
    """A stage cannot run as things stand; the message says what to run first."""


@dataclass(frozen=True)
class Job:
    """One stage's work on one recording (or on the whole lake): a small record, fit to be sent to another process.

    Args:
        key: key of the commit that it makes: `stage/dataset/recording`, or `stage`.
        built_from: what the fingerprint was made of, for the manifest.
        inputs: what the build function needs: dataset and subsets, or an ingested recording's files.
    """

    key: str
    fingerprint: str
    built_from: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Name in progress bars and messages: the recording, or the stage where it is over the whole lake."""
        return self.key.rpartition("/")[2]

    @property
    def tail(self) -> str:
        """The key without the stage: `dataset/recording`, or nothing for a stage over the whole lake."""
        return self.key.partition("/")[2]


@dataclass(frozen=True)
class StageResult:
    """What a build function returns where it makes more than tables.

    Args:
        tables: frames by table; they are validated and written by the planner.
        files: files that the build function wrote into the lake itself, by folder (tensors, reports, models).
        info: small facts that later stages and commands read from the manifest.
        part: name of the slice that the tables are of, where a stage makes several; part of their files' names.
    """

    tables: Mapping[Table, pl.DataFrame] = field(default_factory=dict)
    files: Mapping[str, list[LakeFile]] = field(default_factory=dict)
    info: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    part: str = ""


Built = StageResult | Mapping[Table, pl.DataFrame] | Iterator[StageResult]
"""What a build function returns of one reader."""


@dataclass(frozen=True)
class Stage:
    """The declaration of a stage; jobs, fingerprints and staleness follow from it.

    Args:
        name: name of the stage, and of its command where it has one.
        meaning: one line for help texts.
        scope: what one job works on; freeway recordings are those with freeway subsets, and only these are built.
            Recordings are carriageways seen from above; drives are recordings of an instrumented vehicle.
        after: stages whose tables it reads, `ingest` among them. Without any, it takes the lake as it is.
        after_reconstruction: stages whose tables it reads as well where the setting `tracks_from` is "reconstructed":
            RECONSTRUCTION, and `revalidate` where it reads findings. If it names any, the stage reads tracks as
            `tracks_from` says (`SubsetReader.read_tracks`), and its result depends on that setting.
        settings: what its result depends on: names of settings, or functions that give values by name.
        version: number to raise when the code makes other results of the same inputs.
        build: (reader, settings) to frames by table, or a StageResult, or an iterator of StageResults, one for each
            slice of a long subset. The reader is a SubsetReader, once for every subset (or drive) of the recording; a
            LakeReader for the scope `lake`.
        batch_entries: number of entries up to which small recordings are built together: `build` then takes a list of
            LakeReaders and returns a list of StageResults. 0: recordings are built one by one.
        extra_inputs: (lake, manifest, settings) to other values that the result depends on, by `dataset/recording`
            (by "" for the scope `lake`). The stage leaves out recordings without any.
        command: command that runs the stage, where it is called otherwise.
    """

    name: str
    meaning: str
    scope: Scope
    after: tuple[str, ...]
    version: int
    build: Callable[[Any, Settings], Built | list[StageResult]]
    settings: tuple[str | Callable[[Settings], Mapping[str, Any]], ...] = ()
    batch_entries: int = 0
    extra_inputs: Callable[[Path, Manifest, Settings], Mapping[str, Mapping[str, Any]]] | None = None
    after_reconstruction: tuple[str, ...] = ()
    command: str = ""

    def list_inputs(self, settings: Settings) -> tuple[str, ...]:
        """Return the stages whose tables it reads with these settings."""
        reads_reconstructed = settings.tracks_from == RECONSTRUCTED_TRACKS
        return (*self.after, *self.after_reconstruction) if reads_reconstructed else self.after

    def describe_settings(self, settings: Settings) -> dict[str, Any]:
        """Return the values of the settings that the result depends on, by name."""
        names = {item for item in self.settings if isinstance(item, str)}
        values: dict[str, Any] = settings.model_dump(mode="json", include=names)
        for item in self.settings:
            if not isinstance(item, str):
                values |= item(settings)
        if self.after_reconstruction and settings.tracks_from != RECORDED:
            values["tracks_from"] = settings.tracks_from
        return values


def list_results(built: Built) -> Iterator[StageResult]:
    """Yield the results of a build function, whatever shape they have."""
    if isinstance(built, Iterator):
        yield from built
    else:
        yield built if isinstance(built, StageResult) else StageResult(built)


def make_job(key: str, *, version_of_stage: int, made_of: Mapping[str, Any], inputs: dict[str, Any]) -> Job:
    """Return a job whose fingerprint covers its key, the code's version, the schemas' and all that it is made of."""
    built_from = {
        "tracklake": version("tracklake"),
        "stage_version": version_of_stage,
        "schema_version": SCHEMA_VERSION,
        **made_of,
    }
    return Job(key, hash_values([key, version_of_stage, SCHEMA_VERSION, made_of], 16), built_from, inputs)


def make_commit(job: Job, files: dict[str, list[LakeFile]], info: dict[str, Any], started: float) -> Commit:
    """Return the commit of a job's files, with the seconds since `started`, a value of `time.perf_counter()`."""
    timed = {**info, "seconds": round(time.perf_counter() - started, 3)}
    return Commit(key=job.key, fingerprint=job.fingerprint, files=files, built_from=job.built_from, info=timed)
