"""Manifests changed by hand: as earlier versions of tracklake, other programs and accidents leave them."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.files import remove_files
from tracklake.pipeline.lake.history import find_superseded
from tracklake.pipeline.lake.manifest import parse_manifest, read_document
from tracklake.pipeline.lake.shards import SHARDS


def read_unsharded(root: Path) -> dict[str, Any]:
    """The whole manifest as one document, the way it was stored before it had shards."""
    document = read_document(root)
    return {name: value for name, value in document.items() if name not in ("shards", "written", "commits")}


def write_unsharded(root: Path, document: dict[str, Any]) -> None:
    """Turn the lake into one that an earlier version wrote last."""
    aside = root / "manifest.new"
    aside.write_text(json.dumps(document))
    aside.replace(root / "manifest.json")
    shutil.rmtree(root / SHARDS, ignore_errors=True)


def edit_manifest(root: Path, change: Callable[[str], str]) -> None:
    """Change the text of the whole manifest, and store it as tracklake does."""
    text = change(json.dumps(read_document(root)))
    CommitLog(root).replace(parse_manifest(root, json.loads(text)))
    remove_files(root, (root / path for path in find_superseded(root)))
