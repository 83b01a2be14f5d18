"""Tensors: the split's tracks, samples and neighbors as flat arrays."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.lake import Manifest, find_free_path, write_folder
from tracklake.pipeline.lake.files import TENSORS
from tracklake.pipeline.lake.scratch import open_scratch
from tracklake.pipeline.lake.tensor_files import write_tensors
from tracklake.pipeline.lake.transfers import fetch_files
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader, SubsetReader
from tracklake.pipeline.stages.split import find_training_split
from tracklake.pipeline.stages.stage import INGEST, RECONSTRUCTION, Stage, StageError, StageResult
from tracklake.pipeline.transforms.number_store import MakeStore
from tracklake.pipeline.transforms.resample import put_on_clock
from tracklake.pipeline.transforms.tensors.arrays import SubsetTensors, build_subset_tensors
from tracklake.pipeline.transforms.tensors.entries import TensorInputs
from tracklake.pipeline.transforms.tensors.parts import LongSubset, build_parts
from tracklake.schemas import NEIGHBORS, SAMPLES, SPLIT_LEFT_OUT, SPLITS, VEHICLES
from tracklake.schemas.columns import PARTS
from tracklake.schemas.protocols import LATER, Protocol
from tracklake.schemas.split_recipes import TIME_BLOCKS
from tracklake.schemas.tensors import INDEX_FILE

TRACK_COLUMNS = ("vehicle_id", "frame", "x_m", "y_m", "lane", "speed_mps")
SAMPLE_COLUMNS = ("protocol", "vehicle_id", "tick", "lateral_maneuver", "longitudinal_maneuver")
NEIGHBOR_COLUMNS = ("protocol", "vehicle_id", "tick", "cell", "neighbor_id")
VEHICLE_COLUMNS = ("vehicle_id", "length_m", "width_m")
FINDING_COLUMNS = ("vehicle_id", "severity", "first_frame", "last_frame")
"""Columns of `findings` that are read for tensors; those above are of the other tables, which may be wide."""


def build(reader: LakeReader, settings: Settings) -> StageResult:
    """Build the arrays subset by subset, in the split's order, and put the folder into the lake at once."""
    root, protocol, storage = reader.root, settings.get_protocol(), settings.tensor_positions
    split = find_training_split(reader.manifest, settings)
    splits, left_out = read_split(reader, split)
    included = list(_list_sampled_subsets(reader, splits, protocol))
    if not included:
        return StageResult(info={"path": None, "samples": 0}, notes=["no subset gives samples: no tensors"])

    drops = drops_cut_samples(settings, split)
    cut_samples = np.zeros(len(PARTS), np.int64)

    def build_one(subset: SubsetReader) -> Iterator[SubsetTensors]:
        vehicles = left_out.filter(**subset.partition)["vehicle_id"]
        blocks = splits.filter(**subset.partition)
        with open_scratch(root) as make_store:  # of one subset: that of all could fill the disk
            for tensors in build_subset(subset, blocks, vehicles, settings, make_store, drop_cut=drops):
                yield tensors
        cut_samples[:] += tensors.cut_samples

    def write(folder: Path) -> None:
        recipe = {**_describe_recipe(settings, split), "left_out_vehicles": left_out.height}
        tensors = ((subset.facts, build_one(subset)) for subset in included)
        write_tensors(folder, tensors, splits, protocol, storage=storage, split_recipe=recipe)

    path = find_free_path(root, f"{TENSORS}/{split}/{reader.job.fingerprint}")
    files = write_folder(root, path, write)
    index = json.loads((root / path / INDEX_FILE).read_text(encoding="utf-8"))
    by_part = index["samples_by_part"]
    cut = dict(zip(PARTS, cut_samples.tolist(), strict=True))
    info = {"path": path, "samples": index["sizes"]["S"], "samples_by_part": by_part, "cut_samples_by_part": cut}
    return StageResult(files={TENSORS: files}, info=info, notes=_list_cut(split, cut, by_part, drops=drops))


def drops_cut_samples(settings: Settings, split: str) -> bool:
    """Return whether samples with a neighbor that the split cuts off are left out of val and eval."""
    return settings.drop_cut_samples and split == TIME_BLOCKS


def _list_cut(split: str, cut: Mapping[str, int], by_part: Mapping[str, int], *, drops: bool) -> list[str]:
    """List a note for each part of time-blocks in which samples lost a neighbor."""
    if split != TIME_BLOCKS:
        return []
    what = "left out" if drops else "kept (drop_cut_samples = true leaves them out)"
    return [
        f"{split}: {count:,} of {by_part[part] + drops * count:,} samples of {part} have a neighbor in another block "
        f"or in no part, which they do not see: {what}"
        for part, count in cut.items()
        if count
    ]


def _describe_recipe(settings: Settings, split: str) -> dict[str, Any]:
    """Return digest and parameters, by name, of the split that the tensors are made of."""
    recipe = settings.get_split_recipe(split)
    return {"digest": recipe.digest, "parameters": json.loads(recipe.parameters)}


