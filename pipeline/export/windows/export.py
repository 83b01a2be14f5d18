"""Windows: every sample of the tensors with history, future and neighbors, in files that need no tracklake."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.export.folder import ExportError, refuse_taken, write_files
from tracklake.pipeline.lake import Manifest, load, scan
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas import SUBSETS
from tracklake.schemas.columns import PARTS
from tracklake.training.data.batches import Batch
from tracklake.training.data.namespaces import expand_groups
from tracklake.training.data.tensor_folder import TensorFolder

Format = Literal["parquet", "npz"]
CARD = "README.md"
READ_AT_ONCE = 8192
"""Samples gathered together; also the rows of a Parquet row group."""


@dataclass(frozen=True)
class WindowsExport:
    """What was written.

    Args:
        out: the folder.
        format: of the files.
        absolute: whether positions are those on the carriageway.
        samples: by part.
        neighbors: by part.
        files: names.
        notes: for the user.
    """

    out: Path
    format: Format
    absolute: bool
    samples: dict[str, int]
    neighbors: dict[str, int]
    files: tuple[str, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self) | {"out": str(self.out)}


@dataclass(frozen=True)
class Windows:
    """Samples as exported: a batch, and what names its samples and neighbors.

    Args:
        batch: B samples, K neighbors.
        subset: (B,) position in the index's `subsets`.
        vehicle_id: (B,)
        tick: (B,) of the sample.
        lane: (B,) at the tick; 0 = unknown.
        neighbor_id: (K,)
    """

    batch: Batch
    subset: npt.NDArray[np.int32]
    vehicle_id: npt.NDArray[np.int32]
    tick: npt.NDArray[np.int32]
    lane: npt.NDArray[np.int16]
    neighbor_id: npt.NDArray[np.int32]


def export_windows(
    settings: Settings, out: Path, file_format: Format, *, absolute: bool = False, force: bool = False
) -> WindowsExport:
    """Write one file per part and a card beside them; all of them or none.

    Args:
        settings: say which lake and protocol.
        out: the folder.
        file_format: `parquet` or `npz`.
        absolute: positions on the carriageway instead of relative to the sample's last one.
        force: replace such files in `out`.

    Raises:
        StageError: the lake has no tensors of this protocol.
        ExportError: `out` cannot be written to, or the split has no samples.
    """
    from tracklake.pipeline.export.windows.card import write_card
    from tracklake.pipeline.export.windows.files import WRITERS

    manifest = load(settings.lake)
    names = (*(f"{part}.{file_format}" for part in PARTS), CARD)
    refuse_taken(out, names, force=force, lake=settings.lake)
    folder = TensorFolder.open(tensor_folder(settings.lake, manifest, settings))
    counts = {part: count_part(folder, part) for part in PARTS}
    if not any(samples for samples, _ in counts.values()):
        raise ExportError(f"{folder.path}: the split `{folder.split}` has no samples to export")
    facts = read_facts(settings.lake, manifest, folder)
    export = WindowsExport(
        out=out,
        format=file_format,
        absolute=absolute,
        samples={part: samples for part, (samples, _) in counts.items()},
        neighbors={part: neighbors for part, (_, neighbors) in counts.items()},
        files=names,
        notes=tuple(
            f"{dataset}: {licence}" for dataset, licence in dict(facts.select("dataset", "licence").iter_rows()).items()
        ),
    )
    show = reporter()
    show.begin("write", sum(-(-samples // READ_AT_ONCE) for samples, _ in counts.values()))

    def write(aside: Path) -> None:
        for part in PARTS:
            with WRITERS[file_format](aside / f"{part}.{file_format}", folder, *counts[part]) as writer:
                for windows in read_windows(folder, part, absolute=absolute):
                    writer.add(windows)
                    show.advance("write", part)
        write_card(aside / CARD, export, folder, facts)

    write_files(out, names, write)
    return export


def count_part(folder: TensorFolder, part: str) -> tuple[int, int]:
    """(samples, neighbors) of a part."""
    samples = folder.samples_of(part)
    return len(samples), int((folder.neighbor_offset[samples + 1] - folder.neighbor_offset[samples]).sum())


def read_facts(lake: Path, manifest: Manifest, folder: TensorFolder) -> pl.DataFrame:
    """Of each subset in the tensors, in their order: dataset, subset, recording, vehicles, source_files, licence."""
    from tracklake.pipeline.sources import SOURCES

    licences = {source.name: source.licence for source in SOURCES}
    named = pl.DataFrame(folder.index["subsets"]).select("dataset", "subset")
    facts = scan(lake, manifest, SUBSETS).select("dataset", "subset", "recording", "vehicles", "source_files").collect()
    return named.join(facts, on=["dataset", "subset"], how="left", maintain_order="left").with_columns(
        licence=pl.col("dataset").replace_strict(licences, default="unknown")
    )


def read_windows(folder: TensorFolder, part: str, *, absolute: bool) -> Iterator[Windows]:
    """A part's samples in their order, READ_AT_ONCE at a time."""
    for batch in folder.batches(part, READ_AT_ONCE, absolute=absolute):
        row = folder.sample_row[batch.sample]
        run = folder.runs_of(row)
        pair, _ = expand_groups(folder.neighbor_offset, batch.sample)
        yield Windows(
            batch=batch,
            subset=folder.run_subset[run],
            vehicle_id=folder.run_vehicle_id[run],
            tick=(folder.run_first_tick[run] + row - folder.run_first_row[run]).astype(np.int32),
            lane=folder.lane[row],
            neighbor_id=folder.run_vehicle_id[folder.runs_of(folder.neighbor_row[pair])],
        )
