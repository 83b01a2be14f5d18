"""Car following of a lake in one Parquet or CSV file, with a card."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import polars as pl
import pyarrow.parquet as pq

from tracklake.pipeline.export.car_following.rows import COLUMNS, expand_episodes
from tracklake.pipeline.export.folder import ExportError, refuse_taken, write_files
from tracklake.pipeline.export.provenance import describe_licences, describe_provenance, list_licences, read_facts
from tracklake.pipeline.lake import load, scan
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.traffic import open_scene
from tracklake.schemas import CAR_FOLLOWING, VEHICLES
from tracklake.schemas.origin import describe_synthetic

Format = Literal["parquet", "csv"]
CARD = "README.md"
"""Name of the card's file."""


@dataclass(frozen=True)
class CarFollowingExport:
    """The result of an export: numbers of episodes and entries by `dataset/subset`, and the data's licences."""

    out: Path
    file: str
    tracks_from: str
    min_s: float
    episodes: dict[str, int]
    entries: dict[str, int]
    licences: tuple[str, ...]
    synthetic: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain values."""
        return asdict(self) | {"out": str(self.out)}


def export_car_following(
    settings: Settings, out: Path, file_format: Format = "parquet", *, force: bool = False
) -> CarFollowingExport:
    """Write every entry of every episode, subset by subset, and a card; both or none.

    Raises:
        LakeMissingError: the lake does not exist.
        StageError: the stage `traffic` has not run, or not with these settings.
        ExportError: `out` cannot be written to, or there are no episodes.
    """
    manifest = load(settings.lake)
    file = f"car_following.{file_format}"
    refuse_taken(out, (file, CARD), force=force)
    Planner(settings.lake, manifest, settings).require("traffic")
    counted = (
        scan(settings.lake, manifest, CAR_FOLLOWING)
        .group_by("dataset", "subset")
        .agg(episodes=pl.len(), entries=pl.col("entries").cast(pl.Int64).sum())
        .sort("dataset", "subset")
        .collect()
    )
    if counted.is_empty():
        raise ExportError(
            f"{settings.lake}: no vehicle follows another for {settings.car_following_min_s:g} s or longer: there is "
            'nothing to export; `tracklake sql "FROM traffic_skips"` counts why'
        )
    facts = read_facts(settings.lake, manifest, counted.select("dataset", "subset"))
    names = [f"{dataset}/{subset}" for dataset, subset in counted.select("dataset", "subset").iter_rows()]
    export = CarFollowingExport(
        out=out,
        file=file,
        tracks_from=settings.tracks_from,
        min_s=settings.car_following_min_s,
        episodes=dict(zip(names, counted["episodes"], strict=True)),
        entries=dict(zip(names, counted["entries"], strict=True)),
        licences=list_licences(facts),
        synthetic=describe_synthetic(dict(zip(names, facts["origin"], strict=True))),
    )
    show = reporter()
    show.begin("write", len(names))
    reader = LakeReader(settings.lake, manifest)

    def read() -> Iterator[pl.DataFrame]:
        for dataset, subset in counted.select("dataset", "subset").iter_rows():
            yield _read_subset(reader, settings, dataset, subset)
            show.advance("write", subset)

    def write(aside: Path) -> None:
        _write_rows(aside / file, read(), file_format)
        _write_card(aside / CARD, export, facts)

    write_files(out, (file, CARD), write)
    return export


def _read_subset(reader: LakeReader, settings: Settings, dataset: str, subset: str) -> pl.DataFrame:
    own = reader.open_subset(dataset, subset)
    episodes = own.table(CAR_FOLLOWING, "vehicle_id", "first_frame", "entries")
    rows = expand_episodes(open_scene(own, settings), episodes, own.table(VEHICLES, "vehicle_id", "class", "length_m"))
    place = [pl.lit(value).cast(pl.String).alias(name) for name, value in own.partition.items()]
    return rows.select(*place, pl.all())


def _write_rows(path: Path, frames: Iterator[pl.DataFrame], file_format: Format) -> None:
    """Write frames of COLUMNS one after another into a file."""
    schema = pl.DataFrame(schema={name: dtype for name, (dtype, _) in COLUMNS.items()})
    if file_format == "csv":
        with path.open("wb") as stream:
            schema.write_csv(stream)
            for frame in frames:
                frame.write_csv(stream, include_header=False)
        return
    with pq.ParquetWriter(path, schema.to_arrow().schema, compression="zstd") as writer:
        for frame in frames:
            writer.write_table(frame.to_arrow())


def _write_card(path: Path, export: CarFollowingExport, facts: pl.DataFrame) -> None:
    lines = [
        "# Car following",
        "",
        f"Written by tracklake {version('tracklake')}: `tracklake export car-following`, {export.tracks_from} tracks.",
        "",
        *([f"**{export.synthetic}**", ""] if export.synthetic else []),
        f"{export.file} has a row per entry of every episode, by episode and frame: a vehicle follows one and the same "
        f"leader in one lane for {export.min_s:g} s or longer, without a gap in either track.",
        "",
        "| subset | episodes | entries |",
        "| --- | ---: | ---: |",
        *(f"| {name} | {count:,} | {export.entries[name]:,} |" for name, count in export.episodes.items()),
        "",
        "| column | meaning |",
        "| --- | --- |",
        *(f"| {name} | {meaning} |" for name, (_, meaning) in COLUMNS.items()),
        "",
        *describe_licences(facts, "The rows"),
        *describe_provenance(facts),
    ]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