def read_split(reader: LakeReader, split: str) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return the rows of a split in `splits` and in `split_left_out`."""
    named = pl.col("split") == split
    return reader.scan(SPLITS).filter(named).collect(), reader.scan(SPLIT_LEFT_OUT).filter(named).collect()


def build_subset(
    reader: SubsetReader,
    blocks: pl.DataFrame,
    left_out: pl.Series,
    settings: Settings,
    make_store: MakeStore,
    *,
    drop_cut: bool,
) -> Iterator[SubsetTensors]:
    """Read a subset's tables and build its arrays, those of a long one in parts; see `build_subset_tensors`."""
    protocol = settings.get_protocol()
    inputs = TensorInputs(
        blocks,
        vehicles=reader.table(VEHICLES, *VEHICLE_COLUMNS),
        findings=reader.read_findings(settings, *FINDING_COLUMNS),
        protocol=protocol,
        storage=settings.tensor_positions,
        left_out=left_out,
        drop_cut=drop_cut,
        **reader.clock,
    )

    def read_clocks() -> Iterator[pl.DataFrame]:
        for tracks in reader.read_whole_tracks(settings, *TRACK_COLUMNS, tracks_from=settings.tracks_from):
            yield put_on_clock(tracks, rate_hz=protocol.rate_hz, **reader.clock)

    def read_samples(low: int | None, high: int | None) -> tuple[pl.DataFrame, pl.DataFrame]:
        bounds = [] if low is None else [pl.col("vehicle_id") > low]
        bounds += [] if high is None else [pl.col("vehicle_id") <= high]
        samples, neighbors = (
            reader.scan(table).filter(pl.col("protocol") == protocol.name, *bounds).select(columns).collect()
            for table, columns in ((SAMPLES, SAMPLE_COLUMNS), (NEIGHBORS, NEIGHBOR_COLUMNS))
        )
        return samples, neighbors

    if reader.is_long(settings):
        subset = LongSubset(read_clocks, read_samples, make_store, settings.slice_entries)
        yield from build_parts(subset, inputs)
        return
    (clock,) = read_clocks()
    tables = reader.table(SAMPLES, *SAMPLE_COLUMNS), reader.table(NEIGHBORS, *NEIGHBOR_COLUMNS)
    yield build_subset_tensors(clock, *tables, inputs)


def _list_sampled_subsets(reader: LakeReader, splits: pl.DataFrame, protocol: Protocol) -> Iterator[SubsetReader]:
    """Yield the split's subsets that have samples, in the split's order."""
    for dataset, subset in splits.select("dataset", "subset").unique(maintain_order=True).iter_rows():
        own = reader.open_subset(dataset, subset)
        if own.scan(SAMPLES).filter(pl.col("protocol") == protocol.name).head(1).collect().height:
            yield own


def _describe_settings(settings: Settings) -> dict[str, Any]:
    return {"protocol": settings.get_protocol().digest, "positions": settings.tensor_positions}


def _find_inputs(_root: Path, manifest: Manifest, settings: Settings) -> dict[str, dict[str, Any]]:
    """Return what follows from the split, which depends on the lake's subsets, for the one job over the whole lake."""
    split = find_training_split(manifest, settings)
    dropped = {"drop_cut_samples": True} if drops_cut_samples(settings, split) else {}
    return {"": {"split_recipe": _describe_recipe(settings, split), **dropped}}


STAGE = Stage(
    name=TENSORS,
    meaning="Write the split as flat arrays.",
    scope="lake",
    after=(INGEST, "validate", "samples", "split"),
    after_reconstruction=(RECONSTRUCTION, "revalidate"),
    settings=(_describe_settings,),
    version=7,
    build=build,
    extra_inputs=_find_inputs,
)


def tensor_folder(root: Path, manifest: Manifest, settings: Settings) -> Path:
    """Return the folder of the live tensors.

    Raises:
        StageError: there are none, or they are of another protocol or split than the settings name.
    """
    commit = manifest.commits.get(TENSORS)
    if commit is None or commit.info["path"] is None:
        raise StageError(
            f"{root}: the lake has no tensors. Run `tracklake tensors`; it needs freeway recordings with lanes."
        )
    fetch_files(root, (file for file in commit.all_files if not (root / file.path).exists()))
    protocol = settings.get_protocol()
    if commit.built_from["protocol"] != protocol.digest:
        made = json.loads((root / str(commit.info["path"]) / INDEX_FILE).read_text(encoding="utf-8"))["protocol"]
        differences = _list_differences(LATER | made, asdict(protocol)) if made["name"] == protocol.name else ""
        raise StageError(
            f"{root}: the tensors were made by another protocol than {protocol.title} as it is set "
            f"now: by {made['name']} ({made['digest']}){differences}. "
            "Run `tracklake run` with these settings, or set what they were made with."
        )
    split = find_training_split(manifest, settings)
    recipe = settings.get_split_recipe(split)
    found = commit.built_from.get("split_recipe", {"digest": "unknown"})
    if found["digest"] != recipe.digest:
        differences = _list_differences(found.get("parameters", {}), json.loads(recipe.parameters))
        raise StageError(
            f"{root}: the tensors were made by another recipe of the split {recipe.name} ({found['digest']}) than the "
            f"settings now give ({recipe.digest}){differences}. Run `tracklake run` with these settings, or set what "
            "they were made with."
        )
    if drops_cut_samples(settings, split) != commit.built_from.get("drop_cut_samples", False):
        raise StageError(f"{root}: the tensors were made with another `drop_cut_samples`. Run `tracklake tensors`.")
    return root / str(commit.info["path"])


def _list_differences(made: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """List the parameters that tensors were made with and that are set otherwise now; empty where none is known."""
    same = json.loads(json.dumps(now))  # tuples as lists, as they are stored
    changed = sorted(name for name in same.keys() & made.keys() if same[name] != made[name])
    changed += sorted((same.keys() ^ made.keys()) - {"digest"}) if made else []
    described = (f"{name} {json.dumps(made.get(name))}, now {json.dumps(same.get(name))}" for name in changed)
    return f": {'; '.join(described)}" if changed else ""
