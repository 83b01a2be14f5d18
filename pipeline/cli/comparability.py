"""What scores mean on these recordings: published figures beside them, and figures that lane centres do not allow."""

from pathlib import Path
from typing import cast

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.lake import connect, load, scan
from tracklake.quality_reports.published import explain_gap
from tracklake.quality_reports.summaries import query
from tracklake.schemas import SUBSETS
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.protocols import RECORDED
from tracklake.schemas.quality_tracks import RecordingFacts
from tracklake.schemas.references import COIFMAN
from tracklake.training.data.tensor_folder import TensorFolder


def print_comparability(terminal: Terminal, root: Path, folder: TensorFolder, *, published: bool) -> tuple[str, ...]:
    """Print what is synthetic or has lane centres, and which datasets have no published figures beside them and why.

    Returns the datasets that published figures may stand beside; none unless they are wanted.
    """
    terminal.print_origin(describe_synthetic(folder.origins))
    print_lane_centres(terminal, folder)
    if not published:
        return ()
    if (tracks := folder.protocol.tracks_from) != RECORDED:
        terminal.print_line(
            f"note: no published figures beside {tracks} tracks: those are of recorded ones", style="dim"
        )
        return ()
    facts = scan(root, load(root), SUBSETS).select("dataset", "subset", "recording").collect()
    used = {
        (dataset, recording)
        for dataset, subset, recording in facts.iter_rows()
        if f"{dataset}/{subset}" in folder.origins
    }
    gaps: dict[str, list[str]] = {dataset: [] for dataset, _ in sorted(used)}
    with connect(root) as connection:
        rows = cast("list[RecordingFacts]", query(connection, "recordings"))
    for row in rows:
        gap = explain_gap(row) if (row["dataset"], row["recording"]) in used else None
        if gap is not None:
            gaps[row["dataset"]].append(f"{row['recording']}: {gap}")
    for dataset, reasons in gaps.items():
        if reasons:
            more = f"; and {len(reasons) - 1} more recordings" if len(reasons) > 1 else ""
            terminal.print_line(f"note: no published figures beside {dataset} ({reasons[0]}{more})", style="dim")
    return tuple(dataset for dataset, reasons in gaps.items() if not reasons)


def print_lane_centres(terminal: Terminal, folder: TensorFolder) -> None:
    """Print which subsets have lane centres in place of lateral positions, with the publication of those of NGSIM."""
    names = folder.lane_centred_subsets
    if names:
        cite = f" Cite with NGSIM's I-80: {COIFMAN.full}" if any(own.startswith("ngsim/i-80") for own in names) else ""
        terminal.print_line(
            f"note: lateral positions of {', '.join(names)} are lane centres: only errors along the road mean "
            f"anything; radial and lateral ones are left out.{cite}",
            style="dim",
        )
