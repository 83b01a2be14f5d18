"""What build functions read the lake with: the tables of all recordings, or of one subset."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.lake import Commit, Manifest, scan
from tracklake.pipeline.lake.files import name_folder
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import INGEST, Job
from tracklake.pipeline.transforms.reconstruction.causal import filter_tracks
from tracklake.pipeline.transforms.reconstruction.clean_tracks import replace_positions
from tracklake.pipeline.transforms.slices import Slice, cut_frames
from tracklake.schemas import FINDINGS, RECONSTRUCTED, RECONSTRUCTED_FINDINGS, SUBSETS, TRACKS, VEHICLES, Table
from tracklake.schemas.protocols import RECONSTRUCTED_TRACKS, RECORDED, TracksFrom

CLEAN_CONTEXT_S = 3.0
"""Time before and after an entry, in s, on which its row depends besides its reconstructed position: the sides of a
filled gap of at most 2 s, and differences over 0.2 s."""
CLEAN_SHARE = 2
"""Tracks whose positions are replaced are read in slices of half as many entries: all their columns and both positions
are in memory then."""


@dataclass(frozen=True)
class LakeReader:
    """The live tables of a lake.

    Args:
        after: stages whose tables may be read; None for all.
        partition: values of the partition columns of what is read and made; none for the whole lake.
        makers: stages that make each table, where the manifest is only a part of the lake's; None: as it says.
    """

    root: Path
    manifest: Manifest
    after: tuple[str, ...] | None = None
    job: Job = field(default_factory=lambda: Job("", ""))
    partition: dict[str, Any] = field(default_factory=dict)
    makers: Mapping[str, Collection[str]] | None = None

    @property
    def title(self) -> str:
        """Name of the work in messages: the subset, or the stage where it is over the whole lake."""
        return str(self.partition.get("subset", self.job.title))

    def scan(self, table: Table) -> pl.LazyFrame:
        """Return a table's rows lazily.

        Raises:
            LookupError: the stage that made the table is not declared among those that this one comes after.
        """
        undeclared = sorted({*self._makers.get(table.name, ())} - {*(self.after or ())})
        if undeclared and self.after is not None:
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
        """Return the reader of one subset, whose manifest has what was made of its recording and of the whole lake."""
        partition = {"dataset": dataset, "subset": subset}
        manifest = self._parts.get((dataset, subset), self.manifest)
        return SubsetReader(self.root, manifest, self.after, self.job, partition, self._makers)

    @cached_property
    def _makers(self) -> Mapping[str, Collection[str]]:
        """Stages that make each table."""
        if self.makers is not None:
            return self.makers
        makers: dict[str, set[str]] = {}
        for commit in self.manifest.commits.values():
            for name in commit.files:
                makers.setdefault(name, set()).add(commit.stage)
        return makers

    @cached_property
    def _parts(self) -> Mapping[tuple[str, str], Manifest]:
        """The manifest's part for each (dataset, subset): a job over the whole lake opens thousands of subsets."""
        by_tail: dict[str, dict[str, Commit]] = {"": {}}
        for key, commit in self.manifest.commits.items():
            by_tail.setdefault(commit.tail, {})[key] = commit
        own: dict[tuple[str, str], dict[str, Commit]] = {}
        for commit in self.manifest.of_stage(INGEST):
            info = commit.info
            for name in (*(each["subset"] for each in info.get("subsets", ())), *info.get("drives", ())):
                own.setdefault((info["dataset"], name), {**by_tail[""]}).update(by_tail[commit.tail])
        return {subset: replace(self.manifest, commits=commits) for subset, commits in own.items()}


