"""`tracklake run`: the whole pipeline."""

from typing import Annotated

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.generated_sample import provide_sample, refuse_mixing
from tracklake.pipeline.cli.options import (
    ColumnsOption,
    DatasetOption,
    JsonOption,
    LakeOption,
    MinutesOption,
    ProtocolOption,
    PruneOption,
    QuietOption,
    RebuildOption,
    RecordingOption,
    ReplaceOption,
    SeedOption,
    WorkersOption,
)
from tracklake.pipeline.cli.session import report_result, run_steps, work_in_folder
from tracklake.pipeline.orchestration.run_plan import ALL_STEPS
from tracklake.schemas.extras import require_extras


def run(
    source: Annotated[
        str | None, typer.Argument(metavar="[SOURCE]", help="A raw file or a folder of them; none: a generated sample.")
    ] = None,
    lake: LakeOption = None,
    dataset: DatasetOption = None,
    columns: ColumnsOption = None,
    recording: RecordingOption = None,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    replace: ReplaceOption = False,
    prune: PruneOption = False,
    rebuild: RebuildOption = False,
    minutes: MinutesOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Run the whole pipeline: raw files to tables, checks, samples, split, tensors, first score and report."""
    with command(quiet=quiet, json=json) as terminal:
        named = read_settings(
            lake=lake, workers=workers, protocol=protocol, columns=columns, recording=recording, in_folder=False
        )
        check = refuse_mixing if source is None else None
        if source is None:
            require_extras("the pipeline on a generated sample", "sample", "flows", "report")
            if prune or rebuild:
                raise typer.BadParameter("--prune and --rebuild need SOURCE, the folder with the raw files")
        elif minutes is not None or seed is not None:
            raise typer.BadParameter("--minutes and --seed are for the generated sample, which takes no SOURCE")
        flags = {"replace": replace, "prune": prune, "rebuild": rebuild}
        with work_in_folder(terminal, named, rebuild=rebuild) as settings:
            files = source or str(provide_sample(settings.lake, minutes, seed, terminal))
            outcome = run_steps(terminal, settings, ALL_STEPS, files, dataset, **flags, check=check)
            report_result(terminal, settings, outcome)
