"""The command line. Heavy libraries are imported inside the commands, so that help answers at once."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pipeline.settings import Settings
    from pipeline.terminal import Terminal
    from pipeline.work import Outcome

DONE, FAILED, USAGE, REFUSED = 0, 1, 2, 3
SAMPLE = "sample"

app = typer.Typer(
    name="tracklake",
    help="Highway trajectory recordings (NGSIM, highD) to a Parquet lake, quality reports, splits and tensors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    epilog="Exit codes: 0 done, 1 failed, 2 usage, 3 done but some recordings were refused.",
)

LakeOption = Annotated[
    Path | None, typer.Option("--lake", metavar="DIR", help="Folder of the lake [env: TRACKLAKE_LAKE; default: lake].")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and no progress.")]
DatasetOption = Annotated[str | None, typer.Option("--dataset", help="Read SOURCE as this only: ngsim or highd.")]
WorkersOption = Annotated[int | None, typer.Option("--workers", min=1, help="Recordings worked on at once.")]
MinutesOption = Annotated[float | None, typer.Option("--minutes", help="Length of the generated recordings.")]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Of the generated sample: same seed, same bytes.")]


def main() -> None:
    """Entry point of the `tracklake` command."""
    app()


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"tracklake {version_of('tracklake')}")
        raise typer.Exit(DONE)


@app.command()
def run(
    source: Annotated[
        str | None, typer.Argument(metavar="[SOURCE]", help="A raw file or a folder of them; none: a generated sample.")
    ] = None,
    lake: LakeOption = None,
    dataset: DatasetOption = None,
    workers: WorkersOption = None,
    minutes: MinutesOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """The whole pipeline: raw files to tables, checks, repair, samples, split, tensors, first score and report."""
    from pipeline.work import ALL_STEPS

    with _command(quiet=quiet, json=json) as terminal:
        settings = _settings(lake=lake, workers=workers)
        if source is None:
            source = str(_provide_sample(settings.lake, minutes, seed, terminal))
        elif minutes is not None or seed is not None:
            raise typer.BadParameter("--minutes and --seed are for the generated sample, which takes no SOURCE")
        outcome = _order(terminal, settings, ALL_STEPS, source, dataset)
        _conclude(terminal, settings, outcome)


@app.command()
def ingest(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A raw file, or a folder of any mix of them.")],
    lake: LakeOption = None,
    dataset: DatasetOption = None,
    workers: WorkersOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Raw files to tracks, vehicles and subsets (the format is detected)."""
    with _command(quiet=quiet, json=json) as terminal:
        settings = _settings(lake=lake, workers=workers)
        outcome = _order(terminal, settings, ("ingest",), source, dataset)
        _conclude(terminal, settings, outcome, headline=False)


def _add_stage(name: str, meaning: str) -> None:
    """One command per stage that works on what is in the lake."""

    def stage(
        lake: LakeOption = None,
        workers: WorkersOption = None,
        quiet: QuietOption = False,
        json: JsonOption = False,
    ) -> None:
        with _command(quiet=quiet, json=json) as terminal:
            settings = _settings(lake=lake, workers=workers)
            outcome = _order(terminal, settings, (name,))
            _conclude(terminal, settings, outcome, headline=name == "report")

    stage.__doc__ = meaning
    app.command(name=name)(stage)


# The names and meanings of pipeline.stages.registry, which is not imported here: it would cost a second of every call.
STAGE_COMMANDS = {
    "validate": "Check every entry against the rules.",
    "repair": "Find late starts and estimate what is missing of them.",
    "samples": "Draw samples with maneuvers and neighbors.",
    "split": "Divide the subsets into train and eval.",
    "tensors": "Write the split as flat arrays.",
    "report": "Write the quality report.",
}
for _name, _meaning in STAGE_COMMANDS.items():
    _add_stage(_name, _meaning)


@app.command()
def sql(
    query: Annotated[str, typer.Argument(help="One SELECT; `-` reads it from standard input.")],
    lake: LakeOption = None,
    format: Annotated[str, typer.Option("--format", help="table, csv, json or parquet.")] = "table",
    out: Annotated[Path | None, typer.Option("--out", help="Write the result to this file.")] = None,
) -> None:
    """Ask SQL of the tracks, read-only, from anywhere."""
    from pipeline.export.query import FORMATS, write_result
    from pipeline.lake import connect, query_errors
    from pipeline.lake import query as run_query

    with _command() as terminal:
        if format not in FORMATS:
            raise typer.BadParameter(f"--format is one of {', '.join(FORMATS)}; got {format!r}")
        with connect(_settings(lake=lake).lake) as connection:
            relation = run_query(connection, sys.stdin.read() if query == "-" else query)
            with query_errors():  # DuckDB computes while the result is fetched
                write_result(relation, format, out, terminal)


