"""What build functions read the lake with: the tables of all recordings, or of one subset."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.lake import Manifest, scan
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import Job
from tracklake.pipeline.transforms.reconstruction.causal import filter_tracks
from tracklake.pipeline.transforms.reconstruction.clean_tracks import replace_positions
from tracklake.schemas import FINDINGS, RECONSTRUCTED, RECONSTRUCTED_FINDINGS, SUBSETS, TRACKS, VEHICLES, Table
from tracklake.schemas.protocols import RECONSTRUCTED_TRACKS, RECORDED, TracksFrom


@dataclass(frozen=True)
class LakeReader:
    """The live tables of a lake.

    Args:
        after: stages whose tables may be read; None for all.
        partition: values of the partition columns of what is read and made; none for the whole lake.
    """

    root: Path
    manifest: Manifest
    after: tuple[str, ...] | None = None
    job: Job = field(default_factory=lambda: Job("", ""))
    partition: dict[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Name of the work in messages: the subset, or the stage where it is over the whole lake."""
        return str(self.partition.get("subset", self.job.title))

    def scan(self, table: Table) -> pl.LazyFrame:
        """Return a table's rows lazily.

        Raises:
            LookupError: the stage that made the table is not declared among those that this one comes after.
        """
        if self.after is not None:
            makers = {commit.stage for commit in self.manifest.commits.values() if table.name in commit.files}
            if undeclared := sorted(makers - {*self.after}):
                raise LookupError(
                    f"{self.job.key} reads `{table.name}`, which {', '.join(undeclared)} makes; expected that stage "
                    f"among those it comes after, got {', '.join(self.after) or 'none'}"
                )
        return scan(self.root, self.manifest, table, **self.partition)

    def table(self, table: Table, *columns: str) -> pl.DataFrame:
        """Return a table's rows with some columns (all where none is named); raises as `scan` does."""
        rows = self.scan(table)
        return (rows.select(columns) if columns else rows).collect()

    def open_subset(self, dataset: str, subset: str) -> "SubsetReader":
        """Return the reader of one subset."""
        partition = {"dataset": dataset, "subset": subset}
        return SubsetReader(self.root, self.manifest, self.after, self.job, partition)


@dataclass(frozen=True)
class SubsetReader(LakeReader):
    """The live tables of one subset, with the arguments of LakeReader; made by its `open_subset`."""

    @property
    def subset(self) -> str:
        """Name of the subset."""
        return self.title

    @cached_property
    def facts(self) -> dict[str, Any]:
        """The subset's row of `subsets`, by column."""
        return self.table(SUBSETS).row(0, named=True)

    def read_tracks(self, settings: Settings, *columns: str) -> pl.DataFrame:
        """Return some columns of the subset's tracks (all where none is named), from what `tracks_from` says."""
        return self.read_tracks_from(settings.tracks_from, *columns)

    def read_tracks_from(self, tracks_from: TracksFrom, *columns: str) -> pl.DataFrame:
        """Return tracks as recorded, or with filtered or reconstructed positions; those left out are as recorded.

        Raises as `scan` does.
        """
        if tracks_from == RECORDED:
            return self.table(TRACKS, *columns)
        recorded = self.table(TRACKS)
        is_reconstructed = tracks_from == RECONSTRUCTED_TRACKS
        motion = self.table(RECONSTRUCTED) if is_reconstructed else filter_tracks(recorded, self.facts)
        tracks = replace_positions(recorded, motion, self.table(VEHICLES, "vehicle_id", "length_m"), self.facts)
        return tracks.select(columns) if columns else tracks

    def read_findings(self, settings: Settings, *columns: str) -> pl.DataFrame:
        """Return the findings on the tracks that `read_tracks` returns; on filtered ones, those on the recorded."""
        is_reconstructed = settings.tracks_from == RECONSTRUCTED_TRACKS
        return self.table(RECONSTRUCTED_FINDINGS if is_reconstructed else FINDINGS, *columns)

    @property
    def clock(self) -> dict[str, Any]:
        """First frame and frame rate (Hz), as transforms take them."""
        return {name: self.facts[name] for name in ("first_frame", "frame_rate_hz")}
