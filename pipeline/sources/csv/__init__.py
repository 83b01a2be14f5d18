"""Delimited text to typed columns with every line accounted for, from files or archives.

This is the only entry point: other packages import the names below and none of the modules in here.
"""

from tracklake.pipeline.sources.csv.archives import ARCHIVE_SUFFIX, ArchiveContents, is_archive, list_members
from tracklake.pipeline.sources.csv.line_bytes import BOM, LINE
from tracklake.pipeline.sources.csv.raw_files import fetch_lines, hash_raw, measure_unpacked, read_head
from tracklake.pipeline.sources.csv.reader import (
    DIGITS_LOST,
    NULL_WORDS,
    REJECT_SCHEMA,
    UNNAMED,
    Chunk,
    Layout,
    map_chunks,
    read_chunks,
)
from tracklake.pipeline.sources.csv.table_files import NoTableError

__all__ = [
    "ARCHIVE_SUFFIX",
    "BOM",
    "DIGITS_LOST",
    "LINE",
    "NULL_WORDS",
    "REJECT_SCHEMA",
    "UNNAMED",
    "ArchiveContents",
    "Chunk",
    "Layout",
    "NoTableError",
    "fetch_lines",
    "hash_raw",
    "is_archive",
    "list_members",
    "map_chunks",
    "measure_unpacked",
    "read_chunks",
    "read_head",
]
