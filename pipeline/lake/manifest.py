"""manifest.json: the live files of every table, and what each was built from."""

import json
import shlex
import uuid
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake.errors import LakeError, LakeMissingError, LakeVersionError
from tracklake.schemas import SCHEMA_VERSION
from tracklake.schemas.files import write_file

MANIFEST = "manifest.json"


@dataclass(frozen=True)
class LakeFile:
    """One live file.

    Args:
        path: relative to the lake's root, with forward slashes.
        rows: of a table; None for anything else (reports, tensors).
        bytes: size, so that a truncated file is noticed.
    """

    path: str
    rows: int | None
    bytes: int


@dataclass(frozen=True)
class Commit:
    """What one stage made of one recording (or of the whole lake), as committed.

    Args:
        key: `stage/dataset/recording`, or `stage` for a stage over the whole lake.
        fingerprint: of the inputs, settings and code version; part of every file's name.
        files: by table.
        built_from: sources with sha256, upstream fingerprints, settings, versions.
        info: small facts later stages plan with (subsets, counts, notes).
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
        path: relative to the lake's root.
        generation: in which it was replaced.
        void: never to be used again, though what it was made of may be as before: a rebuild makes all anew.
    """

    path: str
    generation: int
    void: bool = False


@dataclass(frozen=True)
class Manifest:
    """The state of a lake: replaced as a whole, never edited in place.

    Args:
        lake_id: made with the lake; results cached elsewhere are bound to it.
        generation: counts the writing sessions that changed something.
        commits: by key; `entries` in the file.
        sources: by sha256: which dataset, dialect and recordings a raw file holds.
        retired: files to delete two generations after they were replaced.
        ingested_from: the SOURCEs it was made from, the last one last.
    """

    lake_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    generation: int = 0
    commits: dict[str, Commit] = field(default_factory=dict)
    sources: dict[str, dict[str, Any]] = field(default_factory=dict)
    retired: tuple[Retired, ...] = ()
    ingested_from: tuple[str, ...] = ()

    def live(self, table: str) -> list[LakeFile]:
        """The live files of a table, sorted by path."""
        files = [file for commit in self.commits.values() for file in commit.files.get(table, [])]
        return sorted(files, key=lambda file: file.path)

    def live_paths(self) -> set[str]:
        """Paths of all live files."""
        return {file.path for commit in self.commits.values() for file in commit.all_files}

    def of_stage(self, stage: str) -> list[Commit]:
        """The commits of a stage, sorted by key."""
        return sorted(
            (commit for commit in self.commits.values() if commit.stage == stage), key=lambda commit: commit.key
        )

    def of_recording(self, recording: str) -> "Manifest":
        """The manifest without what was made of other recordings than this one (`dataset/recording`)."""
        commits = {key: commit for key, commit in self.commits.items() if key.partition("/")[2] in ("", recording)}
        return replace(self, commits=commits)

    def committing(self, commit: Commit, generation: int) -> "Manifest":
        """The manifest with a commit added or replaced; what it replaces is retired."""
        replaced = [self.commits[commit.key]] if commit.key in self.commits else []
        return self._becoming({**self.commits, commit.key: commit}, replaced, generation)

    def removing(self, keys: Collection[str], generation: int) -> "Manifest":
        """The manifest without some commits; their files are retired."""
        removed = [commit for key, commit in self.commits.items() if key in keys]
        return self._becoming({k: e for k, e in self.commits.items() if k not in keys}, removed, generation)

    def _becoming(self, commits: dict[str, Commit], replaced: Iterable[Commit], generation: int) -> "Manifest":
        changed = replace(self, commits=commits, generation=generation)
        live = changed.live_paths()
        gone = {file.path for commit in replaced for file in commit.all_files} - live
        kept = tuple(item for item in self.retired if item.path not in live)
        return replace(changed, retired=kept + tuple(Retired(path, generation) for path in sorted(gone)))


def load(root: Path) -> Manifest:
    """Read a lake's manifest.

    Raises:
        LakeMissingError: no manifest there.
        LakeVersionError: tables of another schema version.
        LakeError: not a manifest of ours.
    """
    document = read_document(root)
    version = document["schema_version"]
    if version != SCHEMA_VERSION:
        raise LakeVersionError(
            f"{root}: the lake has tables of schema version {version}, this tracklake writes and reads version "
            f"{SCHEMA_VERSION}. Rebuild it from the raw files: {_rebuilding(root, document)}."
        )
    try:
        return _parse(document)
    except (ValueError, KeyError, TypeError, AttributeError) as broken:
        raise not_ours(root / MANIFEST, broken) from broken


def read_document(root: Path) -> dict[str, Any]:
    """A lake's manifest of any schema version; only `schema_version` is sure to be in it.

    Raises:
        LakeMissingError: no manifest there.
        LakeError: not a manifest of ours.
    """
    path = root / MANIFEST
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise LakeMissingError(
            f"{root}: no lake here (no {MANIFEST}). Build one with `tracklake run SOURCE --lake {root}`, "
            "or name another with --lake or TRACKLAKE_LAKE."
        ) from None
    except OSError as failed:
        raise LakeError(
            f"{path}: cannot be read ({failed.strerror}). A lake's manifest is a readable file."
        ) from failed
    except UnicodeDecodeError as broken:
        raise not_ours(path, broken) from broken
    try:
        document: dict[str, Any] = json.loads(text)
        document["schema_version"]
    except (ValueError, KeyError, TypeError) as broken:
        raise not_ours(path, broken) from broken
    return document


def remembered_sources(document: dict[str, Any]) -> tuple[str, ...]:
    """The SOURCEs that a manifest of any version remembers, as far as it does."""
    found = document.get("ingested_from")
    return tuple(item for item in found if isinstance(item, str)) if isinstance(found, list) else ()


def _rebuilding(root: Path, document: dict[str, Any]) -> str:
    """The commands that make a lake anew of the SOURCEs it was made from, the last one first."""
    there = [Path(name) for name in reversed(remembered_sources(document)) if Path(name).exists()]
    outer = [path for path in there if not any(path != other and path.is_relative_to(other) for other in there)]
    first, *others = (shlex.quote(str(path)) for path in outer or [Path("SOURCE")])
    lake = shlex.quote(str(root))
    commands = [f"`tracklake run {first} --lake {lake} --rebuild`"]
    return ", then ".join(commands + [f"`tracklake run {source} --lake {lake}`" for source in others])


def not_ours(path: Path, broken: Exception) -> LakeError:
    """The error of a manifest.json that some other program wrote, or that is damaged."""
    return LakeError(
        f"{path}: not a manifest of tracklake ({broken!r}). Restore the file, or move the folder away and rebuild."
    )


def _parse(document: dict[str, Any]) -> Manifest:
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
        ingested_from=remembered_sources(document),
    )


def store(root: Path, manifest: Manifest) -> None:
    """Replace a lake's manifest: the moment at which a commit happens."""
    document = {"schema_version": SCHEMA_VERSION, **asdict(manifest)}
    document["entries"] = document.pop("commits")
    write_file(root / MANIFEST, json.dumps(document, indent=1, sort_keys=True).encode())
