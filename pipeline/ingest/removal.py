"""What goes when raw files are gone or a recording is named: its tables, and what was built on them."""

import os
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tracklake.pipeline.ingest.discovery import Discovery
from tracklake.pipeline.lake import Commit, LakeError, Manifest, load, open_for_writing
from tracklake.pipeline.stages.stage import Job
from tracklake.schemas import TRACKS


@dataclass(frozen=True)
class Removed:
    """A recording that was taken out of a lake.

    Args:
        dataset: of the recording.
        recording: its name.
        subsets: its subsets.
        entries: rows it had in `tracks`.
        rows: rows it had in all tables.
        files: its raw files that are still where they were read.
    """

    dataset: str
    recording: str
    subsets: list[str]
    entries: int
    rows: int
    files: list[str]

    @property
    def name(self) -> str:
        """As `tracklake remove` takes it, whatever else is in the lake."""
        return f"{self.dataset}/{self.recording}"


class Folder:
    """What a SOURCE holds now, to compare with what the lake remembers of it."""

    def __init__(self, source: Path, discovery: Discovery) -> None:
        self._root = source
        # What is grouped to a recording is that recording's, and no other's that was renamed.
        grouped = {file.name for _, unit in discovery.units if unit.recording is not None for file in unit.files}
        self._hashes = {file.sha256 for file in discovery.recognised if file.name not in grouped}
        # The members of an archive share its path.
        self._places = {(str(file.path), file.name) for file in discovery.recognised}
        # A folder in which nothing is usable tells nothing: it may be the wrong one, or a disk that is not there.
        self._tells = source.is_dir() and bool(discovery.units)

    def lost(self, stood: dict[str, Any]) -> bool:
        """Whether a file of an entry that nothing makes now stood in this folder, and is nowhere in it any more.

        A file that is still there and cannot be read, or is not recognised, is not lost; nor is a member of an
        archive that is still there.
        """
        path = stood.get("path")  # lakes of before do not know it
        if path is None or not self._tells or not Path(path).is_relative_to(self._root):
            return False
        known = (path, stood["file"]) in self._places
        return stood["sha256"] not in self._hashes and (known or not os.path.lexists(path))


def find_missing(folder: Folder, jobs: Iterable[Job], manifest: Manifest, dataset: str | None = None) -> list[Commit]:
    """Entries of ingestion all of whose files stood in a folder and are gone.

    Args:
        folder: as it is now.
        jobs: all that its files give: what one of these makes is not gone.
        manifest: of the lake.
        dataset: the only one that was looked for.
    """
    planned = {job.key for job in jobs}
    return [
        entry
        for entry in manifest.of_stage("ingest")
        if entry.key not in planned
        and dataset in (None, entry.info["dataset"])
        and all(folder.lost(stood) for stood in entry.built_from["sources"])
    ]


def find_superseded(discovery: Discovery, manifest: Manifest) -> list[Commit]:
    """Entries for lines without a recording whose file was since replaced by a new version of it, which was read."""
    now = {(str(file.path), file.name): file.sha256 for file in discovery.recognised}
    found = []
    for entry in manifest.of_stage("ingest"):
        stood = entry.built_from["sources"][0]
        sha256 = now.get((stood.get("path"), stood["file"]), stood["sha256"])
        if entry.info["recording"] is None and sha256 != stood["sha256"] and sha256 in manifest.sources:
            found.append(entry)
    return found


def find_moved(jobs: Iterable[Job], manifest: Manifest) -> list[tuple[Job, Commit]]:
    """Jobs whose work is done and whose files are not where the lake remembers them, with what is remembered."""
    done = [(job, manifest.commits[job.key]) for job in jobs if job.key in manifest.commits]
    return [
        (job, entry)
        for job, entry in done
        if entry.fingerprint == job.fingerprint
        and entry.built_from["sources"] != job.built_from["sources"]
        and not all(os.path.lexists(stood.get("path", "")) for stood in entry.built_from["sources"])
    ]


def find_dependents(entries: Iterable[Commit], manifest: Manifest) -> set[str]:
    """Keys of all that goes with entries of ingestion: every stage's of the same recordings, and what builds on those.

    Stages over the whole lake name in `built_from` the keys that they were made of.
    """
    tails = {entry.key.partition("/")[2] for entry in entries}
    gone = {key for key in manifest.commits if key.partition("/")[2] in tails}
    while more := {key for key, entry in manifest.commits.items() if key not in gone and gone & _named_in(entry)}:
        gone |= more
    return gone


