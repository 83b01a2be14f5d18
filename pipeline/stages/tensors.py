"""Tensors: the split's tracks, samples and neighbors as flat arrays."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.lake import Entry, Manifest, free_path, load, scan, write_folder
from tracklake.pipeline.lake.files import TENSORS
from tracklake.pipeline.lake.tensor_files import write_tensors
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import split, validate
from tracklake.pipeline.stages.stage import Job, StageError, make_entry, make_job, upstream
from tracklake.pipeline.transforms.resample import put_on_clock
from tracklake.pipeline.transforms.tensors.arrays import SubsetTensors, build_subset_tensors
from tracklake.schemas import FINDINGS, NEIGHBORS, SAMPLES, SPLIT_LEFT_OUT, SPLITS, SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.protocols import Protocol
from tracklake.schemas.tensors import INDEX_FILE

VERSION = 5

TRACK_COLUMNS = ("vehicle_id", "frame", "x_m", "y_m", "lane", "speed_mps")
SAMPLE_COLUMNS = ("protocol", "vehicle_id", "tick", "lateral_maneuver", "longitudinal_maneuver")
NEIGHBOR_COLUMNS = ("protocol", "vehicle_id", "tick", "cell", "neighbor_id")
VEHICLE_COLUMNS = ("vehicle_id", "length_m", "width_m")
FINDING_COLUMNS = ("vehicle_id", "severity", "first_frame", "last_frame")
"""Of these tables, what tensors are made of; the others may be wide."""


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job over the split and the findings; the split comes before, and validation long before it."""
    made = upstream(split.plan, root, manifest, settings)
    if not made:
        return []
    made |= upstream(validate.plan, root, manifest, settings)
    protocol = settings.get_protocol()
    made_of = {
        **made,
        "protocol": protocol.digest,
        "split_recipe": describe_recipe(settings),
        "positions": settings.tensor_positions,
    }
    return [make_job(TENSORS, version_of_stage=VERSION, made_of=made_of, inputs={"split": protocol.split})]


def build(root: Path, job: Job, settings: Settings) -> Entry:
    """Build the arrays subset by subset, in the split's order, and put the folder into the lake at once."""
    manifest, protocol, storage = load(root), settings.get_protocol(), settings.tensor_positions
    splits, left_out = read_split(root, manifest, protocol)
    included = list(_sampled_subsets(root, manifest, splits, protocol))
    if not included:
        return make_entry(job, {}, {"notes": ["no subset gives samples: no tensors"], "path": None, "samples": 0})

    def tensors_of() -> Iterator[tuple[dict[str, Any], SubsetTensors]]:
        for facts in included:
            here = (pl.col("dataset") == facts["dataset"]) & (pl.col("subset") == facts["subset"])
            vehicles = left_out.filter(here)["vehicle_id"]
            yield facts, build_one(root, manifest, facts, splits.filter(here), vehicles, protocol, storage)

    def write(folder: Path) -> None:
        recipe = {**describe_recipe(settings), "left_out_vehicles": left_out.height}
        write_tensors(folder, tensors_of(), splits, protocol, storage=storage, split_recipe=recipe)

    path = free_path(root, f"{TENSORS}/{protocol.split}/{job.fingerprint}")
    files = write_folder(root, path, write)
    index = json.loads((root / path / INDEX_FILE).read_text(encoding="utf-8"))
    info = {"path": path, "samples": index["sizes"]["S"], "samples_by_part": index["samples_by_part"]}
    return make_entry(job, {TENSORS: files}, info)


def describe_recipe(settings: Settings) -> dict[str, Any]:
    """What the tensors' split is made by: digest, and parameters by name."""
    recipe = settings.get_split_recipe()
    return {"digest": recipe.digest, "parameters": json.loads(recipe.parameters)}


