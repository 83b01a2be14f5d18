"""The card beside exported .mat files: contents, sources and options."""

from importlib.metadata import version
from pathlib import Path

from tracklake.pipeline.export.csp.result import CspExport
from tracklake.pipeline.transforms.csp.parts import REASONS
from tracklake.schemas.references import DEO

CARD = "DATA_CARD.md"
"""Name of the card's file."""

ORIGINAL = """\
Every value is the one that the original script computes. Windows count rows, so a gap in a track stretches them. If two
vehicles share a cell, the one with the higher id fills it. The parts are cut at 0.7 and 0.8 of the highest vehicle id
of each data set, so vehicles on either side of a cut are not each other's neighbors. Ids are those of the source's
files. Subsets that validation excludes are included.
"""
CLEAN = """\
Made with `--clean`. Labels and samples are computed as in the original script, with these differences:

- Entries near a missing vehicle (late starts) and entries of vehicles that entered before the road ahead was recorded
  are no samples.
- If two vehicles share a cell, the nearer one fills it and the other moves to the nearest free cell of its lane.
- No vehicle and no neighbor is in two parts. The parts are those of the lake's split if it has a validation part, else
  of a split planned for these files, whose TrainSet may hold data that the lake evaluates on.
- Subsets that validation excludes are left out.
- A track with a gap, or across a border of the split, becomes several tracks; the later ones have new ids.
"""


def write_card(path: Path, export: CspExport) -> None:
    """Write the card; the same export gives the same bytes."""
    options = ["--" + name.replace("_", "-") for name in ("clean", "full_future") if getattr(export.options, name)]
    options += [f"--dataset {export.options.dataset}"] if export.options.dataset else []
    lines = [
        "# TrainSet.mat, ValSet.mat, TestSet.mat",
        "",
        f"Written by tracklake {version('tracklake')}: `tracklake {' '.join(('export csp', *options))}`, in the format",
        f"of conv-social-pooling (github.com/nachiket92/conv-social-pooling): {DEO.full}",
        "",
        *([f"**{export.synthetic}**", ""] if export.synthetic else []),
        CLEAN if export.options.clean else ORIGINAL,
        "| file | samples | tracks with samples | tracks | entries of tracks |",
        "| --- | ---: | ---: | ---: | ---: |",
        *(
            f"| {file.name} | {file.samples:,} | {file.sampled_tracks:,} | {file.tracks:,} | {file.entries:,} |"
            for file in export.files
        ),
        "",
        "An entry of a track is a sample, or is dropped for the first reason that applies:",
        "",
        "| reason | " + " | ".join(file.name for file in export.files) + " | meaning |",
        "| --- | " + "---: | " * len(export.files) + "--- |",
    ]
    for reason, meaning in REASONS.items():
        counts = [file.dropped.get(reason, 0) for file in export.files]
        if any(counts):
            lines.append(f"| {reason} | " + " | ".join(f"{count:,}" for count in counts) + f" | {meaning} |")
    lines += ["", *_describe_left_out(export), "Data sets, by the first column of `traj` and the row of `tracks`:", ""]
    lines += ["| id | data set | subset | recording | origin |", "| ---: | --- | --- | --- | --- |"]
    names = ("id", "dataset", "subset", "recording", "origin")
    lines += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in export.datasets]
    lines += ["", COLUMNS, *(f"- note: {note}" for note in export.notes)]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _describe_left_out(export: CspExport) -> list[str]:
    lines = [f"- {count:,} entries in no file: {REASONS[reason]}" for reason, count in export.left_out.items()]
    if export.options.clean:
        lines.append(
            f"- {export.collisions:,} neighbors shared a cell with a nearer one and moved to another cell, except "
            f"{export.crowded_out:,} that were dropped since no cell was free"
        )
    else:
        lines.append(f"- {export.overwritten:,} neighbors were overwritten by another one in the same cell")
    return [*lines, ""]


COLUMNS = """\
Columns of `traj` (single precision): data set id, vehicle id, frame, x (lateral, ft), y (along the road, ft), lane
(1 is the driver's leftmost; US-101: lanes from 6 on are 6), lateral maneuver (1 keep, 2 left, 3 right), longitudinal
maneuver (1 normal, 2 brake), and the ids in the 39 cells around the vehicle (left, own, right lane; 13 cells of 15 ft
each, from behind to ahead; 0 = none). `tracks{data set, vehicle}` is 3 x T: frame, x, y. The rate is 10 frames per
second; highD is interpolated, with frame k at (k - 1) / 10 s.
"""
