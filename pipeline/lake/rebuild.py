"""The rebuild of a lake in its place: whatever its version, its files are retired, and nothing is live."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake.catalog import CATALOG
from tracklake.pipeline.lake.errors import DamagedShardError
from tracklake.pipeline.lake.files import STAGING, STORE, TABLE_BY_NAME, TENSORS
from tracklake.pipeline.lake.manifest import (
    MANIFEST,
    Manifest,
    Retired,
    make_foreign_error,
    parse_manifest,
    read_document,
    read_retention,
    read_root,
    read_sources,
)
from tracklake.schemas import SCHEMA_VERSION


def start_rebuild(root: Path) -> Manifest:
    """Return the manifest that takes a lake's place, not stored yet: its next generation, without commits, a new id.

    Readers of the old tables find their files for two more generations, like those of any replaced file. Nothing of
    them is used again, and none is overwritten: see `files.find_free_path`. Raises what `read_document` does.
    """
    try:
        document = read_document(root)
    except DamagedShardError:  # the files that it named are found in their folders
        document = read_root(root)
    if document["schema_version"] == SCHEMA_VERSION and "entries" in document:
        parse_manifest(root, document)
    elif not isinstance(document.get("lake_id"), str) and not (root / CATALOG).exists():
        # Other programs number the schemas of their manifest.json, too; theirs must not be replaced.
        raise make_foreign_error(root, ValueError(f"no lake_id in it, and no {CATALOG} beside it"))
    number = document.get("generation")
    generation = 1 + (max(number, 0) if isinstance(number, int) else 0)
    files = {*_list_committed(root, document), *_list_existing(root)}
    return Manifest(
        generation=generation,
        retired=tuple(Retired(path, generation, void=True) for path in sorted(files)),
        ingested_from=read_sources(document),
        retention=read_retention(document),
    )


def list_ingested(root: Path) -> set[str]:
    """Return `dataset/recording` of all that a lake of any version holds; nothing where there is no lake."""
    if not (root / MANIFEST).exists():
        return set()
    stages = (key.partition("/") for key in _to_mapping(read_document(root).get("entries")))
    return {of for stage, _, of in stages if stage == "ingest" and not of.partition("/")[2].startswith("lines-")}


def _list_committed(root: Path, document: dict[str, Any]) -> Iterator[str]:
    """Return the files in the lake's folders that a manifest of any version names.

    They will be deleted one day, so nothing outside may be meant, nor the manifest itself.
    """
    entries = _to_mapping(document.get("entries")).values()
    groups = [group for entry in entries for group in _to_mapping(_to_mapping(entry).get("files")).values()]
    top = root.resolve()
    for item in (item for group in [*groups, document.get("retired")] if isinstance(group, list) for item in group):
        path = _to_mapping(item).get("path")
        if not isinstance(path, str) or not (top / path).is_file():
            continue
        file = (top / path).resolve()
        if file.is_relative_to(top) and file.parent != top and STAGING not in file.parts:
            yield file.relative_to(top).as_posix()


def _list_existing(root: Path) -> Iterator[str]:
    """Return the files in the folders that are the lake's alone, named by a manifest or not.

    Those in the folders of tables are links to others, unless the lake is of an earlier layout.
    """
    names = (STORE, TENSORS) if (root / STORE).is_dir() else (*TABLE_BY_NAME, TENSORS)
    for folder in (root / name for name in names):
        yield from (file.relative_to(root).as_posix() for file in folder.rglob("*") if file.is_file())


def _to_mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
