"""Recordings of the user's own, whose columns `--columns` describes."""

from functools import partial

from tracklake.pipeline.sources.ngsim import group, spill_file, to_canonical
from tracklake.pipeline.sources.source import Source


def detect(_head: bytes, _name: str) -> None:
    """Recognise no file: only the user's mapping makes a table a recording."""


CUSTOM = Source(
    name="custom",
    title="recordings read with --columns",
    licence="that of the recordings, which tracklake does not know",
    citation="the publication of these recordings, which tracklake does not know",
    signature="any table, with --columns",
    version=2,
    detect=detect,
    group=group,
    to_canonical=partial(to_canonical, dataset="custom"),
    spill=spill_file,
)
