"""The manifest: the live files of every table, and what each was built from."""

import uuid
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake.errors import (
    DamagedShardError,
    LakeError,
    LakeMissingError,
    LakeVersionError,
    MissingObjectError,
)
from tracklake.pipeline.lake.places import LakePlace, open_store
from tracklake.pipeline.lake.shards import parse_shards, read_shards
from tracklake.schemas import SCHEMA_VERSION
from tracklake.schemas.documents import parse_json
from tracklake.schemas.errors import FileAccessError
from tracklake.schemas.text import quote_shell

MANIFEST = "manifest.json"
"""Name of the manifest's file in the lake."""


@dataclass(frozen=True)
class LakeFile:
    """One live file of a lake.

    Args:
        path: path relative to the lake's root, with forward slashes.
        rows: number of rows of a table; None for anything else (reports, tensors).
        bytes: size in bytes, so that a truncated file is noticed.
        sha256: checksum of the bytes, so that other damage is noticed; None for what may change (reports, models).
    """

    path: str
    rows: int | None
    bytes: int
    sha256: str | None = None


@dataclass(frozen=True)
class Commit:
    """The committed work of one stage on one recording (or on the whole lake).

    Args:
        key: name of the work: `stage/dataset/recording`, or `stage` for a stage over the whole lake.
        fingerprint: digest of the inputs, settings and code version; part of every file's name. Empty: its files are
            damaged and to be made again.
        files: live files by table.
        built_from: sources with sha256, upstream fingerprints, settings, versions.
        info: small facts that later stages plan with (subsets, counts, notes), and the seconds it took.
    """

    key: str
    fingerprint: str
    files: dict[str, list[LakeFile]]
    built_from: dict[str, Any] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def stage(self) -> str:
        """Name of the stage that made it."""
        return self.key.split("/", 1)[0]

    @property
    def tail(self) -> str:
        """The key without the stage: `dataset/recording`, or nothing for a stage over the whole lake."""
        return self.key.partition("/")[2]

    @property
    def all_files(self) -> list[LakeFile]:
        """The files of all its tables."""
        return [file for group in self.files.values() for file in group]


@dataclass(frozen=True)
class Retired:
    """A file that is no longer live, kept for readers that opened the lake before it was replaced.

    Args:
        generation: number of the session in which it was replaced.
        void: whether it must not be used again, even for the same inputs: a rebuild makes everything again.
    """

    path: str
    generation: int
    void: bool = False
    sha256: str | None = None


@dataclass(frozen=True)
class Retention:
    """How long replaced files are kept, and with them the earlier states of the lake that can be queried.

    Args:
        generations: number of earlier generations.
        hours: time since a file was replaced, however many generations followed, in hours.
    """

    generations: int = 2
    hours: float = 0.0


