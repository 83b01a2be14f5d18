"""`tracklake export ...`: the lake in other projects' formats."""

from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, require_choice
from tracklake.pipeline.cli.tables import print_table
from tracklake.pipeline.export.car_following.export import Format as FollowingFormat
from tracklake.pipeline.export.car_following.export import export_car_following
from tracklake.pipeline.export.csp.export import export_csp
from tracklake.pipeline.export.csp.result import CspExport, CspOptions
from tracklake.pipeline.export.sumo.export import CONFIG, export_sumo_fcd
from tracklake.pipeline.export.windows.export import export_windows
from tracklake.pipeline.export.windows.result import Format
from tracklake.pipeline.settings import Settings
from tracklake.schemas.columns import DATASETS

export = typer.Typer(
    help="Write the lake's data in other projects' formats.", no_args_is_help=True, add_completion=False
)


ForceOption = Annotated[bool, typer.Option("--force", help="Replace such files in DIR.")]


@export.callback()
def _export() -> None:
    """Write the lake's data in other projects' formats."""


@export.command()
def csp(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for TrainSet.mat, ValSet.mat, TestSet.mat.")
    ],
    lake: LakeOption = None,
    clean: Annotated[
        bool, typer.Option("--clean", help="No late starts, gaps, overwritten neighbors, or leaks between the files.")
    ] = False,
    full_future: Annotated[
        bool, typer.Option("--full-future", help="Only samples with 5 s of future, not 0.2 s.")
    ] = False,
    dataset: Annotated[str | None, typer.Option("--dataset", help="Only ngsim, or only highd.")] = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write the files of conv-social-pooling's preprocess_data.m, value for value unless --clean is given."""
    with command(quiet=quiet, json=json) as terminal:
        require_choice("--dataset", dataset, DATASETS)
        options = CspOptions(clean=clean, full_future=full_future, dataset=dataset)
        with terminal.show_stages():
            written = export_csp(read_settings(lake=lake), out, options, force=force)
        _show_csp_export(terminal, written)
        terminal.print_json(written.to_dict())


OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files and their README.md.")]
AbsoluteOption = Annotated[
    bool, typer.Option("--absolute", help="Positions on the carriageway, not relative to the sample's last one.")
]


@export.command()
def windows(
    out: OutOption,
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    absolute: AbsoluteOption = False,
    force: ForceOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write Parquet: a row per sample with its history, future and neighbors; a file per part, and a data card."""
    with command(quiet=quiet, json=json) as terminal:
        _write_windows(terminal, read_settings(lake=lake, protocol=protocol), out, "parquet", absolute, force)


@export.command()
def npz(
    out: OutOption,
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    absolute: AbsoluteOption = False,
    force: ForceOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write NumPy arrays of samples, their histories, futures and neighbors; a file per part, and a data card."""
    with command(quiet=quiet, json=json) as terminal:
        _write_windows(terminal, read_settings(lake=lake, protocol=protocol), out, "npz", absolute, force)


@export.command()
def sumo_fcd(
    out: OutOption,
    lake: LakeOption = None,
    subset: Annotated[
        str | None, typer.Option("--subset", help="Carriageway to export; not needed where the lake has only one.")
    ] = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write a carriageway's tracks as SUMO's floating-car data, with its road and a configuration that replays them."""
    with command(quiet=quiet, json=json) as terminal:
        with terminal.show_stages():
            written = export_sumo_fcd(read_settings(lake=lake), out, subset, force=force)
        terminal.print_origin(written.synthetic)
        counts = f"{written.vehicles:,} vehicles, {written.entries:,} entries, {written.lanes} lanes"
        terminal.print_line(f"{written.dataset}/{written.subset}, {written.tracks_from} tracks: {counts}")
        for note in (*written.notes, *(f"licence of {own}" for own in written.licences)):
            terminal.print_line(note, style="dim")
        terminal.print_line(f"in {written.out}; replay: sumo-gui -c {written.out / CONFIG}", style="bold green")
        terminal.print_json(written.to_dict())


@export.command()
def car_following(
    out: OutOption,
    lake: LakeOption = None,
    file_format: Annotated[str, typer.Option("--format", help="parquet or csv.")] = "parquet",
    force: ForceOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write episodes of car following, a row per entry of follower and leader, ready for calibration."""
    with command(quiet=quiet, json=json) as terminal:
        require_choice("--format", file_format, get_args(FollowingFormat))
        with terminal.show_stages():
            written = export_car_following(
                read_settings(lake=lake), out, cast(FollowingFormat, file_format), force=force
            )
        terminal.print_origin(written.synthetic)
        for subset, episodes in written.episodes.items():
            terminal.print_line(f"{subset}: {episodes:,} episodes, {written.entries[subset]:,} entries")
        for licence in written.licences:
            terminal.print_line(f"licence of {licence}", style="dim")
        tracks = f"{written.tracks_from} tracks"
        terminal.print_line(f"{tracks}, in {written.out / written.file}; what it holds: README.md", style="bold green")
        terminal.print_json(written.to_dict())


def _write_windows(
    terminal: Terminal, settings: Settings, out: Path, file_format: Format, absolute: bool, force: bool
) -> None:
    """Write the windows and print how many there are."""
    with terminal.show_stages():
        written = export_windows(settings, out, file_format, absolute=absolute, force=force)
    terminal.print_origin(written.synthetic)
    for part, samples in written.samples.items():
        terminal.print_line(f"{part}.{file_format}: {samples:,} samples, {written.neighbors[part]:,} neighbors")
    for note in written.notes:
        terminal.print_line(f"licence of {note}", style="dim")
    terminal.print_line(f"in {written.out}; what they hold: README.md", style="bold green")
    terminal.print_json(written.to_dict())


def _show_csp_export(terminal: Terminal, written: CspExport) -> None:
    """Print a line per file, and what was dropped by reason."""
    terminal.print_origin(written.synthetic)
    rows = [
        [file.name, *(f"{count:,}" for count in (file.samples, file.sampled_tracks, file.tracks, file.entries))]
        for file in written.files
    ]
    print_table(terminal, ["file", "samples", "tracks with samples", "tracks", "entries"], rows)
    counts = [f"{reason} {count:,}" for reason, count in written.count_drops().items()]
    terminal.print_line(f"entries that are no samples: {', '.join(counts) or 'none'}")
    if written.options.clean:
        terminal.print_line(
            f"neighbors that shared a cell: {written.collisions:,}, of which {written.crowded_out:,} found no free cell"
        )
    else:
        terminal.print_line(f"neighbors overwritten in their cell: {written.overwritten:,}")
    for note in written.notes:
        terminal.print_line(f"note: {note}", style="dim")
    terminal.print_line(f"in {written.out}; what they hold: DATA_CARD.md", style="bold green")
