"""The files of a lake: where they stand and how they come to stand there whole or not at all."""

import json
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Mapping
from itertools import count
from pathlib import Path, PurePosixPath
from urllib.parse import quote, unquote

import polars as pl

from tracklake.pipeline.lake.errors import LakeMissingError
from tracklake.pipeline.lake.manifest import LakeFile, Manifest, load
from tracklake.schemas import TABLES, Table
from tracklake.schemas.files import sync

STAGING = ".staging"
TENSORS = "tensors"
REPORTS = "reports"
MODELS = "models"
LISTING = "files.json"
"""In every folder of `write_folder`: names and sizes of its files, so that one left half deleted is noticed."""
ZSTD_LEVEL = 1
"""Level 3 makes tables a quarter smaller and takes half as long again to write them."""

TABLE_BY_NAME = {table.name: table for table in TABLES}


def place(table: Table, values: Mapping[str, str], fingerprint: str) -> str:
    """Where a table's file stands: `tracks/dataset=highd/subset=01-upper/part-<fingerprint>.parquet`."""
    folders = [_folder(name, values[name]) for name in table.partition]
    return "/".join([table.name, *folders, f"part-{fingerprint}.parquet"])


def _folder(name: str, value: str) -> str:
    """A hive partition's folder; what would end the name or be a pattern is percent-encoded, as readers expect."""
    return f"{name}=" + re.sub(r"[^\w.\- ]", lambda found: quote(found[0], safe=""), value)


def partition_values(table: Table, path: str) -> dict[str, str]:
    """The partition columns' values that the path of a table's file states."""
    folders = dict(part.split("=", 1) for part in path.split("/") if "=" in part)
    return {name: unquote(folders[name]) for name in table.partition}


def write_table(
    root: Path, table: Table, frame: pl.DataFrame, values: Mapping[str, str], fingerprint: str, *, where: str
) -> list[LakeFile]:
    """Validate a frame and put it into the lake under its own name; nothing is visible before it is complete.

    Args:
        root: the lake.
        table: what it is.
        frame: all the table's columns, in order.
        values: of the partition columns.
        fingerprint: part of the name; a whole file that stands there already came from the same inputs and is kept,
            unless a rebuild made it void (see `free_path`).
        where: the recording, for messages.

    Returns:
        The file, or nothing for a frame of no rows (a table without files is an empty table).

    Raises:
        schemas.StructureError: the frame breaks the table's structural rules.
    """
    if frame.is_empty():
        return []
    table.validate(frame, where=where)
    path = free_path(root, place(table, values, fingerprint))
    target = root / path
    if not _holds(target, frame.height):
        stored = frame.drop(*table.partition)

        def write(aside: Path) -> None:
            stored.write_parquet(aside, compression="zstd", compression_level=ZSTD_LEVEL, row_group_size=250_000)

        _put(root, target, write)
    return [LakeFile(path=path, rows=frame.height, bytes=target.stat().st_size)]


def _holds(target: Path, rows: int) -> bool:
    """Whether a Parquet file stands there, to its end (the footer), with so many rows."""
    if not target.is_file():
        return False
    try:
        found = pl.scan_parquet(target, glob=False, hive_partitioning=False).select(pl.len()).collect().item()
    except (pl.exceptions.PolarsError, OSError):
        return False
    return bool(found == rows)


def free_path(root: Path, path: str) -> str:
    """A path for a file or folder, numbered where a void one has it: `part-1.parquet`, `part-1-2.parquet`.

    What a rebuild found is neither replaced, as readers may have it open, nor used again.
    """
    if not (root / path).exists():
        return path
    try:
        void = {item.path for item in load(root).retired if item.void}
    except LakeMissingError:
        return path
    first = PurePosixPath(path)
    for number in count(2):
        if path not in void and not any(item.startswith(f"{path}/") for item in void):
            break
        path = str(first.with_name(f"{first.stem}-{number}{first.suffix}"))
    return path


def write_folder(root: Path, path: str, write: Callable[[Path], None]) -> list[LakeFile]:
    """Put a whole folder of files into the lake at once.

    Args:
        root: the lake.
        path: of the folder, relative to the lake; carries the fingerprint. A whole folder that stands there is kept,
            unless a rebuild made it void; `free_path` tells the path of the one that is then made.
        write: fills the folder it is given.

    Returns:
        Its files, and the listing of them that is added.
    """
    target = root / free_path(root, path)
    if not _is_whole(target):

        def fill(aside: Path) -> None:
            aside.mkdir()
            write(aside)
            sizes = {file.relative_to(aside).as_posix(): file.stat().st_size for file in _files_in(aside)}
            (aside / LISTING).write_text(json.dumps(sizes, indent=1), encoding="utf-8")

        _put(root, target, fill)
    return [
        LakeFile(path=file.relative_to(root).as_posix(), rows=None, bytes=file.stat().st_size)
        for file in _files_in(target)
    ]


