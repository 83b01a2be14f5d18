"""The card beside exported .mat files: what they hold, what they were made of and with which options."""

from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from tracklake.pipeline.transforms.csp.parts import REASONS

if TYPE_CHECKING:
    from tracklake.pipeline.export.csp.export import CspExport

CARD = "DATA_CARD.md"

ORIGINAL = """\
Every value is the one that the original script computes: windows count rows (a gap in a track stretches them), of two
vehicles in one cell the higher id stands there, the parts are cut at 0.7 and 0.8 of the highest vehicle id of each
data set, so that vehicles on either side of a cut lose each other as neighbors. Ids are those of the source's files.
Subsets that validation excludes are in it.
"""
CLEAN = """\
Made with `--clean`. The arithmetic of labels and samples is the original script's; what differs: entries around which
a vehicle is missing (late starts), or of vehicles that entered before the road ahead was recorded, are no samples;
of two vehicles in one cell the nearer stands there and the other in the nearest free cell of its lane; no vehicle
and no neighbor crosses from part to part: the parts are those of the lake's split where it has a validation part,
else of one planned for these files, whose TrainSet may hold what the lake evaluates on; subsets that validation
excludes are left out. A track with a gap, or across a border of the split, is several tracks, of which the later ones
have ids that no vehicle had.
"""


def write_card(path: Path, export: "CspExport") -> None:
    """Write it; the same export gives the same bytes."""
    options = ["--" + name.replace("_", "-") for name in ("clean", "full_future") if getattr(export.options, name)]
    options += [f"--dataset {export.options.dataset}"] if export.options.dataset else []
    lines = [
        "# TrainSet.mat, ValSet.mat, TestSet.mat",
        "",
        f"Written by tracklake {version('tracklake')}: `tracklake {' '.join(('export csp', *options))}`, in the format",
        "of conv-social-pooling (Deo and Trivedi 2018, github.com/nachiket92/conv-social-pooling).",
        "",
        CLEAN if export.options.clean else ORIGINAL,
        "| file | samples | tracks with samples | tracks | entries of tracks |",
        "| --- | ---: | ---: | ---: | ---: |",
        *(
            f"| {file.name} | {file.samples:,} | {file.sampled_tracks:,} | {file.tracks:,} | {file.entries:,} |"
            for file in export.files
        ),
        "",
        "Entries of tracks are samples or dropped, for the first reason that applies:",
        "",
        "| reason | " + " | ".join(file.name for file in export.files) + " | meaning |",
        "| --- | " + "---: | " * len(export.files) + "--- |",
    ]
    for reason, meaning in REASONS.items():
        counts = [file.dropped.get(reason, 0) for file in export.files]
        if any(counts):
            lines.append(f"| {reason} | " + " | ".join(f"{count:,}" for count in counts) + f" | {meaning} |")
    lines += ["", *_tell_left_out(export), "Data sets, by the first column of `traj` and the row of `tracks`:", ""]
    lines += ["| id | data set | subset | recording |", "| ---: | --- | --- | --- |"]
    lines += [f"| {row['id']} | {row['dataset']} | {row['subset']} | {row['recording']} |" for row in export.datasets]
    lines += ["", COLUMNS, *(f"- note: {note}" for note in export.notes)]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _tell_left_out(export: "CspExport") -> list[str]:
    lines = [f"- {count:,} entries in no file: {REASONS[reason]}" for reason, count in export.left_out.items()]
    if export.options.clean:
        lines.append(
            f"- {export.collisions:,} neighbors found their cell taken by a nearer one and moved to another, except "
            f"{export.crowded_out:,} for whom there was none"
        )
    else:
        lines.append(f"- {export.overwritten:,} neighbors were overwritten by another one in the same cell")
    return [*lines, ""]


COLUMNS = """\
Columns of `traj` (single precision): data set id, vehicle id, frame, x (lateral, ft), y (along the road, ft), lane
(1 is the driver's leftmost; US-101: lanes from 6 on are 6), lateral maneuver (1 keep, 2 left, 3 right), longitudinal
maneuver (1 normal, 2 brake), and the ids in the 39 cells around (left, own, right lane; 13 cells of 15 ft each, from
behind to ahead; 0 is nobody). `tracks{data set, vehicle}` is 3 x T: frame, x, y. 10 frames a second; those of highD
are interpolated, frame k at (k - 1) / 10 s.
"""
