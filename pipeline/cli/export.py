"""`tracklake export ...`: the lake in other projects' formats. Heavy libraries are imported inside the commands."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption
from tracklake.pipeline.cli.session import command, read_settings

if TYPE_CHECKING:
    from tracklake.pipeline.cli.console import Terminal
    from tracklake.pipeline.export.csp.result import CspExport
    from tracklake.pipeline.export.windows.result import Format
    from tracklake.pipeline.settings import Settings

app = typer.Typer(help="Write the lake's data in other projects' formats.", no_args_is_help=True)


ForceOption = Annotated[bool, typer.Option("--force", help="Replace such files in DIR.")]


@app.callback()
def _export() -> None:
    """Write the lake's data in other projects' formats."""


@app.command()
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
    """The files that conv-social-pooling's preprocess_data.m writes, value for value unless --clean is given."""
    with command(quiet=quiet, json=json) as terminal:
        from tracklake.pipeline.export.csp.export import export_csp
        from tracklake.pipeline.export.csp.result import CspOptions
        from tracklake.schemas.columns import DATASETS

        if dataset not in (None, *DATASETS):
            raise typer.BadParameter(f"--dataset is {' or '.join(DATASETS)}; got {dataset!r}")
        options = CspOptions(clean=clean, full_future=full_future, dataset=dataset)
        with terminal.working():
            export = export_csp(read_settings(lake=lake), out, options, force=force)
        _show(terminal, export)
        terminal.give(export.to_dict())


OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files and their README.md.")]
AbsoluteOption = Annotated[
    bool, typer.Option("--absolute", help="Positions on the carriageway, not relative to the sample's last one.")
]


@app.command()
def windows(
    out: OutOption,
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    absolute: AbsoluteOption = False,
    force: ForceOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Plain Parquet: a row per sample with its history, future and neighbors; a file per part, and a data card."""
    with command(quiet=quiet, json=json) as terminal:
        _write_windows(terminal, read_settings(lake=lake, protocol=protocol), out, "parquet", absolute, force)


@app.command()
def npz(
    out: OutOption,
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    absolute: AbsoluteOption = False,
    force: ForceOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """NumPy arrays of the samples with their histories, futures and neighbors; a file per part, and a data card."""
    with command(quiet=quiet, json=json) as terminal:
        _write_windows(terminal, read_settings(lake=lake, protocol=protocol), out, "npz", absolute, force)


def _write_windows(
    terminal: "Terminal", settings: "Settings", out: Path, file_format: "Format", absolute: bool, force: bool
) -> None:
    """Write them and say how many there are."""
    from tracklake.pipeline.export.windows.export import export_windows

    with terminal.working():
        export = export_windows(settings, out, file_format, absolute=absolute, force=force)
    for part, samples in export.samples.items():
        terminal.say(f"{part}.{file_format}: {samples:,} samples, {export.neighbors[part]:,} neighbors")
    for note in export.notes:
        terminal.say(f"licence of {note}", style="dim")
    terminal.say(f"in {export.out}; what they hold: README.md", style="bold green")
    terminal.give(export.to_dict())


def _show(terminal: "Terminal", export: "CspExport") -> None:
    """Print a line per file, and what was dropped by reason."""
    from rich.table import Table

    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for heading in ("file", "samples", "tracks with samples", "tracks", "entries"):
        table.add_column(heading, justify="left" if heading == "file" else "right")
    for file in export.files:
        table.add_row(
            file.name, *(f"{count:,}" for count in (file.samples, file.sampled_tracks, file.tracks, file.entries))
        )
    if terminal.talks:
        terminal.out.print(table)
    counts = [f"{reason} {count:,}" for reason, count in export.count_drops().items()]
    terminal.say(f"entries that are no samples: {', '.join(counts) or 'none'}")
    if export.options.clean:
        terminal.say(f"neighbors that shared a cell: {export.collisions:,}, of them nowhere {export.crowded_out:,}")
    else:
        terminal.say(f"neighbors overwritten in their cell: {export.overwritten:,}")
    for note in export.notes:
        terminal.say(f"note: {note}", style="dim")
    terminal.say(f"in {export.out}; what they hold: DATA_CARD.md", style="bold green")
