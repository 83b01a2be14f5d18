"""`tracklake predict`: samples drawn on the road with their truth and the models' predictions."""

import json as json_format
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.comparability import print_lane_centres
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, QuietOption, require_choice
from tracklake.pipeline.cli.sample_choice import MOST_SEARCHED, Pick, find_sample, pick_samples
from tracklake.pipeline.lake import load, refuse_lake
from tracklake.pipeline.lake.files import MODELS
from tracklake.pipeline.stages.tensors import tensor_folder
from tracklake.schemas.columns import PARTS
from tracklake.schemas.errors import MissingExtraError, explain_file_errors
from tracklake.schemas.extras import require_extras
from tracklake.schemas.files import write_file, write_output
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.run_config import StaleRunError
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.plots.picture import Picture, forecast_samples, forecast_scene, take_picture
from tracklake.training.runs.forecasters import Forecaster, open_forecaster

if TYPE_CHECKING:
    from tracklake.training.models.attention import SceneAttention

FOLDER = "predictions"
"""Folder of the lake with the drawings."""

SUFFIXES = (".svg", ".png")
MOST_MODELS = 4
"""Most models in one drawing."""

BASELINE = "constant-velocity"


NamesArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="RUN_OR_MODEL",
        help="Up to four; constant velocity is drawn beside them where there is room. None: the newest runs.",
    ),
]
VehicleOption = Annotated[
    str | None, typer.Option("--vehicle", metavar="SUBSET:ID", help="A vehicle, for instance 02-lower:21.")
]
TimeOption = Annotated[
    float | None, typer.Option("--time", metavar="S", help="With --vehicle: seconds since the recording began.")
]
PickOption = Annotated[
    Pick | None,
    typer.Option("--pick", help="Draw samples of a kind; worst: of the last model, or newest run (default: random)."),
]
AllVehiclesOption = Annotated[
    bool, typer.Option("--all-vehicles", help="Predict every sample of the scene; a model of scenes: every vehicle.")
]
AttentionOption = Annotated[
    bool, typer.Option("--attention", help="Also draw the attention weights of a model, per head.")
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE|FOLDER", help="A .svg or .png, or a folder (default: LAKE/predictions)."),
]


