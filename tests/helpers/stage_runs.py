"""Stages after ingestion, run in this process as the flows run them, without Prefect."""

from pathlib import Path

from tracklake.pipeline.lake import Commit, load, open_for_writing
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.registry import STAGE_BY_NAME, STAGES
from tracklake.pipeline.stages.stage import Job, Stage


def plan_stage(root: Path, name: str, settings: Settings, stages: tuple[Stage, ...] = STAGES) -> list[Job]:
    """All jobs of a stage, done or not."""
    return Planner(root, load(root), settings, stages).plan(name)


def find_outstanding(root: Path, name: str, settings: Settings, stages: tuple[Stage, ...] = STAGES) -> list[str]:
    """Keys of what the stage would make."""
    return [job.key for job in Planner(root, load(root), settings, stages).find_outstanding(name)[0]]


def run_stage(
    root: Path, name: str, settings: Settings, *keys: str, stages: tuple[Stage, ...] = STAGES
) -> list[Commit]:
    """Make what is not made (only some of it where keys are given) and remove what is stale; returns the commits."""
    (stage,) = (stage for stage in stages if stage.name == name)
    made = []
    with open_for_writing(root) as writer:
        jobs, stale = Planner(root, writer.manifest, settings, stages).find_outstanding(name)
        writer.remove(stale)
        for job in jobs:
            if not keys or job.key in keys:
                made.append(build_job(stage, root, job, settings))
                writer.commit(made[-1])
    return made


def build_one(root: Path, job: Job, settings: Settings) -> Commit:
    """Build one job of a registered stage, by the stage's name in its key; nothing is committed."""
    return build_job(STAGE_BY_NAME[job.key.partition("/")[0]], root, job, settings)
