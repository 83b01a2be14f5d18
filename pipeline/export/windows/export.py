"""Windows: every sample of the tensors with history, future and neighbors, in files that need no tracklake to read."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.export.folder import ExportError, refuse_taken, write_files
from tracklake.pipeline.export.provenance import list_licences, read_facts
from tracklake.pipeline.export.windows.card import write_card
from tracklake.pipeline.export.windows.files import WRITERS
from tracklake.pipeline.export.windows.result import Format, Windows, WindowsExport
from tracklake.pipeline.lake import load
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas.columns import PARTS
from tracklake.schemas.origin import describe_synthetic
from tracklake.training.data.gathers import expand_groups
from tracklake.training.data.tensor_folder import TensorFolder

CARD = "README.md"
"""Name of the card's file."""
BATCH_SAMPLES = 8192
"""Samples gathered at once, and rows of a Parquet row group."""


def export_windows(
    settings: Settings, out: Path, file_format: Format, *, absolute: bool = False, force: bool = False
) -> WindowsExport:
    """Write one file per part and a card, all of them or none; positions are relative, or absolute.

    Raises:
        StageError: the lake has no tensors of this protocol.
        ExportError: `out` cannot be written to, or the split has no samples.
    """
    manifest = load(settings.lake)
    names = (*(f"{part}.{file_format}" for part in PARTS), CARD)
    refuse_taken(out, names, force=force)
    folder = TensorFolder.open(tensor_folder(settings.lake, manifest, settings))
    counts = {part: count_part(folder, part) for part in PARTS}
    if not any(samples for samples, _ in counts.values()):
        raise ExportError(f"{folder.path}: the split `{folder.split}` has no samples to export")
    facts = read_facts(settings.lake, manifest, pl.DataFrame(folder.index["subsets"]).select("dataset", "subset"))
    export = WindowsExport(
        out=out,
        format=file_format,
        absolute=absolute,
        samples={part: samples for part, (samples, _) in counts.items()},
        neighbors={part: neighbors for part, (_, neighbors) in counts.items()},
        files=names,
        notes=list_licences(facts),
        synthetic=describe_synthetic(folder.origins),
    )
    show = reporter()
    show.begin("write", sum(-(-samples // BATCH_SAMPLES) for samples, _ in counts.values()))

    def write(aside: Path) -> None:
        for part in PARTS:
            with WRITERS[file_format](aside / f"{part}.{file_format}", folder, *counts[part]) as writer:
                for windows in read_windows(folder, part, absolute=absolute):
                    writer.add_windows(windows)
                    show.advance("write", part)
        write_card(aside / CARD, export, folder, facts)

    write_files(out, names, write)
    return export


def count_part(folder: TensorFolder, part: str) -> tuple[int, int]:
    """Count the samples and the neighbors of a part."""
    samples = folder.samples_of(part)
    return len(samples), int((folder.neighbor_offset[samples + 1] - folder.neighbor_offset[samples]).sum())


def read_windows(folder: TensorFolder, part: str, *, absolute: bool) -> Iterator[Windows]:
    """Read a part's samples in their order, BATCH_SAMPLES at a time."""
    for batch in folder.batches(part, BATCH_SAMPLES, absolute=absolute):
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
