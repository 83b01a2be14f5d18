"""What a stage is: jobs planned from the manifest, each built into files and one entry to commit."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Entry, LakeFile, Manifest, is_intact
from tracklake.pipeline.settings import Settings
from tracklake.schemas import SCHEMA_VERSION
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.hashing import hash_values


class StageError(TracklakeError):
    """A stage cannot run as things stand; the message says what to run first."""


@dataclass(frozen=True)
class Job:
    """One stage's work on one recording (or on the whole lake): a small record, fit to be sent to another process.

    Args:
        key: of the entry it will make: `stage/dataset/recording`, or `stage`.
        fingerprint: of its inputs, settings and code version.
        built_from: what the fingerprint was made of, for the manifest.
        inputs: what the stage's build function needs.
    """

    key: str
    fingerprint: str
    built_from: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """For progress bars and messages: the recording, or the stage where it is over the whole lake."""
        return self.key.rpartition("/")[2]


Plan = Callable[[Path, Manifest, Settings], list[Job]]
"""(lake, manifest, settings) to the jobs that would make a stage complete."""


@dataclass(frozen=True)
class Stage:
    """A stage of the pipeline.

    Args:
        name: of the stage and of its command.
        meaning: one line for people.
        plan: what there would be to do.
        build: (lake, job, settings) to the entry to commit; writes the files.
    """

    name: str
    meaning: str
    plan: Plan
    build: Callable[[Path, Job, Settings], Entry]


def make_job(key: str, *, version_of_stage: int, made_of: dict[str, Any], inputs: dict[str, Any]) -> Job:
    """A job whose fingerprint covers its key, the code's version, the schemas' and everything it is made of."""
    built_from = {
        "tracklake": version("tracklake"),
        "stage_version": version_of_stage,
        "schema_version": SCHEMA_VERSION,
        **made_of,
    }
    return Job(key, hash_values([key, version_of_stage, SCHEMA_VERSION, made_of], 16), built_from, inputs)


def make_entry(job: Job, files: dict[str, list[LakeFile]], info: dict[str, Any]) -> Entry:
    """The entry a job's files make."""
    return Entry(key=job.key, fingerprint=job.fingerprint, files=files, built_from=job.built_from, info=info)


def pending(root: Path, manifest: Manifest, jobs: Iterable[Job]) -> list[Job]:
    """The jobs that are not done: no entry, one made of something else, or one whose files are not whole."""
    return [job for job in jobs if not _is_done(root, manifest, job)]


def _is_done(root: Path, manifest: Manifest, job: Job) -> bool:
    entry = manifest.entries.get(job.key)
    if entry is None or entry.fingerprint != job.fingerprint:
        return False
    return is_intact(root, (file for group in entry.files.values() for file in group))


def recordings(manifest: Manifest, *, freeway_only: bool = False) -> list[dict[str, Any]]:
    """What ingestion committed: dataset, recording, fingerprint and the subsets (of freeways) of each recording."""
    found = []
    for entry in manifest.of_stage("ingest"):
        subsets = [s for s in entry.info.get("subsets", []) if s["freeway"] or not freeway_only]
        if subsets:
            facts = {"dataset": entry.info["dataset"], "recording": entry.info["recording"], "subsets": subsets}
            found.append({**facts, "fingerprint": entry.fingerprint})
    return found


def upstream(plan: Plan, root: Path, manifest: Manifest, settings: Settings) -> dict[str, str]:
    """Fingerprints of an earlier stage's entries by key, each as that stage would make it now.

    Raises:
        StageError: the stage has not run, or ran on other inputs or with other settings than now.
    """
    found = {}
    for job in plan(root, manifest, settings):
        entry = manifest.entries.get(job.key)
        if entry is None or entry.fingerprint != job.fingerprint:
            stage = job.key.split("/", 1)[0]
            what = f"{stage} of {job.title}" if job.title != stage else stage
            state = "has not been made" if entry is None else "was made from other inputs or with other settings"
            raise StageError(f"{what} {state}. Run `tracklake {stage}` first, or `tracklake run` for everything.")
        found[job.key] = entry.fingerprint
    return found
