"""TrainSet.mat, ValSet.mat and TestSet.mat as convolutional social pooling's own script writes them.

Deo and Trivedi 2018, https://github.com/nachiket92/conv-social-pooling, `preprocess_data.m`. One pass reads every
subset and selects its samples; another fills the grids and writes the samples block by block.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.export.csp.card import CARD, write_card
from tracklake.pipeline.export.csp.context import read_context
from tracklake.pipeline.export.csp.result import CspExport, CspFile, CspOptions
from tracklake.pipeline.export.folder import ExportError, refuse_taken, write_files
from tracklake.pipeline.lake import Manifest, load, scan
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import open_reader
from tracklake.pipeline.transforms.csp.grid import OverwritingGrid
from tracklake.pipeline.transforms.csp.parts import EXCLUDED, NO_LANE, number_datasets
from tracklake.pipeline.transforms.csp.subset import (
    COLUMNS,
    CspRecording,
    CspSubset,
    prepare_clean_subset,
    prepare_original_subset,
    put_on_csp_clock,
    stack_tracks,
)
from tracklake.schemas import SUBSETS, VEHICLES
from tracklake.schemas.columns import PARTS
from tracklake.schemas.extras import require_extras
from tracklake.schemas.protocols import LAST_LANES, RECORDED

FILES = ("TrainSet.mat", "ValSet.mat", "TestSet.mat")
"""Names of the files, in the order of `schemas.columns.PARTS`."""
LARGEST_BYTES = 2**31 - 1
"""Largest size of a variable in a .mat file of version 5, in bytes; SciPy writes no other version."""
TRACK_COLUMNS = ("vehicle_id", "frame", "x_m", "y_m", "lane")
"""Columns of tracks that the export reads."""
DESCRIBED = ("dataset", "subset", "recording", "origin")
"""Facts of each data set that the card lists."""
_NEEDS = "A sample needs lanes, 3.0 s of track before it and 0.2 s after; DESIGN describes what --clean drops."


def export_csp(settings: Settings, out: Path, options: CspOptions, *, force: bool = False) -> CspExport:
    """Write the three .mat files of a lake's freeway subsets and a card that describes them.

    Raises:
        MissingExtraError: SciPy is not installed.
        LakeMissingError: the lake does not exist.
        ExportError: nothing can be exported, or not to this folder, or it is too large for the format.
        StageError: --clean or `tracks_from` needs a stage that has not run.
    """
    require_extras("the export of .mat files", "matlab")
    root = settings.lake
    manifest = load(root)
    refuse_taken(out, (*FILES, CARD), force=force)
    subsets = _choose_subsets(root, manifest, options)
    export = CspExport(out, options, [CspFile(*both) for both in zip(FILES, PARTS, strict=True)])
    prepared = _prepare_all(settings, manifest, subsets, options, export)
    _count_entries(prepared, export)
    _refuse_large(export)
    if not any(file.samples for file in export.files):
        counts = [f"{reason} {count:,}" for reason, count in export.count_drops().items()]
        raise ExportError(f"{root}: no entry can be a sample ({', '.join(counts)}). {_NEEDS}")

    def write(folder: Path) -> None:
        _write_all(folder, prepared, export)
        write_card(folder / CARD, export)

    write_files(out, (*FILES, CARD), write)
    return export


def _choose_subsets(root: Path, manifest: Manifest, options: CspOptions) -> list[dict[str, Any]]:
    """Return the facts of the freeway subsets to export, with their data set ids, in that order."""
    found = scan(root, manifest, SUBSETS).filter(pl.col("freeway")).collect().to_dicts()
    chosen = [facts for facts in found if options.dataset in (None, facts["dataset"])]
    if not chosen:
        of = f" of {options.dataset}" if options.dataset else ""
        there = f"; it has recordings of {', '.join(sorted({facts['dataset'] for facts in found}))}" if found else ""
        raise ExportError(
            f"{root}: the lake holds no freeway recordings{of}{there}. The format has lanes of one direction only, "
            "so arterial streets cannot be exported; `tracklake ingest SOURCE` adds recordings."
        )
    ids = number_datasets([(facts["dataset"], facts["subset"]) for facts in chosen])
    numbered = [{**facts, "dataset_id": ids[facts["dataset"], facts["subset"]]} for facts in chosen]
    return sorted(numbered, key=lambda facts: facts["dataset_id"])


def _prepare_all(
    settings: Settings, manifest: Manifest, subsets: Sequence[dict[str, Any]], options: CspOptions, export: CspExport
) -> list[CspSubset]:
    """Read the subsets and select their samples; subsets that cannot be exported are left out and noted."""
    root, prepared = settings.lake, []
    reader = open_reader(manifest, settings)
    if settings.tracks_from != RECORDED:
        export.notes.append(f"positions are {settings.tracks_from}, not those that were recorded")
    contexts = read_context(settings, manifest, subsets, export.notes) if options.clean else None
    show = reporter()
    show.begin("read", len(subsets))
    for facts in subsets:
        values = {"dataset": facts["dataset"], "subset": facts["subset"]}
        recorded = CspRecording(
            dataset_id=facts["dataset_id"],
            first_frame=facts["first_frame"],
            frame_rate_hz=facts["frame_rate_hz"],
            last_lane=LAST_LANES.get(facts["site"]),
            by_frame=_find_row_order(manifest, facts, export) == "frame",
        )
        clock = put_on_csp_clock(reader.open_subset(**values).read_tracks(settings, *TRACK_COLUMNS), recorded)
        context = None if contexts is None else contexts[facts["dataset"], facts["subset"]]
        reason = (
            NO_LANE if clock["lane"].null_count() else EXCLUDED if contexts is not None and context is None else None
        )
        if reason is not None:
            export.left_out[reason] = export.left_out.get(reason, 0) + clock.height
            why = "entries without a lane" if reason == NO_LANE else "excluded by validation"
            export.notes.append(f"{facts['subset']}: left out ({why}: {clock.height:,} entries)")
        else:
            export.datasets.append({"id": facts["dataset_id"], **{name: facts[name] for name in DESCRIBED}})
            if context is not None:
                subset = prepare_clean_subset(clock, context, recorded, full_future=options.full_future)
            else:
                vehicles = scan(root, manifest, VEHICLES, **values).collect()
                subset = prepare_original_subset(clock, vehicles, recorded, full_future=options.full_future)
            prepared.append(subset)
        show.advance("read", facts["subset"])
    return prepared


def _find_row_order(manifest: Manifest, facts: dict[str, Any], export: CspExport) -> str:
    """Find the order of rows in a recording's files, which is that of the script's samples; note an unknown one."""
    commit = manifest.commits.get(f"ingest/{facts['dataset']}/{facts['recording']}")
    order = str(commit.info.get("row_order", "vehicle")) if commit is not None else "vehicle"
    if order == "other" and not export.options.clean:
        export.notes.append(
            f"{facts['subset']}: its files are sorted neither by vehicle nor by frame; samples are sorted by vehicle"
        )
    return order


def _count_entries(prepared: Sequence[CspSubset], export: CspExport) -> None:
    """Count samples, tracks and dropped entries of each file before anything is written."""
    for subset in prepared:
        for reason, count in subset.left_out.items():
            export.left_out[reason] = export.left_out.get(reason, 0) + count
        for part, file in enumerate(export.files):
            samples = subset.find_samples(part)
            track_id = subset.entries.track_id[subset.part == part]
            file.samples += samples.size
            file.sampled_tracks += np.unique(subset.entries.track_id[samples]).size
            file.tracks += np.unique(track_id).size
            file.entries += track_id.size
            for reason, counts in subset.dropped.items():
                if counts[part]:
                    file.dropped[reason] = file.dropped.get(reason, 0) + counts[part]
    export.notes += [f"{file.name}: no samples" for file in export.files if not file.samples]


def _refuse_large(export: CspExport) -> None:
    for file in export.files:
        size = file.samples * COLUMNS * np.dtype(np.float32).itemsize
        if size > LARGEST_BYTES:
            raise ExportError(
                f"{file.name}: `traj` of {file.samples:,} samples takes {size / 2**30:.1f} GiB; a .mat file of version "
                "5 holds up to 2 GiB per variable. Nothing was written. Export one data set at a time (--dataset), "
                "fewer recordings, or only samples with a full future (--full-future)."
            )


def _write_all(folder: Path, prepared: Sequence[CspSubset], export: CspExport) -> None:
    from scipy.io import savemat

    show = reporter()
    show.begin("write", len(prepared))
    samples = [np.empty((file.samples, COLUMNS), np.float32, order="F") for file in export.files]
    filled = [0] * len(samples)
    for subset, facts in zip(prepared, export.datasets, strict=True):
        grid = subset.open_grid()
        for part, traj in enumerate(samples):
            for block in subset.assemble_samples(subset.find_samples(part), grid):
                end = filled[part] + block.shape[1]
                traj[filled[part] : end] = block.T
                filled[part] = end
        if isinstance(grid, OverwritingGrid):
            export.overwritten += grid.overwritten
        else:
            export.collisions += grid.collisions
            export.crowded_out += grid.crowded_out
        show.advance("write", facts["subset"])
    for part, file in enumerate(export.files):
        # Popped from the list, so that a file's samples are freed once they are written.
        savemat(folder / file.name, {"traj": samples.pop(0), "tracks": _collect_tracks(prepared, part)})


def _collect_tracks(prepared: Sequence[CspSubset], part: int) -> NDArray[np.object_]:
    """Collect `tracks` of a part: (3, T) singles by data set and vehicle id; cells without a track are empty.

    As in the script, the rows end with the last data set, and the columns with the highest id, that has a track.
    """
    present = [subset for subset in prepared if (subset.part == part).any()]
    stacked = [(subset.dataset_id - 1, *stack_tracks(subset, part)) for subset in present]
    rows = max((row + 1 for row, *_ in stacked), default=0)
    cells = np.empty((rows, max((int(ids[-1]) for _, ids, _, _ in stacked), default=0)), object)
    cells.fill(np.zeros((0, 0)))
    for row, ids, lengths, values in stacked:
        for vehicle, track in zip(ids.tolist(), np.split(values, np.cumsum(lengths)[:-1]), strict=True):
            cells[row, vehicle - 1] = track.T
    return cells