def predict(
    models: NamesArgument = None,
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    sample: Annotated[int | None, typer.Option("--sample", metavar="N", help="A sample by its number.")] = None,
    vehicle: VehicleOption = None,
    time: TimeOption = None,
    pick: PickOption = None,
    part: Annotated[str, typer.Option("--part", help="With --pick: train, val or eval.")] = "eval",
    seed: Annotated[int, typer.Option("--seed", min=0, help="With --pick: seed of the draw.")] = 0,
    count: Annotated[int, typer.Option("--count", min=1, max=100, help="With --pick: how many samples.")] = 1,
    all_vehicles: AllVehiclesOption = False,
    attention: AttentionOption = False,
    out: OutOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Draw samples on the road: history, neighbors, truth, predictions and their uncertainty."""
    with command(quiet=quiet, json=json) as terminal:
        _check_options(models or [], sample, vehicle, time, pick, part, count, out)
        require_extras("drawing", "report")
        from tracklake.training.plots.picture_drawing import draw_picture  # imports Altair

        refuse_lake(out)
        settings = read_settings(lake=lake, protocol=protocol)
        root = settings.lake
        folder = TensorFolder.open(tensor_folder(root, load(root), settings))
        terminal.print_origin(describe_synthetic(folder.origins))
        print_lane_centres(terminal, folder)
        samples = _find_samples(folder, sample, vehicle, time)
        parts = _list_parts(folder, samples) if samples else frozenset({part})
        forecasters = _open_forecasters(terminal, models or [], folder, root / MODELS, parts, alone=all_vehicles)
        if attention:
            _require_attention(forecasters)
        if not samples:
            judge = (
                forecasters[-1]
                if models
                else next((own for own in forecasters if own.name != BASELINE), forecasters[0])
            )
            samples = _pick_samples(terminal, folder, pick or Pick.RANDOM, part, count, seed, judge)
        drawn: list[dict[str, Any]] = []
        for number in samples:
            picture = _predict_sample(folder, number, forecasters, all_vehicles=all_vehicles)
            file = _name_file(out, root / FOLDER, picture, all_vehicles=all_vehicles)
            with explain_file_errors(file.parent):
                file.parent.mkdir(parents=True, exist_ok=True)
            write_output(file, draw_picture(picture).render(file.suffix))
            _show_errors(terminal, picture, file)
            drawn.append({"file": file, **picture.to_dict()})
        maps = _draw_attention(folder, forecasters, samples, file.parent) if attention else []
        for map_file in maps:
            terminal.print_line(f"  {map_file}", style="bold green")
        terminal.print_json({"pictures": drawn, "attention": maps})


def _check_options(
    models: list[str],
    sample: int | None,
    vehicle: str | None,
    time: float | None,
    pick: Pick | None,
    part: str,
    count: int,
    out: Path | None,
) -> None:
    """Refuse options that contradict each other, before anything is opened."""
    require_choice("--part", part, PARTS)
    if len(dict.fromkeys(models)) > MOST_MODELS:
        raise typer.BadParameter(f"a drawing holds {MOST_MODELS} models at most; got {', '.join(models)}")
    given = [
        name for name, value in (("--sample", sample), ("--vehicle", vehicle), ("--pick", pick)) if value is not None
    ]
    if len(given) > 1:
        raise typer.BadParameter(
            f"--sample, --vehicle and --pick each say what to draw: give one; got {' and '.join(given)}"
        )
    if (vehicle is None) != (time is None):
        raise typer.BadParameter("--vehicle SUBSET:ID and --time S go together")
    if count > 1 and (sample is not None or vehicle is not None):
        raise typer.BadParameter("--count goes with --pick")
    if out is not None and out.suffix and out.suffix.lower() not in SUFFIXES and not out.is_dir():
        raise typer.BadParameter(f"--out ends in {' or '.join(SUFFIXES)}, or is a folder; got {out}")
    if count > 1 and out is not None and out.suffix.lower() in SUFFIXES:
        raise typer.BadParameter(f"--out is a folder where --count is more than 1; got {out}")


def _find_samples(folder: TensorFolder, sample: int | None, vehicle: str | None, time: float | None) -> list[int]:
    """Return the sample that was named, if one was."""
    if sample is not None:
        last = len(folder.sample_row) - 1
        if not 0 <= sample <= last:
            raise typer.BadParameter(f"--sample is a number from 0 to {last:,}; got {sample}")
        return [sample]
    if vehicle is not None and time is not None:
        return [find_sample(folder, vehicle, time)]
    return []


def _list_parts(folder: TensorFolder, samples: list[int]) -> frozenset[str]:

    return frozenset(PARTS[folder.sample_part[number]] for number in samples)


def _open_forecasters(
    terminal: Terminal, names: list[str], folder: TensorFolder, models: Path, parts: frozenset[str], *, alone: bool
) -> list[Forecaster]:
    """Open the models named, or the newest runs that fit the tensors; constant velocity first, where there is room.

    With `alone`, constant velocity is left out beside others.
    """
    found = [open_forecaster(name, folder, models, parts) for name in dict.fromkeys(names)]
    if not names:
        finished = sorted(models.glob("[!.]*/metrics.json"), key=lambda file: file.stat().st_mtime, reverse=True)
        runs = [file.parent.name for file in finished if file.parent.name != BASELINE]
        for name in runs:
            if len(found) == (1 if alone else MOST_MODELS - 1):
                terminal.print_line(
                    f"note: {len(runs)} runs in the lake, of which the newest are drawn; name others", style="dim"
                )
                break
            try:
                found.append(open_forecaster(name, folder, models, parts))
            except (StaleRunError, MissingExtraError) as error:
                terminal.print_problem(str(error), label="skipped")
    named = {own.name for own in found}
    if BASELINE not in named and len(found) < MOST_MODELS and not (alone and found):
        found.insert(0, open_forecaster(BASELINE, folder, models, parts))
    return found


def _pick_samples(
    terminal: Terminal,
    folder: TensorFolder,
    pick: Pick,
    part: str,
    count: int,
    seed: int,
    judge: Forecaster,
) -> list[int]:
    """Pick samples of a kind."""
    found = pick_samples(folder, part, pick, count=count, seed=seed, judge=judge)
    if pick is Pick.WORST:
        many = len(folder.samples_of(part))
        among = f"{MOST_SEARCHED:,} drawn of {many:,}" if many > MOST_SEARCHED else f"{many:,}"
        terminal.print_line(f"the worst of {judge.name} among {among} samples of {part}", style="dim")
    if len(found) < count:
        terminal.print_line(f"note: there are only {len(found)} such samples", style="dim")
    return [int(number) for number in found]


def _predict_sample(folder: TensorFolder, sample: int, forecasters: list[Forecaster], *, all_vehicles: bool) -> Picture:
    """Predict with the models, then add the truth."""
    if all_vehicles:
        return take_picture(folder, sample, forecast_scene(folder, sample, forecasters))
    run = folder.runs_of(folder.sample_row[[sample]])
    own = int(folder.run_vehicle_id[run[0]])
    return take_picture(folder, sample, {own: forecast_samples(folder, [sample], forecasters)[sample]})


def _name_file(out: Path | None, predictions: Path, picture: Picture, *, all_vehicles: bool) -> Path:
    """Return the path of a drawing: the file named, or in a folder a name that says what it shows."""
    if out is not None and out.suffix.lower() in SUFFIXES and not out.is_dir():
        return out
    whose = f"{picture.own.vehicle_id}{'-and-all' if all_vehicles else ''}"
    name = "_".join([picture.subset, whose, f"{picture.time_s:.1f}s", *picture.models])
    return (predictions if out is None else out) / f"{name}.svg"


def _show_errors(terminal: Terminal, picture: Picture, file: Path) -> None:
    """Print where the drawing is, and how far each model is from the truth at its end."""
    from tracklake.training.plots.picture_rows import list_errors  # imports Altair

    last = {row["model"]: row for row in list_errors(picture) if row["own"]}
    figure, where = ("along_m", " along the road") if picture.lane_centred else ("distance_m", "")
    off = ", ".join(f"{model} {abs(row[figure]):.2f} m" for model, row in last.items())
    seconds = max((row["seconds"] for row in last.values()), default=0.0)
    terminal.print_line(
        f"vehicle {picture.own.vehicle_id} of {picture.subset} at {picture.time_s:.1f} s ({picture.part})"
    )
    terminal.print_line(f"  off after {seconds:g} s{where}: {off}", style="dim")
    terminal.print_line(f"  {file}", style="bold green")


def _require_attention(forecasters: list[Forecaster]) -> None:
    """Refuse --attention where no model has any, before anything is drawn."""
    if all(own.reads != "scene" for own in forecasters):
        raise typer.BadParameter(
            "--attention needs a run of a model with attention, for instance attention-h4; got "
            f"{', '.join(own.name for own in forecasters)}"
        )


def _draw_attention(
    folder: TensorFolder, forecasters: list[Forecaster], samples: list[int], target: Path
) -> list[Path]:
    """Write the attention maps of every model with attention, in a folder of its name."""
    found = []
    for own in forecasters:
        if own.reads == "scene":
            network: Any = own.predictor  # a network with attention
            found += export_attention(folder, network, samples, target / own.name)
    return found


def export_attention(
    folder: TensorFolder, network: "SceneAttention", samples: Sequence[int], out_dir: Path
) -> list[Path]:
    """Write a drawing and a JSON table per sample, and return their paths; files of the same names are replaced.

    Raises:
        IndexError: no sample has the number.
    """
    from tracklake.training.plots.attention import draw_attention, map_attention  # imports Altair

    out_dir.mkdir(parents=True, exist_ok=True)
    written = []
    for shown in map_attention(folder, network, samples):
        picture = shown.picture
        name = f"{picture.subset}_{picture.own.vehicle_id}_{picture.time_s:.1f}s_attention"
        drawing, table = out_dir / f"{name}.svg", out_dir / f"{name}.json"
        write_file(drawing, draw_attention(shown).render(drawing.suffix))
        write_file(table, json_format.dumps(shown.to_dict(), indent=1, allow_nan=False).encode() + b"\n")
        written += [drawing, table]
    return written
