"""What build functions read the lake with: the tables of one subset, or of all."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.lake import Manifest, scan
from tracklake.pipeline.stages.stage import Job
from tracklake.schemas import SUBSETS, Table


@dataclass(frozen=True)
class LakeReader:
    """The live tables of a lake.

    Args:
        root: the lake's folder.
        manifest: live files of the lake.
        after: stages whose tables may be read; None for all.
        job: the work that the tables are read for.
    """

    root: Path
    manifest: Manifest
    after: tuple[str, ...] | None = None
    job: Job = field(default_factory=lambda: Job("", ""))

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the partition columns of tables made with this reader: none, as they are over the whole lake."""
        return {}

    @property
    def title(self) -> str:
        """Name of the work in messages."""
        return self.job.title

    def scan(self, table: Table, **values: str) -> pl.LazyFrame:
        """Return a table's rows lazily.

        Args:
            table: what to read.
            values: values of partition columns, to read only those files.

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
        return scan(self.root, self.manifest, table, **values)

    def table(self, table: Table, *columns: str, **values: str) -> pl.DataFrame:
        """Return a table's rows with some columns (all where none is named); arguments as for `scan`."""
        rows = self.scan(table, **values)
        return (rows.select(columns) if columns else rows).collect()

    def open_subset(self, dataset: str, subset: str) -> "SubsetReader":
        """Return the reader of one subset."""
        return SubsetReader(self, dataset, subset)


@dataclass(frozen=True)
class SubsetReader:
    """The live tables of one subset.

    Args:
        lake: reader of the whole lake.
        dataset: name of the dataset.
        subset: name of the subset.
    """

    lake: LakeReader
    dataset: str
    subset: str

    @property
    def partition(self) -> dict[str, Any]:
        """Values of the partition columns of the subset's tables."""
        return {"dataset": self.dataset, "subset": self.subset}

    @property
    def title(self) -> str:
        """Name of the subset in messages."""
        return self.subset

    @cached_property
    def facts(self) -> dict[str, Any]:
        """The subset's row of `subsets`, by column."""
        return self.table(SUBSETS).row(0, named=True)

    @property
    def clock(self) -> dict[str, Any]:
        """First frame and frame rate (Hz), as transforms take them."""
        return {name: self.facts[name] for name in ("first_frame", "frame_rate_hz")}

    def scan(self, table: Table) -> pl.LazyFrame:
        """Return the subset's rows of a table lazily."""
        return self.lake.scan(table, **self.partition)

    def table(self, table: Table, *columns: str) -> pl.DataFrame:
        """Return the subset's rows of a table with some columns (all where none is named)."""
        return self.lake.table(table, *columns, **self.partition)
