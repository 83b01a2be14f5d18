"""Tensors: the split's tracks, samples and neighbors as flat arrays."""

from pathlib import Path
from typing import Any

import polars as pl

from pipeline.lake import Entry, Manifest, load, scan, write_folder
from pipeline.lake.files import TENSORS
from pipeline.settings import Settings
from pipeline.stages import split
from pipeline.stages.base import Job, StageError, make_entry, make_job, upstream
from pipeline.tensor_files import write_tensors
from pipeline.transforms.resample import put_on_clock
from pipeline.transforms.tensors import build_subset_arrays, concatenate, describe_tensors
from schemas import NEIGHBORS, SAMPLES, SPLITS, SUBSETS, TRACKS

VERSION = 1


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job over the split; the split comes before."""
    made = upstream(split.plan, root, manifest, settings)
    if not made:
        return []
    protocol = settings.get_protocol()
    made_of = {**made, "protocol": protocol.digest}
    return [make_job(TENSORS, version_of_stage=VERSION, made_of=made_of, inputs={"split": protocol.split})]


def build(root: Path, job: Job, settings: Settings) -> Entry:
    """Build the arrays subset by subset, in the split's order, and put the folder into the lake at once."""
    manifest, protocol = load(root), settings.get_protocol()
    splits = scan(root, manifest, SPLITS).filter(pl.col("split") == protocol.split).collect()
    subsets = scan(root, manifest, SUBSETS).collect()
    arrays: list[dict[str, Any]] = []
    included: list[dict[str, Any]] = []
    for dataset, subset in splits.select("dataset", "subset").unique(maintain_order=True).iter_rows():
        values = {"dataset": dataset, "subset": subset}
        samples = scan(root, manifest, SAMPLES, **values).collect()
        if samples.is_empty():
            continue
        facts = subsets.row(by_predicate=(pl.col("dataset") == dataset) & (pl.col("subset") == subset), named=True)
        where = {"first_frame": facts["first_frame"], "frame_rate_hz": facts["frame_rate_hz"]}
        clock = put_on_clock(scan(root, manifest, TRACKS, **values).collect(), rate_hz=protocol.rate_hz, **where)
        arrays.append(
            build_subset_arrays(
                clock,
                samples,
                scan(root, manifest, NEIGHBORS, **values).collect(),
                splits.filter((pl.col("dataset") == dataset) & (pl.col("subset") == subset)),
                subset_index=len(included),
                protocol=protocol,
                **where,
            )
        )
        included.append({"dataset": dataset, "subset": subset, "frame_rate_hz": facts["frame_rate_hz"]})
    if not included:
        return make_entry(job, {}, {"notes": ["no subset gives samples: no tensors"], "path": None, "samples": 0})
    joined = concatenate(arrays)
    index = describe_tensors(joined, pl.DataFrame(included), splits, protocol)
    path = f"{TENSORS}/{protocol.split}/{job.fingerprint}"
    files = write_folder(root, path, lambda folder: write_tensors(folder, joined, index))
    info = {"path": path, "samples": index["sizes"]["S"], "samples_by_part": index["samples_by_part"]}
    return make_entry(job, {TENSORS: files}, info)


def tensor_folder(root: Path, manifest: Manifest, settings: Settings) -> Path:
    """Where the live tensors stand.

    Raises:
        StageError: there are none, or they are of another protocol than the settings name.
    """
    entry = manifest.entries.get(TENSORS)
    if entry is None or entry.info["path"] is None:
        raise StageError(
            f"{root}: the lake has no tensors. Run `tracklake tensors`; it needs freeway recordings with lanes."
        )
    protocol = settings.get_protocol()
    if entry.built_from["protocol"] != protocol.digest:
        raise StageError(
            f"{root}: the tensors were made by another protocol than {protocol.name} ({protocol.digest}) as it is set "
            "now. Run `tracklake run` with these settings, or set what they were made with."
        )
    return root / str(entry.info["path"])