def _named_in(entry: Commit) -> set[str]:
    inner = [value.keys() for value in entry.built_from.values() if isinstance(value, dict)]
    return set(entry.built_from).union(*inner)


def describe_removed(entries: Iterable[Commit], manifest: Manifest) -> list[Removed]:
    """The recordings among entries of ingestion, with the rows that go with each."""
    found = []
    for entry in entries:
        dataset, recording = entry.info["dataset"], entry.info["recording"]
        if recording is None:
            continue
        tail = entry.key.partition("/")[2]
        own = [other for key, other in manifest.commits.items() if key.partition("/")[2] == tail]
        files = [file for other in own for group in other.files.values() for file in group]
        entries_kept = sum(file.rows or 0 for file in entry.files.get(TRACKS.name, []))
        subsets = sorted(subset["subset"] for subset in entry.info["subsets"])
        places = (stood.get("path", "") for stood in entry.built_from["sources"])
        there = sorted({place for place in places if os.path.lexists(place)})
        found.append(Removed(dataset, recording, subsets, entries_kept, sum(file.rows or 0 for file in files), there))
    return found


def name_recordings(entries: Sequence[Commit]) -> str:
    """Entries of ingestion for a sentence: `recordings 03, 04`, or the files whose lines have no recording."""
    names = sorted({entry.info["recording"] for entry in entries if entry.info["recording"] is not None})
    if names:
        return f"recording{'s' if len(names) > 1 else ''} {', '.join(names)}"
    files = sorted({stood["file"] for entry in entries for stood in entry.built_from["sources"]})
    return f"lines of {', '.join(files)} that belong to no recording"


def remove_recordings(root: Path, names: Sequence[str]) -> tuple[list[Removed], list[str]]:
    """Take recordings out of a lake, with all that was made of them; their files are retired, not deleted yet.

    Args:
        root: the lake.
        names: of recordings, as in `subsets.recording`, or `dataset/recording`.

    Returns:
        What was removed, and the stages over the whole lake that have to run again.

    Raises:
        LakeMissingError: no lake there.
        LakeError: a name is unknown or ambiguous; nothing was removed.
    """
    _find_named(root, names, load(root))  # before anything is locked or made
    with open_for_writing(root) as writer:
        entries = _find_named(root, names, writer.manifest)
        entries += _their_lines(entries, writer.manifest)
        removed, keys = describe_removed(entries, writer.manifest), find_dependents(entries, writer.manifest)
        writer.remove(keys)
    return removed, sorted(key for key in keys if "/" not in key)


def _find_named(root: Path, names: Collection[str], manifest: Manifest) -> list[Commit]:
    known = [entry for entry in manifest.of_stage("ingest") if entry.info["recording"] is not None]
    found: dict[str, Commit] = {}
    for name in names:
        full = {entry.key: f"{entry.info['dataset']}/{entry.info['recording']}" for entry in known}
        fitting = [entry for entry in known if name in (entry.info["recording"], full[entry.key])]
        if not fitting:
            listed = ", ".join(sorted(full.values())) or "none"
            raise LakeError(f"{root}: no recording {name!r} in the lake; it has {listed}. Nothing was removed.")
        if len(fitting) > 1:
            choice = " or ".join(sorted(full[entry.key] for entry in fitting))
            raise LakeError(f"{root}: the recording {name!r} may be {choice}; say which. Nothing was removed.")
        found[fitting[0].key] = fitting[0]
    return list(found.values())


def _their_lines(entries: Sequence[Commit], manifest: Manifest) -> list[Commit]:
    """Lines without a recording, of files of which nothing else stays in the lake."""
    keys = {entry.key for entry in entries}
    others = [entry for entry in manifest.of_stage("ingest") if entry.key not in keys]
    used = {s["sha256"] for entry in others if entry.info["recording"] is not None for s in entry.built_from["sources"]}
    theirs = {s["sha256"] for entry in entries for s in entry.built_from["sources"]} - used
    return [
        entry
        for entry in others
        if entry.info["recording"] is None and entry.built_from["sources"][0]["sha256"] in theirs
    ]
