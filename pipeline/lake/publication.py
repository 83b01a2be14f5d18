"""A lake on an object store as the copy of one in a folder: published there, and fetched from there.

Contents are uploaded first, under names with their checksums. Then the root of the manifest is replaced, on condition
that no other writer has replaced it: the moment at which readers see the new state. They never see a part of it.
"""

import json
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from tracklake.pipeline.lake import object_folder
from tracklake.pipeline.lake.checksums import find_damage, verify_files
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.errors import (
    DamagedShardError,
    LakeError,
    LakeVersionError,
    MissingObjectError,
    StoreError,
)
from tracklake.pipeline.lake.files import STORE, TENSORS
from tracklake.pipeline.lake.lease import is_held
from tracklake.pipeline.lake.manifest import MANIFEST, Commit, LakeFile, Manifest, load, read_root
from tracklake.pipeline.lake.object_access import name_object
from tracklake.pipeline.lake.object_folder import claim_place, sweep_objects
from tracklake.pipeline.lake.places import LakePlace, open_store
from tracklake.pipeline.lake.store import Store
from tracklake.pipeline.lake.transfers import receive_file, seal_commit, transfer
from tracklake.pipeline.lake.writer import hold_lock, open_for_writing, refuse_foreign
from tracklake.schemas.documents import read_json
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.files import write_file
from tracklake.schemas.hashing import hash_chunks
from tracklake.schemas.text import quote_shell

SYNCED = ".synced"
"""File of a lake in a folder: checksums of both manifests when they last agreed, by address."""
FETCHING = ".fetching"
"""File of a folder into which a lake is being fetched for the first time: what else is there was put there by us."""


class Transfer(NamedTuple):
    """What was sent or received: files and their bytes, objects that were deleted, and the generation there now."""

    files: int
    bytes: int
    deleted: int
    generation: int


def publish_lake(root: Path, address: str, *, replace_other: bool = False, expected: str | None = None) -> Transfer:
    """Make the lake at an address the same as the one in a folder, in one commit.

    Args:
        root: the lake's folder.
        address: place on an object store: empty, or with an earlier state of this lake.
        replace_other: whether another lake, or a state with work that the folder lacks, is replaced as well.
        expected: checksum of the manifest's root that is to be replaced (empty: there is none); None: any.

    Raises:
        StoreError: the store cannot be used, or does not guard against two writers.
        DamagedFileError: a file in the folder is not as it was committed.
        LakeError: something else is there, or another writer changed the same meanwhile.
    """
    local = hash_root(root)  # before what it lists is read: an older one only costs a comparison next time
    manifest = load(root)
    store = open_store(address)
    claim_place(store, manifest.lake_id, replace_other=replace_other)
    log, generation = _open_log(address, replace_other=replace_other)
    if expected is not None and log.digest != expected:
        raise LakeError(
            f"{address}: another process has published meanwhile, and a rebuild would remove its results. Run the same "
            "command again."
        )
    is_same = log.manifest.lake_id == manifest.lake_id
    before = log.manifest if is_same else Manifest(manifest.lake_id, generation=generation)
    sealed = replace(manifest, commits={key: seal_commit(root, commit) for key, commit in manifest.commits.items()})
    if not (replace_other or is_synced(root, address, remote=True) or _includes(sealed, before)):
        if not _includes(before, sealed):
            raise LakeError(_describe_fork(root, address))
        raise LakeError(
            f"{address}: has results that {root} lacks; it was published from elsewhere. Get them by `tracklake fetch "
            f"{quote_shell(address)} --lake {quote_shell(root)}`, or give --replace to remove them."
        )
    # Paths of this machine stay here.
    after = replace(_mirror(before, sealed), retired=(), ingested_from=(), retention=sealed.retention)
    live = {name_object(file): file for commit in after.commits.values() for file in commit.all_files}
    there = {name_object(file) for commit in before.commits.values() for file in commit.all_files}
    sent = _upload(store, root, live, there)
    if _list_content(after) != _list_content(log.manifest):
        after = log.replace(after)
    if after.commits == sealed.commits:
        _record_agreement(root, address, local, log.digest)
    deleted = 0 if is_held(store) else sweep_objects(address)  # who holds it may have sent for days, and will sweep
    return Transfer(len(sent), sum(file.bytes for file in sent), deleted, after.generation)


def fetch_lake(address: str, root: Path) -> Transfer:
    """Make the lake in a folder the same as the one at an address.

    Args:
        address: place of a lake on an object store.
        root: folder: empty or missing, or with an earlier state of this lake.

    Raises:
        LakeMissingError: no lake at the address.
        LakeError: the folder holds something else, or results that were not published.
        DamagedFileError: an object is not what was uploaded.
    """
    remote = hash_root(address)  # before what it lists is read, as in `publish_lake`
    theirs = load(address)
    store = open_store(address)
    if not (root / FETCHING).exists():
        refuse_foreign(root)
    with hold_lock(root):
        if not (root / MANIFEST).exists():
            write_file(root / FETCHING, address.encode())
        log = CommitLog(root)
        ours = load(root) if (root / MANIFEST).exists() else Manifest(theirs.lake_id)
        if ours.lake_id != theirs.lake_id:
            raise LakeError(
                f"{root}: holds another lake than {address}. Name another folder with --lake, or delete this one."
            )
        if not (_includes(theirs, ours) or is_synced(root, address, remote=False)):
            if not _includes(ours, theirs):
                raise LakeError(_describe_fork(root, address))
            raise LakeError(
                f"{root}: has results that {address} lacks. Publish them by `tracklake publish store "
                f"{quote_shell(address)} --lake {quote_shell(root)}`, or name another folder with --lake."
            )
        received = _download(store, root, [file for commit in theirs.commits.values() for file in commit.all_files])
        after = _mirror(ours, replace(theirs, commits={key: _unseal(each) for key, each in theirs.commits.items()}))
        if after is not ours or not (root / MANIFEST).exists():
            log.replace(after)
        (root / FETCHING).unlink(missing_ok=True)
    with open_for_writing(root):
        pass  # brings the folders of the tables and the catalog up to date
    local = hash_root(root)
    if load(root).commits == after.commits:
        _record_agreement(root, address, local, remote)
    return Transfer(len(received), sum(file.bytes for file in received), 0, theirs.generation)


