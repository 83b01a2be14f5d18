"""The lake: Parquet files, the manifest that says which are live, one writer, and the DuckDB catalog."""

from tracklake.pipeline.lake.errors import LakeError, LakeLockedError, LakeMissingError, LakeVersionError, QueryError
from tracklake.pipeline.lake.files import find_free_path, is_intact, scan, write_folder, write_table
from tracklake.pipeline.lake.manifest import Commit, LakeFile, Manifest, load
from tracklake.pipeline.lake.query import LakeResult, connect, query, query_errors
from tracklake.pipeline.lake.rebuild import list_ingested
from tracklake.pipeline.lake.writer import Writer, open_for_writing, refuse_foreign, refuse_if_busy

__all__ = [
    "Commit",
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
    "find_free_path",
    "is_intact",
    "list_ingested",
    "load",
    "open_for_writing",
    "query",
    "query_errors",
    "refuse_foreign",
    "refuse_if_busy",
    "scan",
    "write_folder",
    "write_table",
]
