"""Removal of recordings, named or with missing raw files: their tables, and all that was built on them."""

import os
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tracklake.pipeline.ingest.discovery import Discovery
from tracklake.pipeline.lake import Commit, LakeError, Manifest, load, open_for_writing
from tracklake.pipeline.stages.stage import Job
from tracklake.schemas import BSM, TRACKS


@dataclass(frozen=True)
class Removed:
    """A recording that was taken out of a lake: its subsets or drives, and its rows in `tracks` and in all tables.

    `files` are the raw files that are still where they were read; `messages` counts rows of `bsm`.
    """

    dataset: str
    recording: str
    subsets: list[str]
    entries: int
    rows: int
    files: list[str]
    messages: int = 0

    @property
    def name(self) -> str:
        """Name that `tracklake remove` takes, whatever else is in the lake."""
        return f"{self.dataset}/{self.recording}"


def describe_sizes(removed: Sequence[Removed]) -> str:
    """Return how much was removed: rows of tracks, messages of drives, or both."""
    entries, messages = sum(each.entries for each in removed), sum(each.messages for each in removed)
    tracks = [f"{entries:,} rows of tracks"] if entries or not messages else []
    return " and ".join([*tracks, *([f"{messages:,} messages"] if messages else [])])


class Folder:
    """The present contents of a SOURCE, to compare with what the lake remembers of it."""

    def __init__(self, source: Path, discovery: Discovery) -> None:
        self._root = source
        # What is grouped to a recording is that recording's, and no other's that was renamed.
        grouped = {file.name for _, unit in discovery.units if unit.recording is not None for file in unit.files}
        self._hashes = {file.sha256 for file in discovery.recognised if file.name not in grouped}
        # The members of an archive share its path.
        self._places = {(str(file.path), file.name) for file in discovery.recognised}
        # A folder in which nothing is usable tells nothing: it may be the wrong one, or a disk that is not there.
        self._tells = source.is_dir() and bool(discovery.units)

    def is_lost(self, file: dict[str, Any]) -> bool:
        """Return whether a file that a commit was made of was in this folder, and is nowhere in it now.

        A file that is still there and cannot be read, or is not recognised, is not lost; nor is a member of an
        archive that is still there.
        """
        path = file.get("path")  # older lakes do not know it
        if path is None or not self._tells or not Path(path).is_relative_to(self._root):
            return False
        known = (path, file["file"]) in self._places
        return file["sha256"] not in self._hashes and (known or _is_gone(path))


