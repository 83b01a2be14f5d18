"""Commands of stages that have no options of their own, such as `tracklake validate`."""

from collections.abc import Callable
from pathlib import Path

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, WorkersOption
from tracklake.pipeline.cli.session import report_result, run_steps, work_in_folder
from tracklake.pipeline.cli.summary import show_reconstruction
from tracklake.pipeline.stages.registry import STAGES


def _make_command(name: str, *others: str, show: Callable[[Terminal, Path], None] | None = None) -> Callable[..., None]:
    """Make the command of a stage, and of others that follow it; its help is the first stage's meaning.

    `show` prints figures of a lake that is complete.
    """

    def run_stage(
        lake: LakeOption = None,
        protocol: ProtocolOption = None,
        workers: WorkersOption = None,
        quiet: QuietOption = False,
        json: JsonOption = False,
    ) -> None:
        with command(quiet=quiet, json=json) as terminal:
            named = read_settings(lake=lake, workers=workers, protocol=protocol, in_folder=False)
            with work_in_folder(terminal, named) as settings:
                result = run_steps(terminal, settings, (name, *others))
                if show is not None and not result.failed:
                    show(terminal, settings.lake)
                report_result(terminal, settings, result, headline=False)

    run_stage.__doc__ = next(stage.meaning for stage in STAGES if stage.name == name)
    return run_stage


validate = _make_command("validate")
reconstruct = _make_command("reconstruct", "revalidate", show=show_reconstruction)
traffic = _make_command("traffic")
samples = _make_command("samples")
tensors = _make_command("tensors")
fuse = _make_command("fuse")
