"""`tracklake check`: every file of the lake compared with its checksum."""

import shlex
from pathlib import Path

import typer

from tracklake.pipeline.cli.command import FAILED, command, read_settings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, QuietOption
from tracklake.pipeline.lake import DamagedFile, LakeError, Manifest, is_settled, load, open_for_writing


def check(lake: LakeOption = None, quiet: QuietOption = False, json: JsonOption = False) -> None:
    """Compare every live file with its checksum; what is damaged is made again by the next run.

    The catalog and the folders of tables are brought up to date where the last session was broken off.
    """
    with command(quiet=quiet, json=json) as terminal:
        root = read_settings(lake=lake).lake
        manifest = load(root)
        settled = is_settled(root, manifest)
        damaged = _check_files(root)
        files = [file for commit in manifest.commits.values() for file in commit.all_files]
        size = sum(file.bytes for file in files)
        for file in damaged:
            terminal.print_problem(f"{root / file.path}: {file.reason}", label="damaged")
        terminal.print_json(
            {"lake": root, "files": len(files), "bytes": size, "damaged": [f._asdict() for f in damaged]}
        )
        if damaged:
            terminal.print_problem(f"{len(damaged)} of {len(files):,} files are damaged. {_advise(root, manifest)}")
            raise typer.Exit(FAILED)
        terminal.print_line(f"{len(files):,} files ({size / 1e6:,.1f} MB): all as they were written")
        if not settled:
            terminal.print_line("the last session had been broken off: catalog and folders are up to date again")


def _check_files(root: Path) -> list[DamagedFile]:
    """Check all files and mark what is damaged, in a session, whose end mends the catalog and the live folders."""
    damaged: list[DamagedFile] = []
    try:
        with open_for_writing(root) as writer:
            damaged = writer.mark_damaged()
    except LakeError:
        if not damaged:  # else the catalog cannot be made of damaged files, which is told anyway
            raise
    return damaged


def _advise(root: Path, manifest: Manifest) -> str:
    """Return the command that makes damaged files again."""
    source = shlex.quote(manifest.ingested_from[-1]) if manifest.ingested_from else "SOURCE"
    return f"They are made again by `tracklake run {source} --lake {shlex.quote(str(root))}`."
