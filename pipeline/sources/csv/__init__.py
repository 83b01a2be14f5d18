"""Delimited text to typed columns with every line accounted for, from files or archives.

This is the only entry point: other packages import the names below and none of the modules in here.
"""

from tracklake.pipeline.sources.csv.archives import ARCHIVE_SUFFIX as ARCHIVE_SUFFIX
from tracklake.pipeline.sources.csv.archives import ArchiveContents as ArchiveContents
from tracklake.pipeline.sources.csv.archives import is_archive as is_archive
from tracklake.pipeline.sources.csv.archives import list_members as list_members
from tracklake.pipeline.sources.csv.line_bytes import BOM as BOM
from tracklake.pipeline.sources.csv.line_bytes import LINE as LINE
from tracklake.pipeline.sources.csv.line_bytes import split_lines as split_lines
from tracklake.pipeline.sources.csv.raw_files import fetch_lines as fetch_lines
from tracklake.pipeline.sources.csv.raw_files import hash_raw as hash_raw
from tracklake.pipeline.sources.csv.raw_files import measure_unpacked as measure_unpacked
from tracklake.pipeline.sources.csv.raw_files import open_raw as open_raw
from tracklake.pipeline.sources.csv.raw_files import read_block as read_block
from tracklake.pipeline.sources.csv.raw_files import read_head as read_head
from tracklake.pipeline.sources.csv.reader import DIGITS_LOST as DIGITS_LOST
from tracklake.pipeline.sources.csv.reader import NULL_WORDS as NULL_WORDS
from tracklake.pipeline.sources.csv.reader import REJECT_SCHEMA as REJECT_SCHEMA
from tracklake.pipeline.sources.csv.reader import UNNAMED as UNNAMED
from tracklake.pipeline.sources.csv.reader import Chunk as Chunk
from tracklake.pipeline.sources.csv.reader import map_chunks as map_chunks
from tracklake.pipeline.sources.csv.reader import map_lines as map_lines
from tracklake.pipeline.sources.csv.reader import read_chunks as read_chunks
from tracklake.pipeline.sources.csv.table_files import NoTableError as NoTableError
from tracklake.pipeline.sources.layout import Layout as Layout
