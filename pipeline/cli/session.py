"""The flow that the pipeline's commands share: run what is missing or stale, then report what was done."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer

from tracklake.pipeline.cli.command import FAILED, REFUSED
from tracklake.pipeline.cli.comparison_table import compare_lakes
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import require_choice
from tracklake.pipeline.cli.summary import show_assessment, show_headline, show_result
from tracklake.pipeline.ingest.discovery import Discovery
from tracklake.pipeline.lake import LakeError, LakeFile, load_recent, refuse_foreign, refuse_if_busy
from tracklake.pipeline.lake.files import REPORTS
from tracklake.pipeline.lake.origin import Origin
from tracklake.pipeline.lake.transfers import fetch_files
from tracklake.pipeline.lake.working_copy import hold_copy, list_report, locate_origin
from tracklake.pipeline.orchestration.prefect_home import import_flows
from tracklake.pipeline.orchestration.run_plan import RunRequest, RunResult, conclude_idle, plan_run, survey_source
from tracklake.pipeline.settings import Settings, list_files
from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.stages.report import DOCUMENT, PAGE, read_quality
from tracklake.schemas.columns import DATASETS
from tracklake.schemas.errors import explain_file_errors
from tracklake.schemas.text import quote_shell

SURVEY_S = 0.3
"""Time to wait for the survey of a source before Prefect is imported beside it, in seconds."""


def run_steps(
    terminal: Terminal,
    settings: Settings,
    steps: tuple[str, ...],
    source: str | None = None,
    dataset: str | None = None,
    *,
    replace: bool = False,
    prune: bool = False,
    rebuild: bool = False,
    check: Callable[[Path, Discovery], None] | None = None,
) -> RunResult:
    """Run every requested step whose outputs are missing or stale.

    `check` gets the lake and the files of the source, and may refuse them.
    """
    require_choice("--dataset", dataset, DATASETS)
    plain = settings.model_dump(mode="json", exclude_unset=True)
    # Absolute, so that a worker in another folder finds the same places.
    where = None if source is None else str(Path(source).absolute())
    request = RunRequest(str(settings.lake.absolute()), steps, where, dataset, plain, replace, prune, rebuild)
    request.check()
    for file in list_files(settings.lake):
        terminal.print_line(f"settings: {file}", style="dim")
    refuse_foreign(request.root, rebuild=rebuild)
    if prune and source is not None and Path(source).is_file():
        raise typer.BadParameter(f"--prune compares a folder with the lake; {source} is a file")
    try:
        discovery = _survey_while_importing(request) if source is not None else None
    except SourceError as error:
        raise SourceError(f"{error}{_explain_no_prune(request.root)}" if prune else str(error)) from None
    if discovery is None:
        load_recent(request.root)  # raises where there is no lake to work on
    if discovery is not None and not discovery.units:
        # No file is usable, so no lake is created.
        for message in discovery.refusals:
            terminal.print_problem(message, label="refused")
        if prune:
            terminal.print_problem(_explain_no_prune(request.root).strip(), label="refused")
        terminal.print_json({"refused": list(discovery.refusals)})
        raise typer.Exit(FAILED)
    if check is not None and discovery is not None:
        check(settings.lake, discovery)
    plan = plan_run(request, discovery)
    if plan.is_idle:
        terminal.print_line("nothing to do: the lake is up to date", style="dim")
        return conclude_idle(request, plan)
    refuse_if_busy(request.root, rebuild=rebuild)
    if plan.is_broken_off:
        terminal.print_line(
            "catalog and folders do not agree with the manifest: they are brought up to date", style="dim"
        )
    with terminal.show_stages(), explain_file_errors(request.root), _explain_interrupt(request.root):
        result: RunResult = import_flows().execute(request, plan)
        return result


@contextmanager
def work_in_folder(terminal: Terminal, settings: Settings, *, rebuild: bool = False) -> Iterator[Settings]:
    """Yield settings with the lake in a folder; of a lake on an object store its copy, while no other works on it.

    What is made there is committed at the store as it is made. After Ctrl-C or an error the same command goes on.
    """
    origin = locate_origin(settings.lake, settings.cache, settings.cache_gb)
    if origin is None:
        yield settings
        return
    terminal.print_line(f"working in {origin.copy}, a copy of {origin.address}", style="dim")
    with terminal.hold_json(), hold_copy(origin, is_rebuild=rebuild) as folder:
        before = _list_files(folder)
        try:
            yield settings.model_copy(update={"lake": folder})
        except typer.Exit:  # some files were refused, or a stage failed: what is done counts, as in a folder
            _show_sent(terminal, origin, before)
            raise
        _show_sent(terminal, origin, before)


def _list_files(lake: Path) -> set[LakeFile]:
    with suppress(LakeError):
        return {file for commit in load_recent(lake).commits.values() for file in commit.all_files}
    return set()


def _show_sent(terminal: Terminal, origin: Origin, before: set[LakeFile]) -> None:
    sent = _list_files(origin.copy) - before
    terminal.print_line(
        f"published {origin.address}: {len(sent):,} files, {sum(file.bytes for file in sent) / 1e6:,.1f} MB"
    )


@contextmanager
def _explain_interrupt(lake: Path) -> Iterator[None]:
    """Say after Ctrl-C what of the work is in the lake."""
    before = _list_commits(lake)
    try:
        yield
    except KeyboardInterrupt:
        made = len(_list_commits(lake) - before)
        kept = {0: "nothing of this run is", 1: "1 result of this run is"}.get(made, f"{made} results of this run are")
        raise KeyboardInterrupt(f"interrupted; {kept} in the lake. Run the same command again to go on") from None


def _list_commits(lake: Path) -> set[tuple[str, str]]:
    """Return keys and fingerprints of what is in the lake."""
    try:
        return {(key, commit.fingerprint) for key, commit in load_recent(lake).commits.items()}
    except LakeError:
        return set()


def _survey_while_importing(request: RunRequest) -> Discovery:
    """Find the raw files; Prefect is imported meanwhile where that takes longer than looking up known hashes.

    Files that must be hashed are new, so there will be work for it.
    """
    with ThreadPoolExecutor(max_workers=1) as thread:
        discovery = thread.submit(survey_source, request)
        with suppress(TimeoutError):
            return discovery.result(timeout=SURVEY_S)
        import_flows()
        return discovery.result()


def _explain_no_prune(lake: Path) -> str:
    """Explain, after the message about a source without usable files, that --prune removed nothing."""
    return (
        "\n--prune removed nothing: what holds no raw files may be a mistyped folder, or a disk that is not there. To "
        f"remove a recording by its name: `tracklake remove RECORDING --lake {quote_shell(lake)}`."
    )


def report_result(
    terminal: Terminal,
    settings: Settings,
    result: RunResult,
    *,
    headline: bool = True,
    assess: bool = False,
    compare: Path | None = None,
) -> None:
    """Print what a run did, and exit with its code unless everything was done.

    Args:
        terminal: terminal of the command.
        settings: settings of the run.
        result: result of the run.
        headline: whether to print the report's figures.
        assess: whether to print how good the estimates of missing starts are.
        compare: another lake to compare this one with.
    """
    show_result(terminal, result)
    reports = settings.lake / REPORTS
    record: dict[str, Any] = {"lake": settings.lake, **asdict(result)}
    manifest = load_recent(settings.lake)
    usable = bool(manifest.of_stage("ingest"))
    if usable and headline and (reports / DOCUMENT).exists():
        fetch_files(settings.lake, list_report(manifest))
        quality = read_quality(settings.lake)
        show_headline(terminal, quality, reports / PAGE, settings.lake)
        record |= {"report": (reports / PAGE).resolve(), **{key: quality[key] for key in ("headline", "model_scores")}}
    elif not usable and not result.refused:
        terminal.print_line(f"{settings.lake}: the lake holds no recordings; `tracklake ingest SOURCE` adds some")
    elif result.built:
        terminal.print_line(f"done: {', '.join(f'{stage} {count}' for stage, count in result.built.items())}")
    if assess and usable and not result.failed:
        record["assessment"] = show_assessment(terminal, settings.lake)
    if compare is not None and not result.failed:
        record |= compare_lakes(terminal, settings.lake, compare)
    terminal.print_json(record)
    if result.failed or (result.refused and not usable):
        raise typer.Exit(FAILED)
    if result.refused:
        terminal.print_problem(f"{len(result.refused)} refused (above); everything else is done", label="refused")
        raise typer.Exit(REFUSED)