def read_split(root: Path, manifest: Manifest, protocol: Protocol) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Which part each entry belongs to under the protocol's split: rows of `splits`, and of `split_left_out`."""
    named = pl.col("split") == protocol.split
    return (
        scan(root, manifest, SPLITS).filter(named).collect(),
        scan(root, manifest, SPLIT_LEFT_OUT).filter(named).collect(),
    )


def build_one(
    root: Path,
    manifest: Manifest,
    facts: dict[str, Any],
    blocks: pl.DataFrame,
    left_out: pl.Series,
    protocol: Protocol,
    storage: str,
) -> SubsetTensors:
    """Read a subset's tables and build its arrays.

    Args:
        root: the lake.
        manifest: its live files.
        facts: the subset's row of `subsets`.
        blocks: the split's rows for it.
        left_out: vehicles of it that the split leaves out of all parts but `train`.
        protocol: of the samples.
        storage: of positions.
    """
    values = {"dataset": facts["dataset"], "subset": facts["subset"]}
    where = {"first_frame": facts["first_frame"], "frame_rate_hz": facts["frame_rate_hz"]}
    tracks = scan(root, manifest, TRACKS, **values).select(TRACK_COLUMNS).collect()
    return build_subset_tensors(
        put_on_clock(tracks, rate_hz=protocol.rate_hz, **where),
        scan(root, manifest, SAMPLES, **values).select(SAMPLE_COLUMNS).collect(),
        scan(root, manifest, NEIGHBORS, **values).select(NEIGHBOR_COLUMNS).collect(),
        blocks,
        vehicles=scan(root, manifest, VEHICLES, **values).select(VEHICLE_COLUMNS).collect(),
        findings=scan(root, manifest, FINDINGS, **values).select(FINDING_COLUMNS).collect(),
        protocol=protocol,
        storage=storage,
        left_out=left_out,
        **where,
    )


def _sampled_subsets(
    root: Path, manifest: Manifest, splits: pl.DataFrame, protocol: Protocol
) -> Iterator[dict[str, Any]]:
    """Facts of the split's subsets that have samples, in the split's order."""
    subsets = scan(root, manifest, SUBSETS).collect()
    for dataset, subset in splits.select("dataset", "subset").unique(maintain_order=True).iter_rows():
        samples = scan(root, manifest, SAMPLES, dataset=dataset, subset=subset)
        if samples.filter(pl.col("protocol") == protocol.name).head(1).collect().height:
            named = (pl.col("dataset") == dataset) & (pl.col("subset") == subset)
            yield subsets.row(by_predicate=named, named=True)


def tensor_folder(root: Path, manifest: Manifest, settings: Settings) -> Path:
    """Where the live tensors stand.

    Raises:
        StageError: there are none, or they are of another protocol or split than the settings name.
    """
    entry = manifest.entries.get(TENSORS)
    if entry is None or entry.info["path"] is None:
        raise StageError(
            f"{root}: the lake has no tensors. Run `tracklake tensors`; it needs freeway recordings with lanes."
        )
    protocol = settings.get_protocol()
    if entry.built_from["protocol"] != protocol.digest:
        made = json.loads((root / str(entry.info["path"]) / INDEX_FILE).read_text(encoding="utf-8"))["protocol"]
        raise StageError(
            f"{root}: the tensors were made by another protocol than {protocol.name} ({protocol.digest}) as it is set "
            f"now: by {made['name']} ({made['digest']}). Run `tracklake run` with these settings, or set what they "
            "were made with."
        )
    recipe, found = settings.get_split_recipe(), entry.built_from.get("split_recipe", {"digest": "unknown"})
    if found["digest"] != recipe.digest:
        raise StageError(
            f"{root}: the tensors were made by another recipe of the split {recipe.name} ({found['digest']}: "
            f"{json.dumps(found.get('parameters', {}))}) than the settings now give ({recipe.digest}: "
            f"{recipe.parameters}). Run `tracklake run` with these settings, or set what they were made with."
        )
    return root / str(entry.info["path"])
