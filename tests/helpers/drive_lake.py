"""A lake of generated drives, committed as ingestion and fusion commit them."""

from pathlib import Path

import polars as pl
from drive_tables import make_drive, make_traffic
from stage_runs import run_stage

from tracklake.pipeline.lake import Commit, open_for_writing, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import drive_score
from tracklake.pipeline.stages.stage import Stage
from tracklake.schemas import DRIVES, SURROUNDING, SURROUNDING_TRUTH


def write_drive(root: Path, name: str, vehicles: int | list[dict] = 12, *, seed: int = 0, fused: bool = True) -> None:
    """Write one drive into a lake; without fusion, `surrounding` is missing."""
    make = make_traffic if isinstance(vehicles, int) else make_drive
    surrounding, truth, drives = make(vehicles, subset=name, seed=seed, noise_m=0.1)
    drives = drives.with_columns(
        pl.lit(name).alias("recording"),
        pl.lit(0).cast(pl.Datetime("us")).alias("start_utc"),
        pl.lit([], pl.List(DRIVES.dtypes["source_files"].inner)).alias("source_files"),
        *(pl.lit(0, DRIVES.dtypes[own]).alias(own) for own in ("seconds", "stations", "messages", "scans", "images")),
    ).select(pl.col(own).cast(dtype) for own, dtype in DRIVES.dtypes.items())
    place = {"dataset": "v2v", "subset": name}

    def write(stage: str, tables: dict, info: dict) -> Commit:
        files = {
            table.name: write_table(root, table, frame, place, f"{seed:016x}", where=name)
            for table, frame in tables.items()
        }
        return Commit(f"{stage}/v2v/{name}", f"{seed:016x}", files, info=info)

    with open_for_writing(root) as writer:
        info = {"dataset": "v2v", "subsets": [], "drives": [name], "notes": []}
        writer.commit(write("ingest", {DRIVES: drives, SURROUNDING_TRUTH: truth}, info))
        if fused:
            writer.commit(write("fuse", {SURROUNDING: surrounding}, {"notes": []}))


def fuse_with(surrounding: dict[str, pl.DataFrame]) -> Stage:
    """A stage in the place of fusion, which makes these tables by drive."""
    return Stage("fuse", "x", "drive", ("ingest",), 1, lambda reader, _: {SURROUNDING: surrounding[reader.subset]})


def score_drives(root: Path, names: list[str], vehicles: int = 12) -> list[Commit]:
    """Fuse and score drives of a lake, as a run does."""
    fused = {name: make_traffic(vehicles, subset=name, noise_m=0.1)[0] for name in names}
    stages = (fuse_with(fused), drive_score.STAGE)
    run_stage(root, "fuse", Settings(lake=root), stages=stages)
    return run_stage(root, "drive_score", Settings(lake=root), stages=stages)