def _open_log(address: str, *, replace_other: bool) -> tuple[CommitLog, int]:
    """Return what is stored at an address, and its generation; what cannot be read counts as nothing if it may go."""
    try:
        log = CommitLog(address)
    except (LakeVersionError, DamagedShardError):
        if not replace_other:
            raise
        return CommitLog(address, is_rebuild=True), int(read_root(address).get("generation", 0))
    return log, log.manifest.generation


def _list_content(manifest: Manifest) -> tuple[object, ...]:
    """Return what of a manifest is published."""
    return manifest.lake_id, manifest.commits, manifest.sources, manifest.retention


def _describe_fork(root: Path, address: str) -> str:
    """Return the message where a folder and an address have results that the other lacks."""
    return (
        f"{address} and {root}: each has results that the other lacks. Fetch the former into another folder by "
        f"`tracklake fetch {quote_shell(address)} --lake OTHER`, make what is missing there by `tracklake run SOURCE "
        f"--lake OTHER`, and publish that one. {root} can be deleted then."
    )


def _unseal(commit: Commit) -> Commit:
    """Return a commit in which files that may change have no checksum, as in a folder."""

    def unseal(file: LakeFile) -> LakeFile:
        return file if file.path.startswith((f"{STORE}/", f"{TENSORS}/")) else replace(file, sha256=None)

    return replace(commit, files={table: [unseal(file) for file in files] for table, files in commit.files.items()})


def _includes(manifest: Manifest, other: Manifest) -> bool:
    """Return whether a manifest has everything that another one has, as made from the same inputs."""
    prints = {key: commit.fingerprint for key, commit in manifest.commits.items()}
    return all(prints.get(key) == commit.fingerprint for key, commit in other.commits.items())


def _mirror(before: Manifest, wanted: Manifest) -> Manifest:
    """Return a manifest with the commits and sources of another, in a new generation where something differs."""
    changed = [commit for key, commit in wanted.commits.items() if before.commits.get(key) != commit]
    gone = before.commits.keys() - wanted.commits.keys()
    if not changed and not gone and before.sources == wanted.sources:
        return before
    generation = before.generation + 1
    after = before.remove_commits(gone, generation)
    for commit in changed:
        after = after.add_commit(commit, generation)
    return replace(after, sources=wanted.sources)


def _upload(store: Store, root: Path, live: Mapping[str, LakeFile], kept: Collection[str]) -> list[LakeFile]:
    """Send the files that are not there yet, by the names of their objects, and make sure that all are there then.

    Old objects that the lake does not need now (`kept` are those it needs) are sent again: another process may be about
    to delete them.
    """

    def send(name: str) -> None:
        verify_files(root, [live[name]])
        store.upload(name, root / live[name].path)

    missing = _find_missing(store, live, kept)
    transfer(send, missing)
    if missing and (lost := _find_missing(store, live, live)):
        raise StoreError(f"{store.place}/{lost[0]}: was deleted while the lake was published. Run the command again.")
    return [live[name] for name in missing]


def _find_missing(store: Store, live: Mapping[str, LakeFile], kept: Collection[str]) -> list[str]:
    recent = datetime.now(UTC) - object_folder.GRACE / 2
    there = {item.path: item.bytes for item in store.list() if item.path in kept or item.modified >= recent}
    return [name for name, file in live.items() if there.get(name) != file.bytes]


def _download(store: Store, root: Path, live: Iterable[LakeFile]) -> list[LakeFile]:
    """Receive the files that a folder lacks, or has with other content."""
    advice = "Publish the lake again from a folder that has it whole."
    missing = [file for file in live if find_damage(root, file) is not None]
    transfer(lambda file: receive_file(store, file, root / file.path, advice), missing)
    return missing


def _record_agreement(root: Path, address: str, local: str | None, remote: str | None) -> None:
    """Record by the checksums of both roots that a folder and an address held the same.

    Without it, the next transfer compares what both hold.
    """
    recorded = {**_read_agreements(root), address: [local, remote]}
    with suppress(TracklakeError):
        write_file(root / SYNCED, json.dumps(recorded).encode())


def is_synced(root: Path, address: str, *, remote: bool) -> bool:
    """Return whether the lake at an address, or else in a folder, is as it was when both last agreed."""
    recorded = _read_agreements(root).get(address)
    return recorded is not None and recorded[remote] == hash_root(address if remote else root)


def _read_agreements(root: Path) -> dict[str, Any]:
    try:
        return dict(read_json(root / SYNCED))
    except (OSError, ValueError, TypeError):
        return {}


def hash_root(place: LakePlace) -> str | None:
    """Return the checksum of the root of a lake's manifest; None: there is no lake."""
    try:
        return hash_chunks([open_store(place).get(MANIFEST)[0]])
    except MissingObjectError:
        return None
