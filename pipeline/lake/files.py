"""The files of a lake: their paths, and how they are written whole or not at all."""

import json
import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote, unquote

import polars as pl

from tracklake.pipeline.lake.checksums import hash_file
from tracklake.pipeline.lake.errors import DamagedFileError, LakeMissingError
from tracklake.pipeline.lake.manifest import LakeFile, Manifest, load_recent
from tracklake.pipeline.lake.object_access import FileLocations, get_polars_options
from tracklake.pipeline.lake.origin import find_origin
from tracklake.pipeline.lake.places import LakePlace
from tracklake.pipeline.lake.transfers import READING_S, fetch_objects
from tracklake.schemas import TABLES, Table
from tracklake.schemas.documents import read_json
from tracklake.schemas.files import sync
from tracklake.schemas.text import quote_shell

STORE = ".files"
"""Folder of the lake for the content of tables, under names with fingerprints; other folders have links to it."""
STAGING = ".staging"
"""Folder of the lake for files that are not whole yet."""
TENSORS = "tensors"
"""Folder of the lake for tensors."""
REPORTS = "reports"
"""Folder of the lake for the report."""
MODELS = "models"
"""Folder of the lake for trained models."""
LISTING = "files.json"
"""File in every folder of `write_folder` with the names and sizes of its files, to notice one half deleted."""
GROUP_ROWS = 250_000
"""Rows in each row group of a Parquet file."""
ZSTD_LEVEL = 1
"""Compression level of Parquet files; level 3 writes a quarter less and takes half as long again."""
TABLE_BY_NAME = {table.name: table for table in TABLES}


def name_table_file(table: Table, values: Mapping[str, str], fingerprint: str) -> str:
    """Return the path of a table's file: `.files/tracks/dataset=highd/subset=01-upper/part-<fingerprint>.parquet`."""
    return f"{STORE}/{name_folder(table, values)}/part-{fingerprint}.parquet"


def name_folder(table: Table, values: Mapping[str, str]) -> str:
    """Return the folder of a table's files, below that of the store: `tracks/dataset=highd/subset=01-upper`."""
    return "/".join([table.name, *(f"{name}={escape_name(values[name])}" for name in table.partition)])


def escape_name(value: str) -> str:
    """Return a text as a part of a file's name; what would end the name or be a pattern is percent-encoded.

    So are dots and blanks at its end, which Windows drops.
    """
    return re.sub(r"[^\w.\- ]|[. ]$", lambda found: quote(found[0], safe="").replace(".", "%2E"), value)


def read_partition(table: Table, path: str) -> dict[str, str]:
    """Return the partition columns' values that the path of a table's file states."""
    folders = dict(part.split("=", 1) for part in path.split("/") if "=" in part)
    return {name: unquote(folders[name]) for name in table.partition}


def write_table(
    root: Path,
    table: Table,
    frame: pl.DataFrame | Iterable[pl.DataFrame],
    values: Mapping[str, str],
    fingerprint: str,
    *,
    where: str,
) -> list[LakeFile]:
    """Validate a frame and put it into the lake under its own name; nothing is visible before it is complete.

    A whole file with this fingerprint in its name came from the same inputs and is kept if it has as many rows, unless
    a rebuild made it void (see `find_free_path`). A frame of no rows gives no file: a table without files is an empty
    table. Batches that follow one another in the key's order are written one after the other, so that they need not fit
    into the memory.

    Raises:
        schemas.StructureError: the frame breaks the table's structural rules.
    """
    if not isinstance(frame, pl.DataFrame):
        return _write_batches(root, table, frame, values, fingerprint, where)
    if frame.is_empty():
        return []
    table.validate(frame, where=where)
    path = find_free_path(root, name_table_file(table, values, fingerprint))
    target = root / path
    if not _is_as_written(root, path, frame.height):
        stored = frame.drop(*table.partition)

        def write(aside: Path) -> None:
            stored.write_parquet(aside, compression="zstd", compression_level=ZSTD_LEVEL, row_group_size=GROUP_ROWS)

        _write_aside(root, target, write)
    return [_describe_file(root, target, frame.height)]


