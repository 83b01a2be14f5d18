"""The generated sample of the commands: written, found again, and kept out of lakes of real recordings.

Like the commands, it imports heavy libraries where they are used.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from tracklake.pipeline.cli.console import Terminal
    from tracklake.pipeline.ingest.discovery import Discovery
    from tracklake.pipeline.synthetic import SampleSummary

SAMPLE = "sample"
"""Its folder's name, beside the lake."""


def provide_sample(lake: Path, minutes: float | None, seed: int | None, terminal: "Terminal") -> Path:
    """The generated sample beside the lake, made where it is not there or asked for otherwise."""
    out = lake.parent / SAMPLE
    if minutes is None and seed is None and (out / "truth.parquet").exists():
        terminal.say(f"the generated sample in {out}", style="dim")
        return out
    summary = write_generated(out, minutes, seed, terminal)
    terminal.say(f"generated {summary.rows:,} rows of {summary.recordings} recordings in {out}", style="dim")
    return out


def refuse_mixing(lake: Path, discovery: "Discovery") -> None:
    """Keep simulated recordings out of a lake of real ones, which they might even replace."""
    from tracklake.pipeline.lake import LakeError, LakeMissingError, load
    from tracklake.pipeline.stages.stage import INGEST

    try:
        entries = load(lake).of_stage(INGEST)
    except LakeMissingError:
        return
    files = [file for _, unit in discovery.units for file in unit.files]
    ours, hashes = {file.name for file in files}, {file.sha256 for file in files}
    for source in (source for entry in entries for source in entry.built_from["sources"]):
        if source["file"] not in ours or source["sha256"] not in hashes:
            raise LakeError(
                f"{lake}: holds recordings that are not this generated sample ({source['file']}). Without SOURCE, the "
                "sample is what is ingested: name your own files as SOURCE, or another lake with --lake."
            )


def write_generated(
    out: Path, minutes: float | None, seed: int | None, terminal: "Terminal", formats: list[str] | None = None
) -> "SampleSummary":
    """Write the generated sample into a folder."""
    from tracklake.pipeline.synthetic import ALL_FORMATS, DEFAULT_FORMATS, DEFAULT_MINUTES, write_sample
    from tracklake.schemas.errors import explain_file_errors

    if unknown := [name for name in formats or () if name not in ALL_FORMATS]:
        raise typer.BadParameter(f"--format is one of {', '.join(ALL_FORMATS)}; got {', '.join(unknown)}")
    with explain_file_errors(out):
        return write_sample(
            out,
            formats=tuple(formats) if formats else DEFAULT_FORMATS,
            minutes=DEFAULT_MINUTES if minutes is None else minutes,
            seed=1 if seed is None else seed,
            progress=lambda text: terminal.say(text, style="dim"),
        )
