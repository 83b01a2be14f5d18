"""The datasets tracklake reads: one file each, listed here and nowhere else."""

from pipeline.sources.base import RawFile, Source, SourceError
from pipeline.sources.highd import HIGHD
from pipeline.sources.ngsim import NGSIM

SOURCES: tuple[Source, ...] = (HIGHD, NGSIM)

__all__ = ["SOURCES", "RawFile", "Source", "SourceError"]