def _write_batches(
    root: Path, table: Table, batches: Iterable[pl.DataFrame], values: Mapping[str, str], fingerprint: str, where: str
) -> list[LakeFile]:
    """Validate and write batches; only the rows of one group of the file are in memory at once."""
    import pyarrow.parquet as pq

    groups = _group_rows(batches)
    first = next(groups, None)
    if first is None:
        return []
    target = root / find_free_path(root, name_table_file(table, values, fingerprint))
    rows = 0

    def write(aside: Path) -> None:
        nonlocal rows
        schema = first.drop(*table.partition).to_arrow().schema
        last = first.clear()
        # Dictionaries of measured values take most of the time and save nothing.
        options = {"compression": "zstd", "compression_level": ZSTD_LEVEL, "use_dictionary": False}
        with pq.ParquetWriter(aside, schema, **options) as writer:
            for group in chain([first], groups):
                table.validate(pl.concat([last, group]), where=where)
                last, rows = group.tail(1), rows + group.height
                writer.write_table(group.drop(*table.partition).to_arrow().cast(schema), row_group_size=GROUP_ROWS)

    _write_aside(root, target, write)
    return [_describe_file(root, target, rows)]


def _group_rows(batches: Iterable[pl.DataFrame]) -> Iterator[pl.DataFrame]:
    """Yield batches together, with at least GROUP_ROWS rows but for the last; empty ones are left out."""
    gathered: list[pl.DataFrame] = []
    rows = 0
    for batch in batches:
        gathered.append(batch)
        rows += batch.height
        if rows >= GROUP_ROWS:
            yield pl.concat(gathered)
            gathered, rows = [], 0
    if rows:
        yield pl.concat(gathered)


def _describe_file(root: Path, file: Path, rows: int | None) -> LakeFile:
    return LakeFile(file.relative_to(root).as_posix(), rows, file.stat().st_size, hash_file(file))


def _is_as_written(root: Path, path: str, rows: int) -> bool:
    """Return whether a file is there with so many rows, and with the committed bytes, where it was committed."""
    if not (root / path).is_file() or not _has_rows(root / path, rows):
        return False
    checksum = _load_checksums(root).get(path)
    return checksum is None or hash_file(root / path, again=True) == checksum


def _load_checksums(root: Path) -> dict[str, str]:
    try:
        return load_recent(root).checksums
    except LakeMissingError:
        return {}


def _has_rows(target: Path, rows: int) -> bool:
    """Return whether a Parquet file is there to its end (the footer), with so many rows."""
    try:
        found = pl.scan_parquet(target, glob=False, hive_partitioning=False).select(pl.len()).collect().item()
    except (pl.exceptions.PolarsError, OSError):
        return False
    return bool(found == rows)


def find_free_path(root: Path, path: str) -> str:
    """Return a path for a file or folder, numbered where a void one has it: `part-1.parquet`, `part-1-2.parquet`.

    What was there before a rebuild is neither replaced, as readers may have it open, nor used again.
    """
    if not (root / path).exists():
        return path
    try:
        void = load_recent(root).void_paths
    except LakeMissingError:
        return path
    first = PurePosixPath(path)
    for number in count(2):
        if path not in void:
            break
        path = str(first.with_name(f"{first.stem}-{number}{first.suffix}"))
    return path


def write_folder(root: Path, path: str, write: Callable[[Path], None]) -> list[LakeFile]:
    """Put a whole folder of files into the lake at once; returns them and the listing of them that is added.

    `path` is relative to the lake and carries the fingerprint. A whole folder there is kept, unless a rebuild made it
    void; `find_free_path` returns the path of the one that is then made.
    """
    target = root / find_free_path(root, path)
    if not _is_whole(root, target):

        def write_listed(aside: Path) -> None:
            aside.mkdir()
            write(aside)
            sizes = {file.relative_to(aside).as_posix(): file.stat().st_size for file in _list_files(aside)}
            (aside / LISTING).write_text(json.dumps(sizes, indent=1), encoding="utf-8")

        _write_aside(root, target, write_listed)
    return [_describe_file(root, file, None) for file in _list_files(target)]


def _list_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file())


def _is_whole(root: Path, folder: Path) -> bool:
    """Return whether a folder holds what its listing says, with the bytes that were committed, if they were.

    Its deletion may have been killed half way.
    """
    try:
        sizes = read_json(folder / LISTING)
    except (OSError, ValueError):
        return False
    found = {file.relative_to(folder).as_posix(): file.stat().st_size for file in _list_files(folder)}
    found.pop(LISTING)
    if found != sizes:
        return False
    committed, files = _load_checksums(root), {file.relative_to(root).as_posix(): file for file in _list_files(folder)}
    return all(hash_file(files[path], again=True) == committed[path] for path in files.keys() & committed.keys())


def _write_aside(root: Path, target: Path, write: Callable[[Path], None]) -> None:
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


