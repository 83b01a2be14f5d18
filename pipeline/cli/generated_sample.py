"""The generated sample: written, found again, and kept out of lakes of other recordings."""

from pathlib import Path

from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.options import require_choice
from tracklake.pipeline.ingest.discovery import Discovery
from tracklake.pipeline.lake import LakeError, LakeMissingError, load
from tracklake.pipeline.stages.stage import INGEST
from tracklake.pipeline.synthetic import (
    ALL_FORMATS,
    DEFAULT_FORMATS,
    DEFAULT_MINUTES,
    DEFAULT_NOISE,
    DOSED,
    NOISE_MODELS,
    TRAFFICS,
    UNIFORM,
    SampleSummary,
    write_sample,
)
from tracklake.pipeline.synthetic.scenarios import DRIVES
from tracklake.schemas.errors import UsageError, explain_file_errors
from tracklake.schemas.extras import find_missing

SAMPLE = "sample"
"""Name of the generated sample's folder, beside the lake."""


def provide_sample(lake: Path, minutes: float | None, seed: int | None, terminal: Terminal) -> Path:
    """Return the folder of the generated sample, generated first where it is missing or options ask for another.

    Raises:
        UsageError: the lake is to be in that very folder.
    """
    out = lake.parent / SAMPLE
    if out.resolve() == lake.resolve():
        raise UsageError(
            f"--lake {lake}: the generated sample itself goes to this folder. Name another one for the lake, such as "
            f"--lake {lake.parent / 'lake'}."
        )
    if minutes is None and seed is None and (out / "truth.parquet").exists():
        terminal.print_line(f"the generated sample in {out}", style="dim")
        return out
    summary = write_generated(out, minutes, seed, terminal)
    terminal.print_line(f"generated {summary.rows:,} rows of {summary.recordings} recordings in {out}", style="dim")
    return out


def refuse_mixing(lake: Path, discovery: Discovery) -> None:
    """Refuse to add generated recordings to a lake of others, which they might replace."""
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
    out: Path,
    minutes: float | None,
    seed: int | None,
    terminal: Terminal,
    formats: list[str] | None = None,
    noise: list[str] | None = None,
    traffic: str = UNIFORM,
    defect: str | None = None,
    dose: float | None = None,
) -> SampleSummary:
    """Write the generated sample into a folder."""
    for name in formats or ():
        require_choice("--format", name, ALL_FORMATS)
    for name in noise or ():
        require_choice("--noise", name, NOISE_MODELS)
    require_choice("--traffic", traffic, TRAFFICS)
    if defect is not None:
        require_choice("--defect", defect, tuple(DOSED))
    if not formats and find_missing("onboard"):
        formats = [name for name in DEFAULT_FORMATS if name != DRIVES]
        terminal.print_line("without drives, which need the extra [onboard]", style="dim")
    with explain_file_errors(out):
        return write_sample(
            out,
            formats=tuple(formats) if formats else DEFAULT_FORMATS,
            minutes=DEFAULT_MINUTES if minutes is None else minutes,
            seed=1 if seed is None else seed,
            noise=tuple(noise) if noise else DEFAULT_NOISE,
            traffic=traffic,
            defect=defect,
            dose=dose,
            progress=lambda text: terminal.print_line(text, style="dim"),
        )
