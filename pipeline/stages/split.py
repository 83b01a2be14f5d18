"""Split: which subsets train and which evaluate."""

from pathlib import Path
from typing import Any

import polars as pl

from pipeline.lake import Entry, Manifest, load, scan, write_table
from pipeline.settings import Settings
from pipeline.stages.base import Job, StageError, make_entry, make_job, recordings
from pipeline.transforms.splits import allocate_flow_balanced
from schemas import SAMPLES, SPLIT_BALANCE, SPLITS, SUBSET_STATUS, SUBSETS

VERSION = 1


def plan(_root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job over all freeway recordings; samples come before."""
    drawn = samples_of(manifest)
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


def samples_of(manifest: Manifest) -> dict[str, str]:
    """Fingerprints of the samples of every freeway recording.

    Raises:
        StageError: samples have not been drawn from a recording as it is in the lake now.
    """
    drawn: dict[str, Any] = {}
    for recording in recordings(manifest, freeway_only=True):
        key = f"samples/{recording['dataset']}/{recording['recording']}"
        entry = manifest.entries.get(key)
        if entry is None or entry.built_from["ingest"] != recording["fingerprint"]:
            raise StageError(
                f"samples of {recording['recording']} are missing or out of date. Run `tracklake samples`."
            )
        drawn[key] = entry.fingerprint
    return drawn


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
    reasons = allocation.balance.filter(pl.col("relaxed")).select("dataset", "relaxed_reason").unique().sort("dataset")
    notes = [f"split {protocol.split} of {dataset} is relaxed: {reason}" for dataset, reason in reasons.iter_rows()]
    return make_entry(job, files, {"notes": notes, "subsets": allocation.splits.height})
