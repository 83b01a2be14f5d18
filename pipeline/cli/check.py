"""`tracklake check`: every file of the lake compared with its checksum."""

from collections.abc import Sequence
from pathlib import Path

import typer

from tracklake.pipeline.cli.command import FAILED, command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import JsonOption, LakeOption, QuietOption
from tracklake.pipeline.lake import (
    DamagedFile,
    LakeError,
    Manifest,
    find_damaged_files,
    is_settled,
    load,
    open_for_writing,
)
from tracklake.pipeline.lake.live_folders import find_false_copies
from tracklake.schemas.text import quote_shell


def check(lake: LakeOption = None, quiet: QuietOption = False, json: JsonOption = False) -> None:
    """Compare every live file with its checksum; what is damaged is made again by the next run.

    The catalog and the folders of tables are brought up to date where they do not agree with the manifest.
    """
    with command(quiet=quiet, json=json) as terminal:
        root = read_settings(lake=lake).lake
        manifest = load(root)
        copies = find_false_copies(root, manifest)
        for name in copies:
            terminal.print_problem(
                f"{root / name}: not the bytes of the live file, of which it is a copy", label="damaged"
            )
        if copies or not is_settled(root, manifest):
            outcome = "are up to date again" if _mend(root, terminal, copies=copies) else "were left so"
            terminal.print_line(f"catalog and folders did not agree with the manifest, and {outcome}")
        manifest = load(root)
        damaged = find_damaged_files(root, manifest)
        files = [file for commit in manifest.commits.values() for file in commit.all_files if file.sha256 is not None]
        size = sum(file.bytes for file in files)
        for file in damaged:
            terminal.print_problem(f"{root / file.path}: {file.reason}", label="damaged")
        terminal.print_json(
            {"lake": root, "files": len(files), "bytes": size, "damaged": [f._asdict() for f in damaged]}
        )
        if damaged:
            _mend(root, terminal, damaged)
            terminal.print_problem(f"{len(damaged)} of {len(files):,} files are damaged. {_advise(root, manifest)}")
            raise typer.Exit(FAILED)
        terminal.print_line(f"{len(files):,} files ({size / 1e6:,.1f} MB): all as they were written")


def _mend(root: Path, terminal: Terminal, damaged: Sequence[DamagedFile] = (), copies: Sequence[str] = ()) -> bool:
    """Record what is damaged, and end the session anew without some copies; returns whether it came to its end."""
    is_marked = False
    try:
        with open_for_writing(root) as writer:
            for name in copies:
                (root / name).unlink(missing_ok=True)
            writer.mark_damaged({file.key for file in damaged})
            is_marked = bool(damaged)
    except LakeError as error:
        if not is_marked:  # else the catalog cannot be made of damaged files, which is told anyway
            terminal.print_problem(str(error), label="note")
        return False
    return True


def _advise(root: Path, manifest: Manifest) -> str:
    """Return the command that makes damaged files again."""
    source = quote_shell(manifest.ingested_from[-1]) if manifest.ingested_from else "SOURCE"
    return f"They are made again by `tracklake run {source} --lake {quote_shell(root)}`."