@dataclass(frozen=True)
class SubsetReader(LakeReader):
    """The live tables of one subset, with the arguments of LakeReader; made by its `open_subset`.

    Args:
        slice: frames to which `tracks` are restricted, with their context; None for all. Made by `cut`.
    """

    slice: Slice | None = None

    @property
    def subset(self) -> str:
        """Name of the subset."""
        return self.title

    @property
    def part(self) -> str:
        """Name of the slice; empty without one."""
        return "" if self.slice is None else self.slice.name

    @cached_property
    def facts(self) -> dict[str, Any]:
        """The subset's row of `subsets`, by column."""
        return self.table(SUBSETS).row(0, named=True)

    def scan(self, table: Table) -> pl.LazyFrame:
        """Return a table's rows lazily, entries of the slice alone; raises as for the whole lake."""
        rows = super().scan(table)
        if self.slice is None or table not in (TRACKS, RECONSTRUCTED):
            return rows
        return rows.filter(self.slice.is_read(pl.col("frame")))

    def table(self, table: Table, *columns: str) -> pl.DataFrame:
        """Return a table's rows, sorted by its key where they are in several files; raises as `scan` does."""
        folder = f"{name_folder(table, self.partition)}/"
        commits = self.manifest.commits.values()
        # A lake has thousands of files: to search in a path takes a twentieth of reading its partition.
        if sum(folder in file.path for commit in commits for file in commit.files.get(table.name, ())) < 2:
            return super().table(table, *columns)
        rows = self.scan(table).select(*dict.fromkeys([*(columns or table.dtypes), *table.key])).sort(table.key)
        return rows.select(columns or table.dtypes.keys()).collect()

    def is_long(self, settings: Settings) -> bool:
        """Return whether the subset has more entries than a worker holds at once."""
        return bool(self.facts["entries"] > settings.slice_entries)

    def cut(
        self, settings: Settings, context_s: float, *, tracks_from: TracksFrom = RECORDED, share: int = 1
    ) -> Iterator["SubsetReader"]:
        """Yield readers of slices with their context, in order; the subset itself where it is not long.

        A slice has the entries that a worker holds at once, divided by `share`.
        """
        if not self.is_long(settings):
            yield self
            return
        counts = self.scan(TRACKS).group_by("frame").agg(rows=pl.len()).sort("frame").collect(engine="streaming")
        context = ceil(context_s * self.facts["frame_rate_hz"])
        frames, rows = (counts[name].cast(pl.Int64).to_numpy() for name in ("frame", "rows"))
        for each in cut_frames(frames, rows, _count_at_once(settings, tracks_from, share), context):
            yield replace(self, slice=each)

    def read_whole_tracks(
        self, settings: Settings, *columns: str, tracks_from: TracksFrom = RECORDED, share: int = 1
    ) -> Iterator[pl.DataFrame]:
        """Yield columns of whole tracks in order of vehicles, with as many entries as `cut` gives a slice.

        Of filtered and reconstructed tracks, columns that depend on other vehicles (`gap_m`) are not among them.
        """
        if not self.is_long(settings):
            yield self.read_tracks_from(tracks_from, *columns)
            return
        vehicles = self.table(VEHICLES, "vehicle_id", "entries", "first_frame", "last_frame").sort("vehicle_id")
        group = pl.col("entries").cast(pl.Int64).cum_sum() // _count_at_once(settings, tracks_from, share)
        for _, some in vehicles.group_by(group, maintain_order=True):
            # Frames, too: the files of slices are sorted by these.
            is_own = pl.col("vehicle_id").is_between(some["vehicle_id"].min(), some["vehicle_id"].max())
            is_own &= pl.col("frame").is_between(some["first_frame"].min(), some["last_frame"].max())
            read = columns if tracks_from == RECORDED else tuple(TRACKS.dtypes)
            tracks = self.scan(TRACKS).filter(is_own).select(read).collect().sort("vehicle_id", "frame")
            if tracks_from == RECORDED:
                yield tracks
                continue
            if tracks_from == RECONSTRUCTED_TRACKS:
                motion = self.scan(RECONSTRUCTED).filter(is_own).collect()
            else:
                motion = filter_tracks(tracks, self.facts)
            yield self._replace_positions(tracks, motion).select(columns)

    def read_tracks(self, settings: Settings, *columns: str) -> pl.DataFrame:
        """Return some columns of the subset's tracks (all where none is named), from what `tracks_from` says."""
        return self.read_tracks_from(settings.tracks_from, *columns)

    def read_tracks_from(self, tracks_from: TracksFrom, *columns: str) -> pl.DataFrame:
        """Return tracks as recorded, or with filtered or reconstructed positions; those left out are as recorded.

        Slices have no filtered positions, which depend on all that was before. Raises as `scan` does.
        """
        if tracks_from == RECORDED:
            return self.table(TRACKS, *columns)
        is_reconstructed = tracks_from == RECONSTRUCTED_TRACKS
        wide = self
        if self.slice is not None:
            assert is_reconstructed
            more = ceil(CLEAN_CONTEXT_S * self.facts["frame_rate_hz"])
            wide = replace(self, slice=replace(self.slice, context=self.slice.context + more))
        recorded = wide.table(TRACKS)
        motion = wide.table(RECONSTRUCTED) if is_reconstructed else filter_tracks(recorded, self.facts)
        tracks = self._replace_positions(recorded, motion)
        tracks = tracks if self.slice is None else tracks.filter(self.slice.is_read(pl.col("frame")))
        return tracks.select(columns) if columns else tracks

    def _replace_positions(self, tracks: pl.DataFrame, motion: pl.DataFrame) -> pl.DataFrame:
        return replace_positions(tracks, motion, self.table(VEHICLES, "vehicle_id", "length_m"), self.facts)

    def read_findings(self, settings: Settings, *columns: str) -> pl.DataFrame:
        """Return the findings on the tracks that `read_tracks` returns; on filtered ones, those on the recorded."""
        is_reconstructed = settings.tracks_from == RECONSTRUCTED_TRACKS
        return self.table(RECONSTRUCTED_FINDINGS if is_reconstructed else FINDINGS, *columns)

    @property
    def clock(self) -> dict[str, Any]:
        """First frame and frame rate (Hz), as transforms take them."""
        return {name: self.facts[name] for name in ("first_frame", "frame_rate_hz")}


def _count_at_once(settings: Settings, tracks_from: TracksFrom, share: int) -> int:
    """Return how many entries of tracks are read at once."""
    return max(1, settings.slice_entries // (share * (1 if tracks_from == RECORDED else CLEAN_SHARE)))
