"""The sources: one file per dataset that tracklake reads, listed here and nowhere else."""

from tracklake.pipeline.sources.highd import HIGHD
from tracklake.pipeline.sources.ngsim import NGSIM
from tracklake.pipeline.sources.source import RawFile, Source, SourceError

SOURCES: tuple[Source, ...] = (HIGHD, NGSIM)

__all__ = ["SOURCES", "RawFile", "Source", "SourceError"]
