"""Staleness: what in a lake is not as the next run would make it, and why."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tracklake.pipeline.ingest.discovery import Digests
from tracklake.pipeline.ingest.ingest import SOURCE_BY_NAME, VERSION
from tracklake.pipeline.lake import Commit, Manifest
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.settings.fields import DeclaredSettings
from tracklake.pipeline.stages.planner import Planner, find_recordings
from tracklake.pipeline.stages.registry import STAGE_BY_NAME, STAGES
from tracklake.pipeline.stages.stage import INGEST, Job, StageError

MAX_CHANGES = 3
"""Most changed settings that a reason names."""
DIGESTS = ("protocol",)
"""Values that are digests of several settings."""
OTHERWISE = "this version of tracklake makes it otherwise"


@dataclass(frozen=True)
class StageState:
    """The state of a stage in a lake.

    Args:
        stage: name of the stage.
        done: recordings (or 1 for a stage over the whole lake) that are up to date.
        possible: recordings it can work on.
        stale: what the next run makes again or for the first time, by recording, and why.
        note: what could not be compared.
    """

    stage: str
    done: int
    possible: int
    stale: dict[str, str]
    note: str = ""


def describe_stages(root: Path, manifest: Manifest, settings: Settings) -> list[StageState]:
    """Return the state of every stage, in the order of a run; a stage after a stale one is stale as well.

    Ingestion alone is no reason: raw files with another time of change may hold what they held.
    """
    planner = Planner(root, manifest, settings)
    states = [_describe_ingestion(root, manifest)]
    waiting: list[str] = []
    for stage in STAGES:
        # Pages and the report come after no stage, but show what all have made.
        shown = [name for name in waiting if manifest.of_stage(name)]
        before = [name for name in stage.list_inputs(settings) or shown if name in waiting]
        commits = {commit.key: commit for commit in manifest.of_stage(stage.name)}
        try:
            if before:
                raise StageError
            pending, left_over = planner.find_outstanding(stage.name)
        except StageError:
            stale = {commit.tail or stage.name: f"waits for {', '.join(before)}" for commit in commits.values()}
            states.append(
                StageState(stage.name, 0, len(commits), stale or {stage.name: f"waits for {', '.join(before)}"})
            )
            waiting.append(stage.name)
            continue
        stale = {job.tail or stage.name: _explain_job(job, commits.get(job.key)) for job in pending}
        stale |= {commits[key].tail or stage.name: "no longer made: what it is made of is gone" for key in left_over}
        possible = len(planner.plan(stage.name))
        states.append(StageState(stage.name, possible - len(pending), possible, stale))
        if stale:
            waiting.append(stage.name)
    return states


def _describe_ingestion(root: Path, manifest: Manifest) -> StageState:
    """Compare each recording with its raw files, by size and time of change, and with the readers' versions."""
    digests = Digests(root)
    commits = find_recordings(manifest)
    reasons = {commit.tail: _explain_recording(commit, digests) for commit in commits}
    stale = {tail: reason for tail, reason in reasons.items() if reason}
    gone = [path for commit in commits for path in _list_sources(commit) if not path.exists()]
    note = f"raw files that are not there are not compared: {len(gone)}, such as {gone[0]}" if gone else ""
    return StageState(INGEST, len(commits) - len(stale), len(commits), stale, note)


def _list_sources(commit: Commit) -> list[Path]:
    """Return the places of a recording's raw files; lakes of earlier versions do not know them."""
    return [Path(source["path"]) for source in commit.built_from["sources"] if "path" in source]


def _explain_recording(commit: Commit, digests: Digests) -> str:
    """Return why a recording is not as its raw files are; nothing where it is."""
    if not commit.fingerprint:
        return "its files in the lake are damaged"
    built_from = commit.built_from
    versions = built_from["stage_version"], built_from["source_version"]
    if versions != (VERSION, SOURCE_BY_NAME[commit.info["dataset"]].version):
        return OTHERWISE
    changed = [path for path in _list_sources(commit) if path.exists() and digests.has_changed(path)]
    return f"{changed[0]} has another size or time than when it was read" if changed else ""


def _explain_job(job: Job, commit: Commit | None) -> str:
    """Return why a stage's job has to be done."""
    if commit is None:
        return "not made yet"
    if not commit.fingerprint:
        return "its files are damaged"
    before, now = commit.built_from, job.built_from
    names = [
        name for name in {**before, **now} if name != "tracklake" and not _is_same(before.get(name), now.get(name))
    ]
    if not names:
        return "its files are missing or were changed"
    if {"stage_version", "schema_version"} & {*names}:
        return OTHERWISE
    had, has = before.get("commits", {}), now.get("commits", {})  # pages and the report show what these made
    others = {key.partition("/")[0] for key in {**had, **has} if had.get(key) != has.get(key)}
    stages = (INGEST, *STAGE_BY_NAME)
    made_again = [name for name in stages if name in others or (name in names and name in before and name in now)]
    settings = [name for name in names if name not in (*stages, "commits")]
    parts = [f"{', '.join(made_again)} was made again"] if made_again else []
    changes = [text for name in settings for text in _list_changes(name, _find(before, name), _find(now, name))]
    if changes:
        more = f" and {len(changes) - MAX_CHANGES} more" if len(changes) > MAX_CHANGES else ""
        parts.append(f"changed: {', '.join(changes[:MAX_CHANGES])}{more}")
    return "; ".join(parts)


def _find(values: Mapping[str, Any], name: str) -> object:
    """Return the value of a setting; one that a job does not name has its default."""
    declared = DeclaredSettings.model_fields.get(name)
    return values.get(name, None if declared is None else declared.default)


def _list_changes(name: str, before: object, now: object) -> list[str]:
    """Return what differs in a value: old and new, or the names in it where it is a table of many or a digest."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        inner = [key for key in {**before, **now} if not _is_same(before.get(key), now.get(key))]
        return [text for key in inner for text in _list_changes(f"{name}.{key}", before.get(key), now.get(key))]
    is_plain = name not in DIGESTS and all(
        value is None or isinstance(value, str | int | float) for value in (before, now)
    )
    return [f"{name} from {before} to {now}" if is_plain else name]


def _is_same(before: Any, now: Any) -> bool:  # noqa: ANN401  (values of several types)
    """Return whether two values are the same in the manifest, where tuples are lists."""
    return json.dumps(before, sort_keys=True, default=str) == json.dumps(now, sort_keys=True, default=str)