@app.command()
def train(
    model: Annotated[str, typer.Argument(help="A model's name, for instance lstm.")],
    lake: LakeOption = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, help="How long to train.")] = 60.0,
    seed: Annotated[int, typer.Option("--seed", help="Of weights and batches.")] = 0,
    name: Annotated[str | None, typer.Option("--name", help="Name of the run; default: the model's.")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Train a model on the split's training part and evaluate it once on the evaluation part."""
    with _command(quiet=quiet, json=json) as terminal:
        from pipeline.lake import load
        from pipeline.lake.files import MODELS
        from pipeline.stages.tensors import tensor_folder
        from pipeline.terminal import show_scores
        from training.train import TrainConfig
        from training.train import train as train_model

        root = _settings(lake=lake).lake
        tensors = tensor_folder(root, load(root))
        out = root / MODELS / (name or model)
        with terminal.measuring(f"train {model}") as tell:
            metrics = train_model(model, tensors, out, TrainConfig(seconds=seconds, seed=seed), tell)
        if metrics["evaluation"] is not None:
            show_scores(terminal, [metrics["evaluation"]])
        terminal.say(f"run {out}; `tracklake evaluate` compares runs, `tracklake report` adds them to the report")
        terminal.give(metrics)


@app.command()
def evaluate(
    runs: Annotated[list[str] | None, typer.Argument(help="Runs or models; none: all runs in the lake.")] = None,
    lake: LakeOption = None,
    part: Annotated[str, typer.Option("--part", help="train, val or eval.")] = "eval",
    protocol: Annotated[str | None, typer.Option("--protocol", help="Name of the protocol.")] = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """RMSE at 1 to 5 s with the number of samples behind each."""
    with _command(quiet=quiet, json=json) as terminal:
        from pipeline.lake import load
        from pipeline.lake.files import MODELS
        from pipeline.stages.score import BASELINE, finished_runs
        from pipeline.stages.tensors import tensor_folder
        from pipeline.terminal import show_scores
        from training.evaluate import evaluate as evaluate_model

        settings = _settings(lake=lake, protocol=protocol)
        settings.get_protocol()
        root = settings.lake
        tensors = tensor_folder(root, load(root))
        names = runs or sorted({BASELINE, *(path.parent.name for path in finished_runs(root))})
        found = [evaluate_model(name, tensors, root / MODELS, part).to_dict() for name in names]
        show_scores(terminal, found)
        terminal.give({"evaluations": found})


@app.command()
def sample(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="A new or empty folder.")],
    format: Annotated[
        list[str] | None, typer.Option("--format", help="highd, ngsim-text, ngsim-csv, socrata; repeatable.")
    ] = None,
    minutes: MinutesOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Generate recordings in the raw formats with SUMO, with known defects and their truth."""
    from pipeline.terminal import command_here

    with _command(quiet=quiet, json=json) as terminal:
        summary = _write_sample(out, minutes, seed, terminal, formats=format)
        terminal.say(f"{summary.rows:,} rows of {summary.recordings} recordings in {out} ({summary.seconds:.0f} s)")
        terminal.say(f"Try next:\n  {command_here()} run {out}")
        terminal.give({"out": out, "rows": summary.rows, "recordings": summary.recordings, "seconds": summary.seconds})


@app.command()
def serve() -> None:
    """Serve the flows as Prefect deployments (run, ingest, quality) until interrupted."""
    import os

    if not os.environ.get("PREFECT_API_URL"):
        typer.echo("PREFECT_API_URL is not set: runs would be seen by nobody. Start a server, for instance", err=True)
        typer.echo("  prefect server start\n  export PREFECT_API_URL=http://127.0.0.1:4200/api", err=True)
        raise typer.Exit(FAILED)
    from pipeline.flows import serve_deployments

    serve_deployments()


@contextmanager
def _command(*, quiet: bool = False, json: bool = False) -> Iterator["Terminal"]:
    """Give a command its terminal, and turn what a user can mend into a message and an exit code."""
    from pydantic import ValidationError

    from pipeline.lake import LakeError
    from pipeline.sources import SourceError
    from pipeline.stages.base import StageError
    from pipeline.terminal import Terminal

    terminal = Terminal(quiet=quiet, as_json=json)
    try:
        yield terminal
    except (LakeError, SourceError, StageError) as error:
        terminal.complain(str(error))
        raise typer.Exit(FAILED) from None
    except ValidationError as error:
        for problem in error.errors():
            where = ".".join(str(part) for part in problem["loc"])
            terminal.complain(
                f"setting {where}: {problem['msg']}; got {problem['input']!r}. See `tracklake.toml` and TRACKLAKE_*."
            )
        raise typer.Exit(USAGE) from None
    except (ValueError, OSError, ImportError) as error:
        terminal.complain(f"{error}")
        raise typer.Exit(FAILED) from None
    except KeyboardInterrupt:
        terminal.complain("interrupted; what was committed stays, and the same command goes on from there")
        raise typer.Exit(FAILED) from None


def _settings(**flags: Any) -> "Settings":  # noqa: ANN401 - any setting
    from pipeline.settings import Settings

    return Settings(**{name: value for name, value in flags.items() if value is not None})


def _order(
    terminal: "Terminal",
    settings: "Settings",
    steps: tuple[str, ...],
    source: str | None = None,
    dataset: str | None = None,
) -> "Outcome":
    """Do what is not done; Prefect is imported only where something is."""
    from pipeline.lake import load, refuse_if_busy
    from pipeline.work import Order, Outcome, is_idle, survey

    if dataset not in (None, "ngsim", "highd"):
        raise typer.BadParameter(f"--dataset is ngsim or highd; got {dataset!r}")
    plain = settings.model_dump(mode="json", exclude_unset=True)
    order = Order(str(settings.lake), steps, source, dataset, plain)
    discovery = survey(order) if source is not None else None
    if discovery is None:
        load(order.root)  # raises where there is no lake to work on
    if discovery is not None and not discovery.units:
        # Nothing can come of it, so no lake is made for it either.
        for message in discovery.refusals:
            terminal.complain(message, label="refused")
        raise typer.Exit(FAILED)
    if is_idle(order, discovery):
        terminal.say("nothing to do: the lake is up to date", style="dim")
        return Outcome(refused=list(discovery.refusals) if discovery else [])
    refuse_if_busy(order.root)
    with terminal.working():
        from pipeline.flows import execute

        return execute(order)


def _conclude(terminal: "Terminal", settings: "Settings", outcome: "Outcome", *, headline: bool = True) -> None:
    """Say what came of an order and exit with the code that fits."""
    import json
    from dataclasses import asdict

    from pipeline.lake import load
    from pipeline.lake.files import REPORTS
    from pipeline.stages.report import DOCUMENT, PAGE
    from pipeline.terminal import show_headline, show_outcome

    show_outcome(terminal, outcome)
    reports = settings.lake / REPORTS
    record: dict[str, Any] = {"lake": settings.lake, **asdict(outcome)}
    usable = bool(load(settings.lake).of_stage("ingest"))
    if usable and headline and (reports / DOCUMENT).exists():
        quality = json.loads((reports / DOCUMENT).read_text(encoding="utf-8"))
        show_headline(terminal, quality, reports / PAGE, settings.lake)
        record |= {"report": (reports / PAGE).resolve(), "headline": quality["headline"], "scores": quality["scores"]}
    elif outcome.built:
        terminal.say(f"done: {', '.join(f'{stage} {count}' for stage, count in outcome.built.items())}")
    terminal.give(record)
    if outcome.failed or not usable:
        raise typer.Exit(FAILED)
    if outcome.refused:
        terminal.complain(f"{len(outcome.refused)} refused (above); everything else is done", label="refused")
        raise typer.Exit(REFUSED)


def _provide_sample(lake: Path, minutes: float | None, seed: int | None, terminal: "Terminal") -> Path:
    """The generated sample beside the lake, made where it is not there or asked for otherwise."""
    out = lake.parent / SAMPLE
    if minutes is None and seed is None and (out / "truth.parquet").exists():
        terminal.say(f"the generated sample in {out}", style="dim")
        return out
    summary = _write_sample(out, minutes, seed, terminal)
    terminal.say(f"generated {summary.rows:,} rows of {summary.recordings} recordings in {out}", style="dim")
    return out


def _write_sample(
    out: Path, minutes: float | None, seed: int | None, terminal: "Terminal", formats: list[str] | None = None
) -> Any:  # noqa: ANN401 - SampleSummary, whose module is imported late
    from pipeline.sample import DEFAULT_FORMATS, DEFAULT_MINUTES, SumoError, write_sample

    try:
        return write_sample(
            out,
            formats=tuple(formats) if formats else DEFAULT_FORMATS,
            minutes=DEFAULT_MINUTES if minutes is None else minutes,
            seed=1 if seed is None else seed,
            progress=lambda text: terminal.say(text, style="dim"),
        )
    except SumoError as error:
        terminal.complain(str(error))
        raise typer.Exit(FAILED) from None


if __name__ == "__main__":
    main()