def _files_in(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file())


def _is_whole(folder: Path) -> bool:
    """Whether a folder holds what its listing says: deleting one is no single step, and may have been killed."""
    try:
        sizes = json.loads((folder / LISTING).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    found = {file.relative_to(folder).as_posix(): file.stat().st_size for file in _files_in(folder)}
    found.pop(LISTING)
    return bool(found == sizes)


def _put(root: Path, target: Path, write: Callable[[Path], None]) -> None:
    aside = root / STAGING / f"{uuid.uuid4().hex}.tmp"
    aside.parent.mkdir(parents=True, exist_ok=True)
    try:
        write(aside)
        for item in (*aside.rglob("*"), aside):
            sync(item)
        made = _make_folder(target.parent)
        if target.is_dir():
            # Damaged, or it would have been kept; a folder cannot be replaced by a rename.
            target.replace(aside.with_suffix(".damaged"))
        aside.replace(target)
    except BaseException:
        if aside.is_dir():
            shutil.rmtree(aside)
        else:
            aside.unlink(missing_ok=True)
        raise
    for folder in (target.parent, *(folder.parent for folder in made)):
        sync(folder)


def _make_folder(folder: Path) -> list[Path]:
    """Make a folder and those above it that are missing; returns what was made, so that no other need be synced."""
    made = [item for item in (folder, *folder.parents) if not item.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return made


def scan(root: Path, manifest: Manifest, table: Table, **values: str) -> pl.LazyFrame:
    """The live rows of a table, with its partition columns, lazily.

    Args:
        root: the lake.
        manifest: which files are live.
        table: what to read.
        values: of partition columns, to read only those files (`dataset="highd", subset="01-upper"`).

    Raises:
        ValueError: the table is not partitioned by a column of `values`.
    """
    strangers = values.keys() - set(table.partition)
    if strangers:
        raise ValueError(f"{table.name} has no partition {', '.join(sorted(strangers))}; filter its rows instead")
    # Not by the reader's hive option: that takes `name=value` folders above the lake for partitions, too.
    by_values: dict[tuple[tuple[str, str], ...], list[Path]] = {}
    for file in manifest.live(table.name):
        stated = partition_values(table, file.path)
        if values.items() <= stated.items():
            by_values.setdefault(tuple(stated.items()), []).append(root / file.path)
    if not by_values:
        return table.empty().lazy()
    return pl.concat(
        pl.scan_parquet(paths, hive_partitioning=False, glob=False)
        .with_columns(pl.lit(value).cast(table.dtypes[name]).alias(name) for name, value in stated)
        .select(*table.dtypes)
        for stated, paths in by_values.items()
    )


def is_intact(root: Path, files: Iterable[LakeFile]) -> bool:
    """Whether files stand in the lake with the size they were committed with."""
    try:
        return all((root / file.path).stat().st_size == file.bytes for file in files)
    except (FileNotFoundError, NotADirectoryError):
        return False


def remove_orphans(root: Path, manifest: Manifest) -> int:
    """Delete what killed runs left: finished files never committed, and empty folders. Returns how many files."""
    known = manifest.live_paths() | {item.path for item in manifest.retired}
    folders = [root / name for name in (*TABLE_BY_NAME, TENSORS) if (root / name).is_dir()]
    orphans = [
        file
        for folder in folders
        for file in folder.rglob("*")
        if file.is_file() and file.relative_to(root).as_posix() not in known
    ]
    remove(root, orphans)
    for folder in folders:
        for item in sorted(folder.rglob("*"), reverse=True):
            if item.is_dir() and not any(item.iterdir()):
                item.rmdir()
    return len(orphans)


def remove(root: Path, files: Iterable[Path]) -> None:
    """Delete files, and the folders that become empty by it."""
    for file in files:
        file.unlink(missing_ok=True)
        for folder in file.parents:
            if folder == root or not folder.is_dir() or any(folder.iterdir()):
                break
            folder.rmdir()
