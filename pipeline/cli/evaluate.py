"""`tracklake evaluate`: runs and models scored on one part, written as a table, beside published figures."""

from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Annotated

import polars as pl
import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.comparability import print_comparability
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.evidence import show_evidence
from tracklake.pipeline.cli.options import (
    JsonOption,
    LakeOption,
    OnlyDatasetOption,
    OnlyRecordingOption,
    ProtocolOption,
    QuietOption,
    require_choice,
)
from tracklake.pipeline.cli.score_tables import describe_fit, show_evaluations
from tracklake.pipeline.cli.smoothing_gain import describe_causality, measure_gain, open_histories, show_gain
from tracklake.pipeline.lake import load, refuse_lake
from tracklake.pipeline.lake.files import MODELS
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.score import BASELINE, list_finished_runs
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas.columns import PARTS
from tracklake.schemas.comparisons import VEHICLE_ERRORS
from tracklake.schemas.errors import MissingExtraError, explain_file_errors
from tracklake.schemas.evaluations import EVALUATIONS
from tracklake.schemas.files import write_output
from tracklake.schemas.protocols import RECONSTRUCTED_TRACKS
from tracklake.schemas.published_results import list_published_rows
from tracklake.schemas.run_config import StaleRunError
from tracklake.training.comparison.record import SampleRecord
from tracklake.training.data.gathers import NEAREST
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.evaluate import Evaluation, measure_errors
from tracklake.training.models.prediction import NotFiniteError
from tracklake.training.runs.forecasters import Forecaster, open_forecaster

FOLDER = "evaluations"
"""Folder of the lake with one table of scores per protocol."""

FORMATS = (".csv", ".json", ".parquet")
"""Endings of the files that --out can name."""


class By(StrEnum):
    """Groups by which scores can be shown, besides all samples together."""

    MANEUVER = "maneuver"
    FINDINGS = "findings"
    DATASET = "dataset"
    VEHICLE = "vehicle"


ByOption = Annotated[
    list[By] | None,
    typer.Option("--by", help="Also show the errors by this; repeatable. `vehicle`: average over vehicles."),
]
PublishedOption = Annotated[
    bool, typer.Option("--published/--no-published", help="Show published figures, too, marked as such.")
]
NearestOption = Annotated[
    int | None, typer.Option("--nearest", min=0, help="Most neighbors that models of scenes are given.")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Write the table to this .csv, .json or .parquet instead of into the lake.")
]
GainOption = Annotated[
    bool | None,
    typer.Option(
        "--gain/--no-gain",
        help="Score by recorded, filtered and reconstructed histories; the default where tracks_from is reconstructed.",
    ),
]
VehicleErrorsOption = Annotated[
    Path | None,
    typer.Option(
        "--vehicle-errors", help="Also write the summed errors of every run, vehicle and horizon to this .parquet."
    ),
]
CompareOption = Annotated[
    bool,
    typer.Option("--compare", help="Compare the first of RUNS with the others: differences with 95 % intervals."),
]
CalibrationOption = Annotated[
    bool,
    typer.Option(
        "--calibration",
        help="Show how far predicted regions hold the truth, and sigma, errors and conformal radii by traffic density.",
    ),
]
FeasibilityOption = Annotated[
    bool,
    typer.Option("--feasibility", help="Show how many jointly predicted scenes overlap, jerk or leave the road."),
]
EvidenceOption = Annotated[
    Path | None,
    typer.Option("--evidence", metavar="DIR", help="Write tables and plots of these three options to DIR."),
]
EveryTickOption = Annotated[
    bool, typer.Option("--every-tick", help="Score at every tick, not only at the protocol's seconds.")
]


