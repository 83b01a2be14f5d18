"""Drive score: errors and warnings of constant turn rate and velocity on the evaluation part of the drives."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from tracklake.pipeline.lake import LakeFile, Manifest, scan
from tracklake.pipeline.lake.files import MODELS
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.schemas import DRIVES, SURROUNDING, SURROUNDING_TRUTH
from tracklake.schemas.documents import read_json
from tracklake.schemas.errors import TracklakeError
from tracklake.schemas.protocols import V2V
from tracklake.schemas.text import quote_shell

FOLDER = "onboard"
"""Folder of the runs on drives, among the lake's runs: apart from those on tracks seen from above."""
NAME = "drive_score"


class DriveTables(NamedTuple):
    """Tables of all drives that predictions are made from."""

    surrounding: pl.DataFrame
    truth: pl.DataFrame
    drives: pl.DataFrame


def read_drives(root: Path, manifest: Manifest) -> DriveTables:
    """Read what the drives of a lake perceived.

    Raises:
        TracklakeError: there is no drive in the lake, or the vehicles around the egos have not been estimated.
    """
    found = DriveTables(*(scan(root, manifest, table).collect() for table in (SURROUNDING, SURROUNDING_TRUTH, DRIVES)))
    if found.drives.is_empty():
        raise TracklakeError(
            f"{root}: no drive in this lake. `tracklake run FOLDER --lake {quote_shell(root)}` reads the logs of an "
            "instrumented vehicle; `tracklake instrument` makes such logs from a recording seen from above"
        )
    if found.surrounding.is_empty():
        raise TracklakeError(
            f"{root}: the drives hold no vehicle around the ego, by messages or by LiDAR; `tracklake run --lake "
            f"{quote_shell(root)}` makes the table `surrounding` where it is missing"
        )
    return found


def build(reader: LakeReader, settings: Settings) -> StageResult:
    """Score the model that needs no training and write it as a run; a note says why where that is impossible."""
    from tracklake.training.onboard.samples import build_samples, split_samples
    from tracklake.training.onboard.training import score_untrained

    tables = DriveTables(*(reader.table(table) for table in (SURROUNDING, SURROUNDING_TRUTH, DRIVES)))
    built = build_samples(*tables)
    try:
        parts = split_samples(built.samples, settings.split_seed)
    except TracklakeError as few:
        return StageResult(notes=[f"no score of the drives: {few}"])
    out = reader.root / MODELS / FOLDER / "ctrv"
    metrics = score_untrained(parts, built.left_out, out)
    files = [
        LakeFile(file.relative_to(reader.root).as_posix(), None, file.stat().st_size) for file in sorted(out.iterdir())
    ]
    return StageResult(files={MODELS: files}, info={"split": parts.digest, "samples": metrics["evaluation"]["samples"]})


STAGE = Stage(
    name=NAME,
    meaning="Score constant turn rate and velocity on drives.",
    scope="lake",
    after=(INGEST, "fuse"),
    settings=("split_seed", lambda _settings: {"protocol": V2V.digest}),
    version=1,
    build=build,
)


def list_finished_drive_runs(root: Path) -> list[Path]:
    """Return metrics.json of every run on drives, sorted by name; unfinished ones are hidden and left out."""
    return sorted((root / MODELS / FOLDER).glob("[!.]*/metrics.json"))


def collect_drive_scores(root: Path, manifest: Manifest, skip: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return the scores of runs on the lake's drives, by model: {model, part, rows: [...], warnings: {...}}.

    Rows are those of `training.onboard.scores.OnboardScore` over all samples, one per horizon. Runs of other drives are
    left out; `skip` is called with a message for each that is damaged.
    """
    commit = manifest.commits.get(NAME)
    scores = []
    for path in list_finished_drive_runs(root) if commit is not None else ():
        try:
            evaluation = read_json(path)["evaluation"]
            rows = [row for row in evaluation["scores"] if row["stratum"] == "all"]
            found = {"model": path.parent.name, "part": "eval", "rows": rows, "warnings": evaluation["warnings"]}
            if commit is not None and evaluation["split"] == commit.info.get("split"):
                scores.append(found)
        except (OSError, ValueError, LookupError, TypeError) as damaged:
            skip(f"skipped a run: {path}: expected scores on drives, got {damaged!r}; train it again")
    return scores
