"""The folders that other programs read: one stable name per partition, a hard link to the live file in the store.

Contents lie in the store under names that carry fingerprints; the manifest, the catalog and our own readers use these.
Two names in one folder cannot be exchanged in one step, so a folder in which names carried fingerprints would show both
files or none while one replaces the other.
"""

import os
import shutil
import uuid
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path, PurePosixPath

from tracklake.pipeline.lake.checksums import hash_file
from tracklake.pipeline.lake.files import (
    STAGING,
    STORE,
    TABLE_BY_NAME,
    escape_name,
    list_files,
    remove_empty_folders,
    remove_files,
)
from tracklake.pipeline.lake.manifest import Commit, LakeFile, Manifest


def list_names(commits: Iterable[Commit]) -> dict[str, str]:
    """Return the files of tables by the names that they have in the live folders: `tracks/.../part-01.parquet`.

    The name is that of the recording, so that it stays when the recording's content is replaced. Several files of one
    recording in a folder, those of its slices, are numbered after a comma, which no recording's name has here; sorted
    by name, they are in order of time.
    """
    names: dict[str, str] = {}
    for commit in commits:
        recording = escape_name(commit.tail.partition("/")[2] or "0")
        by_folder: dict[str, list[str]] = {}
        for file in commit.all_files:
            by_folder.setdefault(file.path.rpartition("/")[0], []).append(file.path)
        for folder, paths in by_folder.items():
            top, _, shown = folder.partition("/")
            if top == STORE:
                for number, path in enumerate(paths, 1):
                    part = f",{number:04d}" if len(paths) > 1 else ""
                    names[f"{shown}/part-{recording}{part}.parquet"] = path
    return names


def show_commits(root: Path, commits: Iterable[Commit], replaced: Iterable[Commit]) -> None:
    """Let the live folders show commits and no longer what they replace; each name changes in one step."""
    names = list_names(commits)
    for name, path in names.items():
        _link(root, path, name)
    remove_files(root, (root / name for name in list_names(replaced) if name not in names))


def show_manifest(root: Path, manifest: Manifest) -> None:
    """Let the live folders show exactly what is live, whatever they show now."""
    names = list_names(manifest.commits.values())
    for name, path in names.items():
        _link(root, path, name)
    remove_files(root, (root / name for name in list_files(root, _list_folders(root)) - names.keys()))
    for top in _list_folders(root):
        remove_empty_folders(root / top)


def is_shown(root: Path, manifest: Manifest) -> bool:
    """Return whether the live folders show exactly what is live."""
    names = list_names(manifest.commits.values())
    return list_files(root, _list_folders(root)) == names.keys() and all(
        _is_same(f"{root}/{path}", f"{root}/{name}") for name, path in names.items()
    )


def find_false_copies(root: Path, manifest: Manifest) -> list[str]:
    """Return the names in the live folders that are no links to their contents, and hold other bytes."""
    checksums = manifest.checksums
    return [
        name
        for name, path in list_names(manifest.commits.values()).items()
        if (root / name).is_file()
        and not _is_linked(root / path, root / name)
        and hash_file(root / name, again=True) != checksums.get(path)
    ]


def adopt_files(root: Path, manifest: Manifest) -> Manifest:
    """Bring the files of a lake of an earlier layout, live and retired, into the store; returns the manifest for it.

    They keep their old names, too, until the live folders are brought up to date.
    """

    def adopt(path: str) -> str:
        if PurePosixPath(path).parts[0] not in TABLE_BY_NAME or not (root / path).is_file():
            return path
        if not (root / STORE / path).exists():
            _link(root, path, f"{STORE}/{path}")
        return f"{STORE}/{path}"

    def adopt_commit(commit: Commit) -> Commit:
        files = {
            table: [_add_checksum(root, replace(file, path=adopt(file.path))) for file in files]
            for table, files in commit.files.items()
        }
        return replace(commit, files=files)

    return replace(
        manifest,
        commits={key: adopt_commit(commit) for key, commit in manifest.commits.items()},
        retired=tuple(replace(item, path=adopt(item.path)) for item in manifest.retired),
    )


def _add_checksum(root: Path, file: LakeFile) -> LakeFile:
    """Return a file with its checksum, where it is a table's and has none yet."""
    path = root / file.path
    if file.sha256 is not None or not file.path.startswith(f"{STORE}/") or not path.is_file():
        return file
    return replace(file, sha256=hash_file(path))


def _list_folders(root: Path) -> set[str]:
    """Return the names of the folders of tables, of those that only another version had, too."""
    return {*TABLE_BY_NAME, *(folder.name for folder in (root / STORE).glob("*"))}


def _is_linked(stored: Path | str, shown: Path | str) -> bool:
    try:
        return os.path.samefile(stored, shown)  # noqa: PTH121  (twice as fast, and there are thousands)
    except OSError:
        return False


def _is_same(stored: Path | str, shown: Path | str) -> bool:
    """Return whether a name leads to a stored file, or to a copy of it where hard links are not to be had."""
    try:
        one, other = os.stat(stored), os.stat(shown)  # noqa: PTH116  (as above)
    except (FileNotFoundError, NotADirectoryError):
        return False
    if os.path.samestat(one, other):
        return True
    return (one.st_size, one.st_mtime_ns) == (other.st_size, other.st_mtime_ns)


def _link(root: Path, path: str, name: str) -> None:
    """Give a stored file a name, replacing what has it; readers that have the former file open keep reading it."""
    if _is_linked(f"{root}/{path}", f"{root}/{name}"):
        return
    stored, shown = root / path, root / name
    if not stored.exists():
        return  # damage to the store is the readers' matter
    aside = root / STAGING / f"{uuid.uuid4().hex}.tmp"
    aside.parent.mkdir(parents=True, exist_ok=True)
    try:
        try:
            os.link(stored, aside)
        except OSError:  # no hard links on this file system
            if _is_same(stored, shown):
                return
            shutil.copy2(stored, aside)
        shown.parent.mkdir(parents=True, exist_ok=True)
        aside.replace(shown)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
