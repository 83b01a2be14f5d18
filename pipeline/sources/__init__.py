"""The sources: one file per dataset that tracklake reads, listed here and nowhere else."""

from tracklake.pipeline.sources.custom import CUSTOM
from tracklake.pipeline.sources.exid import EXID
from tracklake.pipeline.sources.highd import HIGHD
from tracklake.pipeline.sources.i24 import I24
from tracklake.pipeline.sources.ngsim import NGSIM
from tracklake.pipeline.sources.source import RawFile, Source, SourceError
from tracklake.pipeline.sources.tgsim import TGSIM
from tracklake.pipeline.sources.urban import IND, ROUND
from tracklake.pipeline.sources.v2v.source import V2V

SOURCES: tuple[Source, ...] = (HIGHD, EXID, IND, ROUND, V2V, TGSIM, I24, NGSIM, CUSTOM)

__all__ = ["SOURCES", "RawFile", "Source", "SourceError"]