def evaluate(
    runs: Annotated[list[str] | None, typer.Argument(help="Runs or models; none: all runs in the lake.")] = None,
    lake: LakeOption = None,
    part: Annotated[str, typer.Option("--part", help="train, val or eval.")] = "eval",
    protocol: ProtocolOption = None,
    dataset: OnlyDatasetOption = None,
    recording: OnlyRecordingOption = None,
    by: ByOption = None,
    published: PublishedOption = True,
    nearest: NearestOption = None,
    out: OutOption = None,
    every_tick: EveryTickOption = False,
    gain: GainOption = None,
    vehicle_errors: VehicleErrorsOption = None,
    compare: CompareOption = False,
    calibration: CalibrationOption = False,
    feasibility: FeasibilityOption = False,
    evidence: EvidenceOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Score runs and models at each horizon, beside published figures.

    The whole table goes to LAKE/evaluations/<protocol>.csv. Where RUNS, another part, --dataset, --recording,
    --nearest, --every-tick or --no-published are given, it goes to --out only.
    """
    with command(quiet=quiet, json=json) as terminal:
        require_choice("--part", part, PARTS)
        _check_files(out, vehicle_errors, evidence, has_evidence=compare or calibration or feasibility)
        settings = read_settings(lake=lake, protocol=protocol)
        root = settings.lake
        tensors = TensorFolder.open(tensor_folder(root, load(root), settings)).narrow(dataset, recording)
        around = NEAREST if nearest is None else nearest
        plain = part == "eval" and around == NEAREST and published and not every_tick and tensors.kept is None
        target = root / FOLDER / f"{settings.get_protocol().name}.csv" if out is None and plain and not runs else out
        _make_folders(target, vehicle_errors, evidence)
        names = dict.fromkeys(runs or [BASELINE, *sorted(path.parent.name for path in list_finished_runs(root))])
        if compare and len(names) < 2:
            raise typer.BadParameter(f"--compare needs two runs or models; got {', '.join(names)} alone")
        records = {name: SampleRecord(tensors, part) for name in names} if calibration else {}
        opened, found = _evaluate_all(
            terminal, names, tensors, root / MODELS, part, around, records, every_tick=every_tick, strict=bool(runs)
        )
        comparable = print_comparability(terminal, root, tensors, published=published)
        table = _tabulate(found, settings.get_protocol().name, comparable)
        if found:
            _show_scores(terminal, found, table, by or [])
        wanted = gain if gain is not None else tensors.protocol.tracks_from == RECONSTRUCTED_TRACKS
        gains = _compare_histories(terminal, settings, opened, tensors, part, around) if wanted and found else None
        joint = opened if feasibility else []
        tables = show_evidence(terminal, tensors, found, records, joint, compare=compare, out=evidence)
        if vehicle_errors is not None:
            _write_vehicle_errors(terminal, vehicle_errors, found)
        _write_scores(terminal, target, table, named=bool(runs))
        shown = {"evaluations": [own.to_dict() for own in found], "rows": table.to_dicts(), "table": target}
        further = {"smoothing_gain": gains, **tables}
        terminal.print_json(shown | {name: own.to_dicts() for name, own in further.items() if own is not None})


def _check_files(out: Path | None, vehicle_errors: Path | None, evidence: Path | None, *, has_evidence: bool) -> None:
    """Refuse files of other formats, folders in place of files, and places within a lake."""
    if evidence is not None and not has_evidence:
        raise typer.BadParameter("--evidence DIR needs --compare, --calibration or --feasibility")
    if out is not None and out.suffix not in FORMATS:
        raise typer.BadParameter(f"--out ends with one of {', '.join(FORMATS)}; got {out}")
    if vehicle_errors is not None and vehicle_errors.suffix != ".parquet":
        raise typer.BadParameter(f"--vehicle-errors ends with .parquet; got {vehicle_errors}")
    refuse_lake(out)
    refuse_lake(evidence, "--evidence")
    refuse_lake(vehicle_errors, "--vehicle-errors")
    if evidence is not None and evidence.exists() and not evidence.is_dir():
        raise typer.BadParameter(f"--evidence names a folder, and {evidence} is a file; name another place")
    for option, file in (("--out", out), ("--vehicle-errors", vehicle_errors)):
        if file is not None and file.is_dir():
            raise typer.BadParameter(f"{option} names a file, and {file} is a folder; name a file, in it or elsewhere")


def _make_folders(target: Path | None, vehicle_errors: Path | None, evidence: Path | None) -> None:
    """Make the folders that are written into, before the long work, which would be lost."""
    for folder in (target and target.parent, vehicle_errors and vehicle_errors.parent, evidence):
        if folder is not None:
            with explain_file_errors(folder, "Name another place, where folders can be made."):
                folder.mkdir(parents=True, exist_ok=True)


def _tabulate(found: Iterable[Evaluation], protocol: str, comparable: tuple[str, ...]) -> pl.DataFrame:
    """Return the rows of all evaluations, and published ones of datasets that are comparable."""
    tables = [EVALUATIONS.empty(), *(own.to_table() for own in found)]
    tables += [list_published_rows(protocol, comparable)] if comparable else []
    return EVALUATIONS.validate(pl.concat(tables).sort(EVALUATIONS.key), where="evaluate")


def _show_scores(terminal: Terminal, found: Sequence[Evaluation], table: pl.DataFrame, by: Iterable[By]) -> None:
    """Print the scores, what was fitted on the fly, and which tracks the histories are of."""
    show_evaluations(terminal, found[0], table, [own.value for own in by])
    for fit in (own.fit for own in found if own.fit):
        terminal.print_line(describe_fit(fit), style="dim")
    terminal.print_line(describe_causality(found[0].protocol.tracks_from), style="dim")


def _write_scores(terminal: Terminal, target: Path | None, table: pl.DataFrame, *, named: bool) -> None:
    """Write the table of scores where one is asked for; where no runs are named, tell why the lake gets none."""
    if target is not None:
        _write_table(target, table)
        terminal.print_line(f"table {target}: {table.height:,} rows", style="dim")
    elif not named:
        terminal.print_line(
            "note: the lake keeps the table of the options' defaults; --out writes this one", style="dim"
        )


def _evaluate_all(
    terminal: Terminal,
    names: Iterable[str],
    tensors: TensorFolder,
    models: Path,
    part: str,
    nearest: int,
    records: Mapping[str, SampleRecord],
    *,
    every_tick: bool,
    strict: bool,
) -> tuple[list[Forecaster], list[Evaluation]]:
    """Open and score runs and models; a run that does not fit the tensors is skipped, or refused with `strict`."""
    opened, found = [], []
    protocol = tensors.protocol
    seconds = [tick / protocol.rate_hz for tick in range(1, protocol.horizon_ticks + 1)] if every_tick else None
    score = partial(measure_errors, nearest=nearest, seconds=seconds, with_latency=True)
    for name in names:
        observe = records[name].observe if name in records else None
        try:
            model = open_forecaster(name, tensors, models, frozenset({part}))
            found.append(score(model, tensors, part, observe=observe))
        except (StaleRunError, NotFiniteError, MissingExtraError) as error:
            if strict:
                raise
            terminal.print_problem(str(error), label="skipped")
        else:
            opened.append(model)
    return opened, found


def _compare_histories(
    terminal: Terminal, settings: Settings, models: list[Forecaster], folder: TensorFolder, part: str, nearest: int
) -> pl.DataFrame | None:
    """Score models with histories of every kind of tracks, and show what smoothing gains; None on lane centres."""
    if folder.lane_centred_subsets:
        terminal.print_line("note: no gain from smoothing: it is one of radial errors, which lane centres lack")
        return None
    reader = LakeReader(settings.lake, load(settings.lake))
    inputs = open_histories(settings, reader, folder, part, nearest)
    gains = measure_gain(models, inputs)
    show_gain(terminal, gains, inputs)
    return gains


def _write_vehicle_errors(terminal: Terminal, target: Path, found: Iterable[Evaluation]) -> None:
    """Write the summed errors of every run, vehicle and horizon."""
    errors = pl.concat([VEHICLE_ERRORS.empty(), *(own.to_vehicle_errors() for own in found)])
    _write_table(target, VEHICLE_ERRORS.validate(errors.sort(VEHICLE_ERRORS.key), where="evaluate"))
    terminal.print_line(f"vehicle errors {target}: {errors.height:,} rows", style="dim")


def _write_table(target: Path, table: pl.DataFrame) -> None:
    """Write the table in the format of the file's ending."""
    content = BytesIO()
    if target.suffix == ".csv":
        table.write_csv(content)
    elif target.suffix == ".json":
        table.write_json(content)
    else:
        table.write_parquet(content)
    write_output(target, content.getvalue())