def scan(place: LakePlace, manifest: Manifest, table: Table, **values: str) -> pl.LazyFrame:
    """Return the live rows of a table lazily, with its partition columns; `values` of these select the files to read.

    Raises:
        ValueError: the table is not partitioned by a column of `values`.
        DamagedFileError: a live file is missing in the lake's folder; of an object, Polars finds out on collecting.
    """
    others = values.keys() - set(table.partition)
    if others:
        raise ValueError(f"{table.name} has no partition {', '.join(sorted(others))}; filter its rows instead")
    stated = {file: read_partition(table, file.path) for file in manifest.live(table.name)}
    stated = {file: own for file, own in stated.items() if values.items() <= own.items()}
    if isinstance(place, Path) and (origin := find_origin(place)) is not None:
        fetch_objects(origin, [file for file in stated if not (place / file.path).exists()])
    locations = FileLocations(place, READING_S)
    contents = {file: locations.find(file) for file in stated}
    for content in contents.values():
        if isinstance(place, Path) and not os.path.isfile(content):  # noqa: PTH113  (thousands; a path each is slow)
            raise DamagedFileError(
                f"{content}: a live file of the lake is missing; `tracklake run SOURCE --lake {quote_shell(place)}` on "
                "the raw files makes it again"
            )
    by_values: dict[tuple[tuple[str, str], ...], list[str]] = {}
    for file, own in stated.items():
        by_values.setdefault(tuple(own.items()), []).append(contents[file])
    if not by_values:
        return table.empty().lazy()
    stored = {name: dtype for name, dtype in table.dtypes.items() if name not in table.partition}
    options: dict[str, Any] = {"schema": stored, "missing_columns": "insert"} if table.added else {}
    if isinstance(place, str):
        options |= {"storage_options": get_polars_options(place), "credential_provider": None}
    if len(by_values) > 1 and all(content.count("=") == file.path.count("=") for file, content in contents.items()):
        # One scan of thousands of partitions takes a fiftieth of the time of a scan of each.
        options["hive_schema"] = {name: table.dtypes[name] for name in table.partition}
        found = pl.scan_parquet([*contents.values()], hive_partitioning=True, glob=False, **options)
        return found.select(*table.dtypes)
    # Not by the reader's hive option, which takes `name=value` folders above the lake for partitions, too.
    return pl.concat(
        pl.scan_parquet(paths, hive_partitioning=False, glob=False, **options)
        .with_columns(pl.lit(value).cast(table.dtypes[name]).alias(name) for name, value in own)
        .select(*table.dtypes)
        for own, paths in by_values.items()
    )


def is_intact(root: Path, files: Iterable[LakeFile]) -> bool:
    """Return whether files are in the lake with the size they were committed with; or are on a store, as committed."""
    try:
        is_here = all((root / file.path).stat().st_size == file.bytes for file in files)
    except (FileNotFoundError, NotADirectoryError):
        is_here = False
    return is_here or find_origin(root) is not None


def remove_orphans(root: Path, manifest: Manifest) -> int:
    """Delete what killed runs left: finished files never committed, and empty folders. Returns how many files."""
    orphans = find_orphans(root, manifest)
    remove_files(root, orphans)
    for name in (STORE, TENSORS):
        remove_empty_folders(root / name)
    return len(orphans)


def remove_empty_folders(top: Path) -> None:
    """Delete the folders in a folder that hold no files, and itself where it holds none."""
    for folder, _, files in os.walk(top, topdown=False):
        if not files and not os.listdir(folder):  # noqa: PTH208  (for thousands of folders, a path each is slow)
            os.rmdir(folder)  # noqa: PTH106  (as above)


def find_orphans(root: Path, manifest: Manifest) -> list[Path]:
    """Return the files in the folders of contents that are neither live nor kept for readers."""
    known = manifest.live_paths() | {item.path for item in manifest.retired}
    return [root / path for path in sorted(list_files(root, (STORE, TENSORS)) - known)]


def list_files(root: Path, folders: Iterable[str]) -> set[str]:
    """Return the paths, relative to the lake, of all files in some of its folders."""
    found = (walked for name in folders for walked in os.walk(f"{root}/{name}"))
    # No `Path` for each: there are thousands. `os.sep` is a backslash on Windows, whereas the manifest has slashes.
    begin = len(str(root)) + 1
    return {f"{folder}/{file}"[begin:].replace(os.sep, "/") for folder, _, files in found for file in files}


def remove_files(root: Path, files: Iterable[Path]) -> None:
    """Delete files, and the folders that become empty."""
    for file in files:
        file.unlink(missing_ok=True)
        for folder in file.parents:
            if folder == root or not folder.is_dir() or any(folder.iterdir()):
                break
            folder.rmdir()
