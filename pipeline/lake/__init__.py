"""The lake: Parquet files, the manifest that says which are live, one writer, and the DuckDB catalog."""

from tracklake.pipeline.lake.checksums import DamagedFile, find_damaged_files, verify_files
from tracklake.pipeline.lake.errors import (
    DamagedFileError,
    LakeError,
    LakeLockedError,
    LakeMissingError,
    LakeVersionError,
    QueryError,
)
from tracklake.pipeline.lake.files import find_free_path, is_intact, scan, write_folder, write_table
from tracklake.pipeline.lake.location import find_lake, refuse_lake
from tracklake.pipeline.lake.manifest import Commit, LakeFile, Manifest, load
from tracklake.pipeline.lake.query import LakeResult, connect, query, query_errors
from tracklake.pipeline.lake.rebuild import list_ingested
from tracklake.pipeline.lake.session_end import is_settled
from tracklake.pipeline.lake.writer import Writer, follow_move, open_for_writing, refuse_foreign, refuse_if_busy

__all__ = [
    "Commit",
    "DamagedFile",
    "DamagedFileError",
    "LakeError",
    "LakeFile",
    "LakeLockedError",
    "LakeMissingError",
    "LakeResult",
    "LakeVersionError",
    "Manifest",
    "QueryError",
    "Writer",
    "connect",
    "find_damaged_files",
    "find_free_path",
    "find_lake",
    "follow_move",
    "is_intact",
    "is_settled",
    "list_ingested",
    "load",
    "open_for_writing",
    "query",
    "query_errors",
    "refuse_foreign",
    "refuse_if_busy",
    "refuse_lake",
    "scan",
    "verify_files",
    "write_folder",
    "write_table",
]
