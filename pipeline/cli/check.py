"""`tracklake check`: every file of the lake compared with its checksum, and quality gates."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from tracklake.pipeline.cli.command import FAILED, GATE_FAILED, command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.gates import (
    describe_gate,
    find_outdated,
    judge_gates,
    list_metrics,
    show_gates,
    write_junit,
)
from tracklake.pipeline.cli.options import JsonOption, LakeOption, QuietOption
from tracklake.pipeline.lake import (
    DamagedFile,
    LakeError,
    Manifest,
    find_damaged_files,
    is_settled,
    load,
    open_for_writing,
    refuse_lake,
)
from tracklake.pipeline.lake.live_folders import find_false_copies
from tracklake.pipeline.lake.origin import find_origin
from tracklake.quality_reports.gates.gate import parse_gate
from tracklake.schemas.text import quote_shell


def check(
    lake: LakeOption = None,
    fail_on: Annotated[
        list[str] | None,
        typer.Option("--fail-on", metavar="GATE", help="Also fail (exit code 4) where this holds; repeatable."),
    ] = None,
    with_checksums: Annotated[
        bool, typer.Option("--checksums/--no-checksums", help="Compare the files, or judge the gates only.")
    ] = True,
    junit: Annotated[
        Path | None, typer.Option("--junit", metavar="FILE", help="Also write the result as JUnit XML.")
    ] = None,
    with_metrics: Annotated[
        bool, typer.Option("--list-metrics", help="List what a gate can compare, and do nothing else.")
    ] = False,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Compare every file with its checksum, and judge quality gates such as "error_share > 0.05".

    On an object store, sizes are compared; contents are when they are received.

    Damaged files are made again by the next run. Catalog and folders are brought up to date where they are not.

    A gate compares metrics of each subset with values; `and` joins comparisons, and `per recording`, `per dataset` or
    `per lake` at its end judges those. It fails where all hold, where a value is not known, and where nothing is
    judged (docs/check.md).
    """
    with command(quiet=quiet, json=json) as terminal:
        if with_metrics:
            list_metrics(terminal)
            return
        gates = [parse_gate(text) for text in fail_on or ()]
        if not with_checksums and not gates:
            raise typer.BadParameter("--no-checksums leaves only gates to judge, and no --fail-on gives one")
        refuse_lake(junit, "--junit")
        settings = read_settings(lake=lake)
        root = settings.lake
        record: dict[str, Any] = {"lake": root}
        damaged = _check_files(root, terminal, record) if with_checksums else None
        results = [] if damaged else judge_gates(root, gates) if gates else []
        if gates:
            outdated = find_outdated(settings, load(root))
            if damaged:
                terminal.print_problem("gates are not judged where files are damaged", label="note")
            for stage in () if damaged else outdated:
                terminal.print_problem(
                    f"{stage} is not up to date: gates are judged on what it made last", label="note"
                )
            show_gates(terminal, results)
            record |= {"outdated": outdated, "gates": [describe_gate(result) for result in results]}
        if junit is not None:
            write_junit(junit, results, damaged)
        terminal.print_json(record)
        if damaged:
            raise typer.Exit(FAILED)
        not_passed = [result for result in results if result.state != "passed"]
        if not_passed:
            terminal.print_problem(f"{len(not_passed)} of {len(gates)} gates did not pass", label="failed")
            raise typer.Exit(GATE_FAILED)


def _check_files(root: Path, terminal: Terminal, record: dict[str, Any]) -> list[DamagedFile]:
    """Compare every live file with its checksum, mend what can be mended, and return what is damaged."""
    manifest = load(root)
    copies = find_false_copies(root, manifest)
    left = [DamagedFile("", name, "not the bytes of the live file, of which it is a copy") for name in copies]
    for copy in left:
        terminal.print_problem(f"{root / copy.path}: {copy.reason}", label="damaged")
    if copies or not is_settled(root, manifest):
        is_mended = _record_damage(root, terminal, copies=copies)
        outcome = "are up to date again" if is_mended else "were left so"
        terminal.print_line(f"catalog and folders did not agree with the manifest, and {outcome}")
        left = [] if is_mended else left
    manifest = load(root)
    damaged = find_damaged_files(root, manifest)
    files = [file for commit in manifest.commits.values() for file in commit.all_files if file.sha256 is not None]
    size = sum(file.bytes for file in files)
    for file in damaged:
        terminal.print_problem(f"{root / file.path}: {file.reason}", label="damaged")
    record |= {"files": len(files), "bytes": size, "damaged": [file._asdict() for file in (*damaged, *left)]}
    if damaged:
        _record_damage(root, terminal, damaged)
        terminal.print_problem(f"{len(damaged)} of {len(files):,} files are damaged. {_advise(root, manifest)}")
    elif left:
        terminal.print_problem(f"{len(left)} copies are damaged: run `tracklake check` again later")
    else:
        state = "all as they were written" if find_origin(root) is None else "all there, with their sizes"
        terminal.print_line(f"{len(files):,} files ({size / 1e6:,.1f} MB): {state}")
    return [*damaged, *left]


def _record_damage(
    root: Path, terminal: Terminal, damaged: Sequence[DamagedFile] = (), copies: Sequence[str] = ()
) -> bool:
    """Record what is damaged, and repeat the end of the session without some copies; returns whether it succeeded."""
    is_marked = False
    try:
        with open_for_writing(root) as writer:
            for name in copies:
                (root / name).unlink(missing_ok=True)
            writer.mark_damaged({file.key for file in damaged})
            is_marked = bool(damaged)
    except LakeError as error:
        if not is_marked:  # else the catalog cannot be made of damaged files, which is reported anyway
            terminal.print_problem(str(error), label="note")
        return False
    return True


def _advise(root: Path, manifest: Manifest) -> str:
    """Return the command that makes damaged files again."""
    source = quote_shell(manifest.ingested_from[-1]) if manifest.ingested_from else "SOURCE"
    origin = find_origin(root)
    lake = quote_shell(root if origin is None else origin.address)
    return f"They are made again by `tracklake run {source} --lake {lake}`."
