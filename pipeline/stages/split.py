"""Split: which subsets train and which evaluate."""

from pathlib import Path

import polars as pl

from pipeline.lake import Entry, Manifest, load, scan, write_table
from pipeline.settings import Settings
from pipeline.stages import samples
from pipeline.stages.base import Job, make_entry, make_job, upstream
from pipeline.transforms.splits import allocate_flow_balanced
from schemas import SAMPLES, SPLIT_BALANCE, SPLITS, SUBSET_STATUS, SUBSETS

VERSION = 1


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job over all freeway recordings; samples come before."""
    drawn = upstream(samples.plan, root, manifest, settings)
    if not drawn:
        return []
    return [
        make_job(
            "split",
            version_of_stage=VERSION,
            made_of={
                "samples": drawn,
                "protocol": settings.get_protocol().digest,
                "validation_part": settings.validation_part,
                "seed": settings.split_seed,
            },
            inputs={},
        )
    ]


def build(root: Path, job: Job, settings: Settings) -> Entry:
    """Allocate the subsets that are not excluded, weighted by their kept samples."""
    manifest, protocol = load(root), settings.get_protocol()
    kept = (
        scan(root, manifest, SAMPLES)
        .filter(pl.col("protocol") == protocol.name)
        .group_by("dataset", "subset")
        .agg(weight=pl.len().cast(pl.Int64))
    )
    subsets = (
        scan(root, manifest, SUBSETS)
        .filter(pl.col("freeway"))
        .join(scan(root, manifest, SUBSET_STATUS).select("dataset", "subset", "excluded"), on=["dataset", "subset"])
        .filter(~pl.col("excluded"))
        .join(kept, on=["dataset", "subset"], how="left")
        .with_columns(pl.col("weight").fill_null(0))
        .select("dataset", "subset", "site", "direction", "vehicles", "weight", "flow", "first_frame", "last_frame")
        .collect()
    )
    allocation = allocate_flow_balanced(
        subsets, split=protocol.split, validation=settings.validation_part, seed=settings.split_seed
    )
    files = {
        table.name: write_table(root, table, frame, {}, job.fingerprint, where=f"split {protocol.split}")
        for table, frame in ((SPLITS, allocation.splits), (SPLIT_BALANCE, allocation.balance))
    }
    notes = [
        f"split {protocol.split} of {dataset} is relaxed: {reason}"
        for dataset, reason in sorted(allocation.relaxations.items())
    ]
    return make_entry(job, files, {"notes": notes, "subsets": allocation.splits.height})
