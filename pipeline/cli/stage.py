"""`tracklake validate`, `traffic`, `samples`, `tensors` and `fuse`: stages without options of their own."""

from collections.abc import Callable

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, WorkersOption
from tracklake.pipeline.cli.session import report_result, run_steps
from tracklake.pipeline.stages.registry import STAGES


def _make_command(name: str) -> Callable[..., None]:
    """Make the command of a stage, with the stage's meaning as its help."""

    def run_stage(
        lake: LakeOption = None,
        protocol: ProtocolOption = None,
        workers: WorkersOption = None,
        quiet: QuietOption = False,
        json: JsonOption = False,
    ) -> None:
        with command(quiet=quiet, json=json) as terminal:
            settings = read_settings(lake=lake, workers=workers, protocol=protocol)
            report_result(terminal, settings, run_steps(terminal, settings, (name,)), headline=False)

    run_stage.__doc__ = next(stage.meaning for stage in STAGES if stage.name == name)
    return run_stage


validate = _make_command("validate")
traffic = _make_command("traffic")
samples = _make_command("samples")
tensors = _make_command("tensors")
fuse = _make_command("fuse")
