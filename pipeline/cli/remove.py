"""`tracklake remove`: recordings leave the lake."""

from dataclasses import asdict
from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, QuietOption
from tracklake.pipeline.cli.session import work_in_folder
from tracklake.pipeline.ingest.removal import describe_sizes, remove_recordings
from tracklake.pipeline.lake.object_store import find_address


def remove(
    recordings: Annotated[list[str], typer.Argument(metavar="RECORDING...", help="For instance 03, or highd/03.")],
    lake: LakeOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Take recordings out of the lake, with all that was made of them; raw files stay."""
    with command(quiet=quiet, json=json) as terminal:
        named = read_settings(lake=lake, in_folder=False)
        with work_in_folder(terminal, named) as settings:
            removed, outdated = remove_recordings(settings.lake, recordings)
        for recording in removed:
            terminal.print_line(
                f"removed {recording.name}: {', '.join(recording.subsets)}; {describe_sizes([recording])}"
            )
            if recording.files:
                terminal.print_line(
                    f"note: {recording.files[0]} is still there, and ingesting it brings {recording.name} back"
                )
        if outdated:
            terminal.print_line(
                f"note: {', '.join(outdated)} were made of it and are removed, too; `tracklake run` makes them again"
            )
        place = find_address(named.lake) or named.lake
        terminal.print_json(
            {"lake": place, "removed": [asdict(recording) for recording in removed], "outdated": outdated}
        )