@dataclass(frozen=True)
class Manifest:
    """The state of a lake: replaced as a whole, never edited in place.

    Args:
        lake_id: identifier made with the lake; artifacts in Prefect are named after it.
        generation: number of writing sessions that changed something.
        commits: committed work by key; `entries` in the file.
        sources: dataset, dialect and recordings of raw files, by sha256.
        retired: files to delete when they need not be kept any more.
        ingested_from: SOURCEs that it was made from, the last one last.
        retention: how long they are kept.
    """

    lake_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    generation: int = 0
    commits: dict[str, Commit] = field(default_factory=dict)
    sources: dict[str, dict[str, Any]] = field(default_factory=dict)
    retired: tuple[Retired, ...] = ()
    ingested_from: tuple[str, ...] = ()
    retention: Retention = Retention()

    def live(self, table: str) -> list[LakeFile]:
        """Return the live files of a table, sorted by path."""
        files = [file for commit in self.commits.values() for file in commit.files.get(table, [])]
        return sorted(files, key=lambda file: file.path)

    def live_paths(self) -> set[str]:
        """Return the paths of all live files."""
        return {file.path for commit in self.commits.values() for file in commit.all_files}

    @cached_property
    def void_paths(self) -> set[str]:
        """Paths of files that must not be used again, and of all folders that hold some."""
        parts = (item.path.split("/") for item in self.retired if item.void)
        return {path for names in parts for path in accumulate(names, "{}/{}".format)}

    @cached_property
    def checksums(self) -> dict[str, str]:
        """Checksums that live and retired files were committed with, by path, as far as they are known."""
        known = {item.path: item.sha256 for item in self.retired}
        known |= {file.path: file.sha256 for commit in self.commits.values() for file in commit.all_files}
        return {path: sha256 for path, sha256 in known.items() if sha256 is not None}

    def of_stage(self, stage: str) -> list[Commit]:
        """Return the commits of a stage, sorted by key."""
        return sorted(
            (commit for commit in self.commits.values() if commit.stage == stage), key=lambda commit: commit.key
        )

    def of_recordings(self, recordings: Collection[str]) -> "Manifest":
        """Return the manifest without what was made of other recordings than these (`dataset/recording`)."""
        commits = {key: commit for key, commit in self.commits.items() if commit.tail in ("", *recordings)}
        return replace(self, commits=commits)

    def add_commit(self, commit: Commit, generation: int) -> "Manifest":
        """Return the manifest with a commit added or replaced; the replaced files are retired."""
        return self.add_commits([commit], generation)

    def add_commits(self, commits: Sequence[Commit], generation: int) -> "Manifest":
        """Return the manifest with commits added or replaced, each with a key of its own."""
        replaced = [self.commits[commit.key] for commit in commits if commit.key in self.commits]
        all_commits = {**self.commits, **{commit.key: commit for commit in commits}}
        return self._replace_commits(all_commits, replaced, commits, generation)

    def mark_damaged(self, keys: Collection[str]) -> "Manifest":
        """Return the manifest with some commits without fingerprints, so that they are made again; files stay live."""
        commits = {k: replace(commit, fingerprint="") if k in keys else commit for k, commit in self.commits.items()}
        return replace(self, commits=commits)

    def remove_commits(self, keys: Collection[str], generation: int) -> "Manifest":
        """Return the manifest without some commits; their files are retired."""
        removed = [commit for key, commit in self.commits.items() if key in keys]
        kept = {key: commit for key, commit in self.commits.items() if key not in keys}
        return self._replace_commits(kept, removed, [], generation)

    def _replace_commits(
        self, commits: dict[str, Commit], replaced: Iterable[Commit], added: Iterable[Commit], generation: int
    ) -> "Manifest":
        """Return the manifest with other commits; all files are looked at only where some are no longer needed."""
        new = {file.path for commit in added for file in commit.all_files}
        dropped = {f.path: f.sha256 for commit in replaced for f in commit.all_files if f.path not in new}
        if dropped:
            groups = (group for commit in commits.values() for group in commit.files.values())
            for path in {file.path for group in groups for file in group if file.path in dropped}:
                del dropped[path]
        retired = self.retired
        if any(item.path in new for item in retired):
            retired = tuple(item for item in retired if item.path not in new)
        retired += tuple(Retired(path, generation, sha256=sha256) for path, sha256 in sorted(dropped.items()))
        return replace(self, commits=commits, generation=generation, retired=retired)


def load(place: LakePlace) -> Manifest:
    """Read a lake's manifest.

    Raises:
        LakeMissingError: no manifest there.
        LakeVersionError: tables of another schema version.
        DamagedShardError: a part of the manifest is missing or damaged.
        LakeError: not a manifest of ours.
    """
    return parse_manifest(place, read_document(place))


_recent: tuple[dict[str, Any], Manifest] | None = None


def load_recent(place: LakePlace) -> Manifest:
    """Return the manifest that this process has read last by this function, as long as its root is the same.

    Reading all of it takes a second where a lake has thousands of recordings, and each job needs it. Raises what `load`
    does.
    """
    global _recent
    root, recent = read_root(place), _recent
    if recent is None or recent[0] != root:
        recent = _recent = root, load(place)
    return recent[1]


def parse_manifest(place: LakePlace, document: Mapping[str, Any]) -> Manifest:
    """Return the manifest that a document of a lake describes; raises what `load` does."""
    version = document["schema_version"]
    if version != SCHEMA_VERSION:
        raise LakeVersionError(
            f"{place}: the lake has tables of schema version {version}, this tracklake writes and reads version "
            f"{SCHEMA_VERSION}. Rebuild it from the raw files: {_write_rebuild_commands(place, document)}."
        )
    try:
        return _parse_document(document)
    except (ValueError, KeyError, TypeError, AttributeError) as broken:
        raise make_foreign_error(place, broken) from broken


