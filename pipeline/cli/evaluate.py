"""`tracklake evaluate`: runs and models scored on one part, written as a table, and published figures beside them.

Like the other commands, it imports heavy libraries where they are used.
"""

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption
from tracklake.pipeline.cli.session import command, read_settings

if TYPE_CHECKING:
    import polars as pl

    from tracklake.pipeline.cli.console import Terminal
    from tracklake.training.evaluation.evaluate import Evaluation

FOLDER = "evaluations"
"""Of the lake: one file per protocol."""
FORMATS = (".csv", ".json", ".parquet")


class By(StrEnum):
    """What scores can be shown by, besides over everything."""

    MANEUVER = "maneuver"
    FINDINGS = "findings"
    DATASET = "dataset"
    VEHICLE = "vehicle"


def evaluate(
    runs: Annotated[list[str] | None, typer.Argument(help="Runs or models; none: all runs in the lake.")] = None,
    lake: LakeOption = None,
    part: Annotated[str, typer.Option("--part", help="train, val or eval.")] = "eval",
    protocol: ProtocolOption = None,
    by: Annotated[
        list[By] | None, typer.Option("--by", help="Also show the errors so; repeatable. `vehicle`: averaged so.")
    ] = None,
    published: Annotated[
        bool, typer.Option("--published/--no-published", help="Put published figures beside, marked as such.")
    ] = True,
    nearest: Annotated[
        int | None, typer.Option("--nearest", min=0, help="Vehicles around that models of scenes are shown.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Write the table to this .csv, .json or .parquet instead of into the lake."),
    ] = None,
    every_tick: Annotated[
        bool, typer.Option("--every-tick", help="Score at every tick, not at the protocol's seconds alone.")
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Errors at each horizon of runs and models, with what is behind them, and published figures beside.

    The whole table goes to LAKE/evaluations/<protocol>.csv; where RUNS are named, or another part, another number of
    vehicles around, --every-tick or --no-published is asked for, to --out only.
    """
    with command(quiet=quiet, json=json) as terminal:
        import polars as pl

        from tracklake.pipeline.cli.score_tables import show_evaluations
        from tracklake.pipeline.lake import load
        from tracklake.pipeline.lake.files import MODELS
        from tracklake.pipeline.stages.score import BASELINE, finished_runs
        from tracklake.pipeline.stages.tensors import tensor_folder
        from tracklake.schemas.columns import PARTS
        from tracklake.schemas.errors import explain_file_errors
        from tracklake.schemas.evaluations import EVALUATIONS
        from tracklake.training.evaluation.published import published_rows
        from tracklake.training.models.inputs import NEAREST

        if part not in PARTS:
            raise typer.BadParameter(f"--part is one of {', '.join(PARTS)}; got {part!r}")
        if out is not None and out.suffix not in FORMATS:
            raise typer.BadParameter(f"--out ends with one of {', '.join(FORMATS)}; got {out}")
        settings = read_settings(lake=lake, protocol=protocol)
        root = settings.lake
        tensors = tensor_folder(root, load(root), settings)
        around = NEAREST if nearest is None else nearest
        plain = part == "eval" and around == NEAREST and published and not every_tick
        target = root / FOLDER / f"{settings.get_protocol().name}.csv" if out is None and plain and not runs else out
        if target is not None:
            with explain_file_errors(target.parent):
                target.parent.mkdir(parents=True, exist_ok=True)  # now: what takes long would be lost afterwards
        names = dict.fromkeys(runs or sorted({BASELINE, *(path.parent.name for path in finished_runs(root))}))
        found = _evaluate_all(
            terminal, names, tensors, root / MODELS, part, around, every_tick=every_tick, strict=bool(runs)
        )
        measured = pl.concat([own.to_table() for own in found]) if found else EVALUATIONS.empty()
        table = measured
        if published:
            datasets = tuple(measured["dataset"].unique())
            table = pl.concat([measured, published_rows(settings.get_protocol().name, datasets)])
        table = EVALUATIONS.validate(table.sort(EVALUATIONS.key), where="evaluate")
        if found:
            show_evaluations(terminal, found[0], table, [own.value for own in by or []])
        if target is not None:
            _write(target, table)
            terminal.say(f"table {target}: {table.height:,} rows", style="dim")
        elif not runs:
            terminal.say("note: the lake keeps the table of the options' defaults; --out writes this one", style="dim")
        rows = table.to_dicts()
        terminal.give({"evaluations": [own.to_dict() for own in found], "rows": rows, "table": target})


def _evaluate_all(
    terminal: "Terminal",
    names: Iterable[str],
    tensors: Path,
    models: Path,
    part: str,
    nearest: int,
    *,
    every_tick: bool,
    strict: bool,
) -> list["Evaluation"]:
    """Score one after the other; runs that do not fit, or not any more, are passed by, unless asked for by name."""
    from tracklake.schemas.errors import MissingExtraError
    from tracklake.training.evaluation.evaluate import evaluate as evaluate_model
    from tracklake.training.models.prediction import NotFiniteError
    from tracklake.training.runs.run_folder import StaleRunError

    found = []
    for name in names:
        try:
            found.append(
                evaluate_model(name, tensors, models, part, nearest=nearest, with_latency=True, every_tick=every_tick)
            )
        except (StaleRunError, NotFiniteError, MissingExtraError) as unfit:
            if strict:
                raise
            terminal.complain(str(unfit), label="passed by")
    return found


def _write(target: Path, table: "pl.DataFrame") -> None:
    """Write the table whole or not at all, in the form that the file's name says."""
    from io import BytesIO

    from tracklake.schemas.files import write_file

    content = BytesIO()
    if target.suffix == ".csv":
        table.write_csv(content)
    elif target.suffix == ".json":
        table.write_json(content)
    else:
        table.write_parquet(content)
    write_file(target, content.getvalue())
