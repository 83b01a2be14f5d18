"""The files of a lake: where they stand and how they come to stand there whole or not at all."""

import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import polars as pl

from pipeline.lake.manifest import LakeFile, Manifest, sync_folder
from schemas import TABLES, Table

STAGING = ".staging"
TENSORS = "tensors"
REPORTS = "reports"
MODELS = "models"
TABLE_BY_NAME = {table.name: table for table in TABLES}


def place(table: Table, values: Mapping[str, str], fingerprint: str) -> str:
    """Where a table's file stands: `tracks/dataset=highd/subset=01-upper/part-<fingerprint>.parquet`."""
    folders = [f"{name}={values[name]}" for name in table.partition]
    return "/".join([table.name, *folders, f"part-{fingerprint}.parquet"])


def write_table(
    root: Path, table: Table, frame: pl.DataFrame, values: Mapping[str, str], fingerprint: str, *, where: str
) -> list[LakeFile]:
    """Validate a frame and put it into the lake under its own name; nothing is visible before it is complete.

    Args:
        root: the lake.
        table: what it is.
        frame: all the table's columns, in order.
        values: of the partition columns.
        fingerprint: part of the name; a file that stands there already came from the same inputs and is kept.
        where: the recording, for messages.

    Returns:
        The file, or nothing for a frame of no rows (a table without files is an empty table).

    Raises:
        schemas.StructureError: the frame breaks the table's structural rules.
    """
    if frame.is_empty():
        return []
    table.validate(frame, where=where)
    path = place(table, values, fingerprint)
    target = root / path
    if not target.exists():
        stored = frame.drop(*table.partition)

        def write(aside: Path) -> None:
            stored.write_parquet(aside, compression="zstd", compression_level=3, row_group_size=250_000)

        _put(root, target, write)
    return [LakeFile(path=path, rows=frame.height, bytes=target.stat().st_size)]


def write_folder(root: Path, path: str, write: Callable[[Path], None]) -> list[LakeFile]:
    """Put a whole folder of files into the lake at once.

    Args:
        root: the lake.
        path: of the folder, relative to the lake; carries the fingerprint.
        write: fills the folder it is given.
    """
    target = root / path
    if not target.exists():

        def fill(aside: Path) -> None:
            aside.mkdir()
            write(aside)

        _put(root, target, fill)
    return [
        LakeFile(path=file.relative_to(root).as_posix(), rows=None, bytes=file.stat().st_size)
        for file in sorted(target.rglob("*"))
        if file.is_file()
    ]


def _put(root: Path, target: Path, write: Callable[[Path], None]) -> None:
    aside = root / STAGING / f"{uuid.uuid4().hex}.tmp"
    aside.parent.mkdir(parents=True, exist_ok=True)
    try:
        write(aside)
        for file in [aside] if aside.is_file() else aside.rglob("*"):
            with file.open("rb") as handle:
                os.fsync(handle.fileno())
        target.parent.mkdir(parents=True, exist_ok=True)
        aside.replace(target)
    except BaseException:
        if aside.is_dir():
            shutil.rmtree(aside)
        else:
            aside.unlink(missing_ok=True)
        raise
    sync_folder(target.parent)


def scan(root: Path, manifest: Manifest, table: Table, **values: str) -> pl.LazyFrame:
    """The live rows of a table, with its partition columns, lazily.

    Args:
        root: the lake.
        manifest: which files are live.
        table: what to read.
        values: of partition columns, to read only those files (`dataset="highd", subset="01-upper"`).
    """
    wanted = [f"{name}={value}" for name, value in values.items()]
    files = [
        root / file.path for file in manifest.live(table.name) if all(part in file.path.split("/") for part in wanted)
    ]
    if not files:
        return table.empty().lazy()
    return pl.scan_parquet(
        files,
        hive_partitioning=bool(table.partition),
        hive_schema={name: table.dtypes[name] for name in table.partition} or None,
    ).select(*table.dtypes)


def is_intact(root: Path, files: Iterable[LakeFile]) -> bool:
    """Whether files stand in the lake with the size they were committed with."""
    try:
        return all((root / file.path).stat().st_size == file.bytes for file in files)
    except FileNotFoundError:
        return False


def remove_orphans(root: Path, manifest: Manifest) -> int:
    """Delete what killed runs left: finished files that were never committed. Returns how many."""
    known = manifest.live_paths() | {item.path for item in manifest.retired}
    folders = [root / name for name in (*TABLE_BY_NAME, TENSORS) if (root / name).is_dir()]
    orphans = [
        file
        for folder in folders
        for file in folder.rglob("*")
        if file.is_file() and file.relative_to(root).as_posix() not in known
    ]
    remove(root, orphans)
    return len(orphans)


def remove(root: Path, files: Iterable[Path]) -> None:
    """Delete files, and the folders that become empty by it."""
    for file in files:
        file.unlink(missing_ok=True)
        for folder in file.parents:
            if folder == root or not folder.is_dir() or any(folder.iterdir()):
                break
            folder.rmdir()
