"""TrainSet.mat, ValSet.mat and TestSet.mat as convolutional social pooling's own script writes them.

Deo and Trivedi 2018, https://github.com/nachiket92/conv-social-pooling, `preprocess_data.m`. One pass reads every
subset and decides what is a sample; another fills the grids and writes, a block of samples at a time.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tracklake.pipeline.export.csp.card import CARD, write_card
from tracklake.pipeline.export.csp.context import read_context
from tracklake.pipeline.export.folder import ExportError, refuse_taken, write_files
from tracklake.pipeline.lake import Manifest, load, scan
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.transforms.csp.grid import OverwritingGrid
from tracklake.pipeline.transforms.csp.parts import EXCLUDED, NO_LANE, REASONS, count_rows, number_datasets
from tracklake.pipeline.transforms.csp.subset import (
    COLUMNS,
    CspSubset,
    Recorded,
    prepare_as_original,
    prepare_clean,
    put_on_csp_clock,
    stack_tracks,
)
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES
from tracklake.schemas.columns import PARTS

FILES = ("TrainSet.mat", "ValSet.mat", "TestSet.mat")
"""In the order of `schemas.columns.PARTS`."""
LARGEST_BYTES = 2**31 - 1
"""Of one variable in a .mat file of version 5, which is what SciPy reads."""
MERGED_RAMPS = {"us-101": 6}
"""By site: the lane that lanes with higher numbers count as."""
_NEEDS = "A sample needs lanes, 3.0 s of track before it and 0.2 s after; DESIGN describes what --clean drops."
NEEDED = ("vehicle_id", "frame", "x_m", "y_m", "lane")


@dataclass(frozen=True)
class CspOptions:
    """What is asked for beside the original.

    Args:
        clean: no late starts, gaps, overwritten neighbors and leaks.
        full_future: only samples with 5 s of future.
        dataset: only this one; None: all.
    """

    clean: bool = False
    full_future: bool = False
    dataset: str | None = None


@dataclass
class CspFile:
    """What one file holds, and how many entries of its tracks are no samples, by reason."""

    name: str
    part: str
    samples: int = 0
    sampled_tracks: int = 0
    tracks: int = 0
    entries: int = 0
    dropped: dict[str, int] = field(default_factory=dict)


@dataclass
class CspExport:
    """What was written.

    Args:
        out: the folder.
        options: as asked for.
        files: one per part.
        rows: of `tracks`.
        datasets: by row of `tracks`: id, dataset, subset, recording; rows of others are empty.
        left_out: by reason, entries that stand in no file.
        overwritten: neighbors lost because a later row had the same cell (not with --clean).
        collisions: neighbors that found their cell taken (with --clean; all but `crowded_out` stand in another).
        crowded_out: of them, those for whom there was none.
        notes: for the user.
    """

    out: Path
    options: CspOptions
    files: list[CspFile]
    rows: int
    datasets: list[dict[str, Any]] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)
    overwritten: int = 0
    collisions: int = 0
    crowded_out: int = 0
    notes: list[str] = field(default_factory=list)

    def count_drops(self) -> dict[str, int]:
        """By reason, entries that are no samples, in all files and in none."""
        counts = dict(self.left_out)
        for file in self.files:
            for reason, count in file.dropped.items():
                counts[reason] = counts.get(reason, 0) + count
        return {reason: counts[reason] for reason in REASONS if reason in counts}

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


def export_csp(settings: Settings, out: Path, options: CspOptions, *, force: bool = False) -> CspExport:
    """Write the three .mat files of a lake's freeway subsets, and a card that says what they are.

    Args:
        settings: the lake, and what --clean needs (protocol, split).
        out: the folder.
        options: what is asked for beside the original.
        force: replace files of these names.

    Raises:
        LakeMissingError: no lake.
        ExportError: nothing to export, or no place to put it; sizes beyond the format's.
        StageError: --clean needs a stage that has not run.
    """
    root = settings.lake
    manifest = load(root)
    refuse_taken(out, (*FILES, CARD), force=force, lake=root)
    subsets = _choose(root, manifest, options)
    rows = count_rows({(facts["dataset"], facts["subset"]): facts["dataset_id"] for facts in subsets})
    export = CspExport(out, options, [CspFile(*both) for both in zip(FILES, PARTS, strict=True)], rows)
    prepared = _prepare_all(settings, manifest, subsets, options, export)
    _count(prepared, export)
    _refuse_large(export)
    if not any(file.samples for file in export.files):
        counts = [f"{reason} {count:,}" for reason, count in export.count_drops().items()]
        raise ExportError(f"{root}: no entry can be a sample ({', '.join(counts)}). {_NEEDS}")

    def write(folder: Path) -> None:
        _write_all(folder, prepared, export)
        write_card(folder / CARD, export)

    write_files(out, (*FILES, CARD), write)
    return export


def _choose(root: Path, manifest: Manifest, options: CspOptions) -> list[dict[str, Any]]:
    """Facts of the freeway subsets asked for, with their data set ids, in that order."""
    found = scan(root, manifest, SUBSETS).filter(pl.col("freeway")).collect().to_dicts()
    asked = [facts for facts in found if options.dataset in (None, facts["dataset"])]
    if not asked:
        of = f" of {options.dataset}" if options.dataset else ""
        there = f"; it has recordings of {', '.join(sorted({facts['dataset'] for facts in found}))}" if found else ""
        raise ExportError(
            f"{root}: the lake holds no freeway recordings{of}{there}. The format knows lanes of one direction only, "
            "so arterial streets cannot be exported; `tracklake ingest SOURCE` adds recordings."
        )
    ids = number_datasets([(facts["dataset"], facts["subset"]) for facts in asked])
    numbered = [{**facts, "dataset_id": ids[facts["dataset"], facts["subset"]]} for facts in asked]
    return sorted(numbered, key=lambda facts: facts["dataset_id"])


def _prepare_all(
    settings: Settings, manifest: Manifest, subsets: Sequence[dict[str, Any]], options: CspOptions, export: CspExport
) -> list[CspSubset]:
    """Read the subsets and decide what is a sample; those that cannot be exported are left out and named."""
    root, prepared = settings.lake, []
    contexts = read_context(settings, manifest, subsets, export.notes) if options.clean else None
    show = reporter()
    show.begin("read", len(subsets))
    for facts in subsets:
        values = {"dataset": facts["dataset"], "subset": facts["subset"]}
        recorded = Recorded(
            dataset_id=facts["dataset_id"],
            first_frame=facts["first_frame"],
            frame_rate_hz=facts["frame_rate_hz"],
            last_lane=MERGED_RAMPS.get(facts["site"]),
        )
        clock = put_on_csp_clock(scan(root, manifest, TRACKS, **values).select(NEEDED).collect(), recorded)
        context = None if contexts is None else contexts[facts["dataset"], facts["subset"]]
        reason = (
            NO_LANE if clock["lane"].null_count() else EXCLUDED if contexts is not None and context is None else None
        )
        if reason is not None:
            export.left_out[reason] = export.left_out.get(reason, 0) + clock.height
            why = "entries without a lane" if reason == NO_LANE else "excluded by validation"
            export.notes.append(f"{facts['subset']}: left out ({why}: {clock.height:,} entries)")
        else:
            export.datasets.append({"id": facts["dataset_id"], **values, "recording": facts["recording"]})
            if context is not None:
                subset = prepare_clean(clock, context, recorded, full_future=options.full_future)
            else:
                vehicles = scan(root, manifest, VEHICLES, **values).collect()
                subset = prepare_as_original(clock, vehicles, recorded, full_future=options.full_future)
            prepared.append(subset)
        show.advance("read", facts["subset"])
    return prepared


def _count(prepared: Sequence[CspSubset], export: CspExport) -> None:
    """Fill in what is known before anything is written."""
    for subset in prepared:
        for reason, count in subset.left_out.items():
            export.left_out[reason] = export.left_out.get(reason, 0) + count
        for place, file in enumerate(export.files):
            samples = subset.samples_of(place)
            mine = subset.entries.track_id[subset.part == place]
            file.samples += samples.size
            file.sampled_tracks += np.unique(subset.entries.track_id[samples]).size
            file.tracks += np.unique(mine).size
            file.entries += mine.size
            for reason, counts in subset.dropped.items():
                if counts[place]:
                    file.dropped[reason] = file.dropped.get(reason, 0) + counts[place]
    export.notes += [f"{file.name}: no samples" for file in export.files if not file.samples]


def _refuse_large(export: CspExport) -> None:
    for file in export.files:
        size = file.samples * COLUMNS * np.dtype(np.float32).itemsize
        if size > LARGEST_BYTES:
            raise ExportError(
                f"{file.name}: `traj` of {file.samples:,} samples takes {size / 2**30:.1f} GiB; a .mat file of version "
                "5 holds up to 2 GiB a variable. Nothing was written. Export one data set at a time (--dataset), fewer "
                "recordings, or only samples with a full future (--full-future)."
            )


def _write_all(folder: Path, prepared: Sequence[CspSubset], export: CspExport) -> None:
    from scipy.io import savemat

    show = reporter()
    show.begin("write", len(prepared))
    samples = [np.empty((file.samples, COLUMNS), np.float32, order="F") for file in export.files]
    filled = [0] * len(samples)
    for subset, facts in zip(prepared, export.datasets, strict=True):
        grid = subset.open_grid()
        for place, traj in enumerate(samples):
            for block in subset.assemble(subset.samples_of(place), grid):
                end = filled[place] + block.shape[1]
                traj[filled[place] : end] = block.T
                filled[place] = end
        if isinstance(grid, OverwritingGrid):
            export.overwritten += grid.overwritten
        else:
            export.collisions += grid.collisions
            export.crowded_out += grid.crowded_out
        show.advance("write", facts["subset"])
    for place, file in enumerate(export.files):
        # Out of the list, so that no file's samples are kept longer than it takes to write them.
        savemat(folder / file.name, {"traj": samples.pop(0), "tracks": _collect_tracks(prepared, place, export.rows)})


def _collect_tracks(prepared: Sequence[CspSubset], place: int, rows: int) -> NDArray[np.object_]:
    """`tracks` of a part: (3, T) singles by data set and vehicle, as wide as the highest id; others are empty."""
    mine = [subset for subset in prepared if (subset.part == place).any()]
    stacked = [(subset.dataset_id - 1, *stack_tracks(subset, place)) for subset in mine]
    cells = np.empty((rows, max((int(ids[-1]) for _, ids, _, _ in stacked), default=0)), object)
    cells.fill(np.zeros((0, 0)))
    for row, ids, lengths, values in stacked:
        for vehicle, track in zip(ids.tolist(), np.split(values, np.cumsum(lengths)[:-1]), strict=True):
            cells[row, vehicle - 1] = track.T
    return cells