def _is_gone(path: str) -> bool:
    """Return whether nothing is at a path; what lies in a folder that cannot be read is not known to be gone."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        return False
    return False


def find_missing(folder: Folder, jobs: Iterable[Job], manifest: Manifest, dataset: str | None = None) -> list[Commit]:
    """Return the commits of ingestion all of whose files were in a folder and are missing from it now.

    `jobs` are all that the folder's files give: what one of these makes is not missing. With a dataset only its files
    were searched for.
    """
    planned = {job.key for job in jobs}
    return [
        commit
        for commit in manifest.of_stage("ingest")
        if commit.key not in planned
        and dataset in (None, commit.info["dataset"])
        and all(folder.is_lost(file) for file in commit.built_from["sources"])
    ]


def find_renamed(jobs: Sequence[Job], manifest: Manifest) -> list[Commit]:
    """Return the commits of recordings whose rows these jobs make recordings of other names of.

    That is where a file that holds several recordings was read with another `--recording` before.
    """
    planned = {job.key for job in jobs}
    read = {
        (job.inputs["dataset"], source["sha256"])
        for job in jobs
        for source in job.built_from["sources"]
        if source["sha256"] in manifest.sources
    }
    return [
        commit
        for commit in manifest.of_stage("ingest")
        if commit.key not in planned
        and commit.info["recording"] is not None
        and all((commit.info["dataset"], file["sha256"]) in read for file in commit.built_from["sources"])
    ]


def find_superseded(discovery: Discovery, manifest: Manifest) -> list[Commit]:
    """Return commits of lines without a recording whose file was replaced by a new version, which was read."""
    now = {(str(file.path), file.name): file.sha256 for file in discovery.recognised}
    found = []
    for commit in manifest.of_stage("ingest"):
        file = commit.built_from["sources"][0]
        sha256 = now.get((file.get("path"), file["file"]), file["sha256"])
        if commit.info["recording"] is None and sha256 != file["sha256"] and sha256 in manifest.sources:
            found.append(commit)
    return found


def find_moved(jobs: Iterable[Job], manifest: Manifest) -> list[tuple[Job, Commit]]:
    """Return jobs that are done and whose files are not where the lake remembers them, each with its commit."""
    done = [(job, manifest.commits[job.key]) for job in jobs if job.key in manifest.commits]
    return [
        (job, commit)
        for job, commit in done
        if commit.fingerprint == job.fingerprint
        and commit.built_from["sources"] != job.built_from["sources"]
        and not all(os.path.lexists(file.get("path", "")) for file in commit.built_from["sources"])
    ]


def find_dependents(commits: Iterable[Commit], manifest: Manifest) -> set[str]:
    """Return the keys of all commits of the same recordings, whatever their stage, and of what was built on those.

    Stages over the whole lake name in `built_from` the keys that they were made of.
    """
    tails = {commit.tail for commit in commits}
    found = {key for key, commit in manifest.commits.items() if commit.tail in tails}
    while more := {
        key for key, commit in manifest.commits.items() if key not in found and found & _list_inputs(commit)
    }:
        found |= more
    return found


def _list_inputs(commit: Commit) -> set[str]:
    inner = [value.keys() for value in commit.built_from.values() if isinstance(value, dict)]
    return set(commit.built_from).union(*inner)


def describe_removed(commits: Iterable[Commit], manifest: Manifest) -> list[Removed]:
    """Return the recordings among commits of ingestion, with the rows that are removed with each."""
    found = []
    for commit in commits:
        dataset, recording = commit.info["dataset"], commit.info["recording"]
        if recording is None:
            continue
        own = [other for other in manifest.commits.values() if other.tail == commit.tail]
        files = [file for other in own for file in other.all_files]
        kept, messages = (sum(file.rows or 0 for file in commit.files.get(table.name, [])) for table in (TRACKS, BSM))
        subsets = sorted([*(subset["subset"] for subset in commit.info["subsets"]), *commit.info.get("drives", ())])
        places = (file.get("path", "") for file in commit.built_from["sources"])
        there = sorted({place for place in places if os.path.lexists(place)})
        rows = sum(file.rows or 0 for file in files)
        found.append(Removed(dataset, recording, subsets, kept, rows, there, messages))
    return found


def name_recordings(commits: Sequence[Commit]) -> str:
    """Return commits of ingestion for a sentence: `recordings 03, 04`, or files whose lines have no recording."""
    names = sorted({commit.info["recording"] for commit in commits if commit.info["recording"] is not None})
    if names:
        return f"recording{'s' if len(names) > 1 else ''} {', '.join(names)}"
    files = sorted({file["file"] for commit in commits for file in commit.built_from["sources"]})
    return f"lines of {', '.join(files)} that belong to no recording"


def remove_recordings(root: Path, names: Sequence[str]) -> tuple[list[Removed], list[str]]:
    """Remove recordings, `recording` or `dataset/recording`, with all that was made of them; files are retired first.

    Returns what was removed, and the stages over the whole lake that have to run again.

    Raises:
        LakeMissingError: no lake there.
        LakeError: a name is unknown or ambiguous; nothing was removed.
    """
    _find_named(root, names, load(root))  # before anything is locked or made
    with open_for_writing(root) as writer:
        commits = _find_named(root, names, writer.manifest)
        commits += _find_unassigned(commits, writer.manifest)
        removed, keys = describe_removed(commits, writer.manifest), find_dependents(commits, writer.manifest)
        writer.remove(keys)
    return removed, sorted(key for key in keys if "/" not in key)


def _find_named(root: Path, names: Collection[str], manifest: Manifest) -> list[Commit]:
    known = [commit for commit in manifest.of_stage("ingest") if commit.info["recording"] is not None]
    found: dict[str, Commit] = {}
    for name in names:
        full = {commit.key: f"{commit.info['dataset']}/{commit.info['recording']}" for commit in known}
        fitting = [commit for commit in known if name in (commit.info["recording"], full[commit.key])]
        if not fitting:
            listed = ", ".join(sorted(full.values())) or "none"
            raise LakeError(f"{root}: no recording {name!r} in the lake; it has {listed}. Nothing was removed.")
        if len(fitting) > 1:
            choice = " or ".join(sorted(full[commit.key] for commit in fitting))
            raise LakeError(f"{root}: the recording {name!r} may be {choice}; say which. Nothing was removed.")
        found[fitting[0].key] = fitting[0]
    return list(found.values())


def _find_unassigned(commits: Sequence[Commit], manifest: Manifest) -> list[Commit]:
    """Return the commits of lines without a recording, of files of which nothing else stays in the lake."""
    keys = {commit.key for commit in commits}
    others = [commit for commit in manifest.of_stage("ingest") if commit.key not in keys]
    used = {
        s["sha256"] for commit in others if commit.info["recording"] is not None for s in commit.built_from["sources"]
    }
    theirs = {s["sha256"] for commit in commits for s in commit.built_from["sources"]} - used
    return [
        commit
        for commit in others
        if commit.info["recording"] is None and commit.built_from["sources"][0]["sha256"] in theirs
    ]
