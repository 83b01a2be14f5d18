"""`tracklake ingest`: raw files to tables."""

from typing import Annotated, Any

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.options import (
    ColumnsOption,
    DatasetOption,
    JsonOption,
    LakeOption,
    PruneOption,
    QuietOption,
    RebuildOption,
    RecordingOption,
    ReplaceOption,
    WorkersOption,
)
from tracklake.pipeline.cli.session import report_result, run_steps, work_in_folder


def ingest(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A raw file, or a folder of any mix of them.")],
    lake: LakeOption = None,
    dataset: DatasetOption = None,
    columns: ColumnsOption = None,
    recording: RecordingOption = None,
    workers: WorkersOption = None,
    replace: ReplaceOption = False,
    prune: PruneOption = False,
    rebuild: RebuildOption = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Read raw files into tracks, vehicles and subsets (the format is detected)."""
    with command(quiet=quiet, json=json) as terminal:
        named = read_settings(lake=lake, workers=workers, columns=columns, recording=recording, in_folder=False)
        flags: dict[str, Any] = {"replace": replace, "prune": prune, "rebuild": rebuild}
        with work_in_folder(terminal, named, rebuild=rebuild) as settings:
            outcome = run_steps(terminal, settings, ("ingest",), source, dataset, **flags)
            report_result(terminal, settings, outcome, headline=False)