def read_document(place: LakePlace) -> dict[str, Any]:
    """Return a lake's manifest of any schema version; only `schema_version` is sure to be in it.

    Raises:
        LakeMissingError: no manifest there.
        DamagedShardError: a part of the manifest is missing or damaged.
        LakeError: not a manifest of ours.
    """
    document = read_root(place)
    while True:
        try:
            return collect_document(place, document)
        except DamagedShardError:
            before, document = document, read_root(place)
            if document == before:  # else a writer has merged and swept shards since the root was read
                raise


def read_root(place: LakePlace) -> dict[str, Any]:
    """Return the content of manifest.json, without what its shards hold; raises what `read_document` does."""
    try:
        content, _ = open_store(place).get(MANIFEST)
    except MissingObjectError:
        raise LakeMissingError(
            f"{place}: no lake here (no {MANIFEST}). Build one with `tracklake run SOURCE --lake "
            f"{quote_shell(place)}`, or name another with --lake or TRACKLAKE_LAKE."
        ) from None
    except FileAccessError as failed:
        raise LakeError(f"{failed} A lake's manifest is a readable file.") from failed
    try:
        document: dict[str, Any] = parse_json(content.decode())
        document["schema_version"]
    except (ValueError, KeyError, TypeError) as broken:
        raise make_foreign_error(place, broken) from broken
    return document


def collect_document(place: LakePlace, document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a root with what its shards hold; one of an earlier layout, which holds everything itself, as it is.

    Raises:
        DamagedShardError: a part of the manifest is missing or damaged.
        LakeError: the root is not one of ours.
    """
    if "shards" not in document:
        return dict(document)
    try:
        found = read_shards(open_store(place), parse_shards(document))
    except (ValueError, TypeError, AttributeError) as broken:
        raise make_foreign_error(place, broken) from broken
    except DamagedShardError as damaged:
        raise DamagedShardError(
            f"{damaged}; {MANIFEST} names it as a part of the manifest. Restore it from a backup, or rebuild the lake "
            f"from the raw files: {_write_rebuild_commands(place, document)}."
        ) from damaged
    held = {name: {key: item for key, item in items.items() if item is not None} for name, items in found.items()}
    retired = [{"path": path, **item} for path, item in sorted(held["retired"].items())]
    return {**document, "entries": held["commits"], "sources": held["sources"], "retired": retired}


def read_sources(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the SOURCEs that a manifest of any version remembers, as far as it does."""
    found = document.get("ingested_from")
    return tuple(item for item in found if isinstance(item, str)) if isinstance(found, list) else ()


def read_retention(document: Mapping[str, Any]) -> Retention:
    """Return how long a lake keeps replaced files; of an earlier layout, or of another version, as by default."""
    default = Retention()
    generations, hours = document.get("kept_generations"), document.get("kept_hours")
    return Retention(
        generations if isinstance(generations, int) else default.generations,
        hours if isinstance(hours, float | int) else default.hours,
    )


def _write_rebuild_commands(place: LakePlace, document: Mapping[str, Any]) -> str:
    """Return the commands that rebuild a lake from the SOURCEs it was made from, the last one first."""
    there = [Path(name) for name in reversed(read_sources(document)) if Path(name).exists()]
    outer = [path for path in there if not any(path != other and path.is_relative_to(other) for other in there)]
    first, *others = (quote_shell(path) for path in outer or [Path("SOURCE")])
    lake = quote_shell(place)
    commands = [f"`tracklake run {first} --lake {lake} --rebuild`"]
    return ", then ".join(commands + [f"`tracklake run {source} --lake {lake}`" for source in others])


def make_foreign_error(place: LakePlace, broken: Exception) -> LakeError:
    """Return the error of a manifest.json that another program wrote, or that is damaged."""
    return LakeError(
        f"{place}/{MANIFEST}: not a manifest of tracklake ({broken!r}). Restore the file, or move the folder away and "
        "rebuild."
    )


def _parse_document(document: Mapping[str, Any]) -> Manifest:
    commits = {
        key: Commit(
            key=key,
            fingerprint=entry["fingerprint"],
            files={table: [LakeFile(**file) for file in files] for table, files in entry["files"].items()},
            built_from=entry["built_from"],
            info=entry["info"],
        )
        for key, entry in document["entries"].items()
    }
    return Manifest(
        lake_id=document["lake_id"],
        generation=document["generation"],
        commits=commits,
        sources=document["sources"],
        retired=tuple(Retired(**item) for item in document["retired"]),
        ingested_from=read_sources(document),
        retention=read_retention(document),
    )
