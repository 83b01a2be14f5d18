"""The stages after ingestion, in the order in which `tracklake run` goes through them."""

from tracklake.pipeline.stages import (
    assess,
    drive_findings,
    drive_pages,
    drive_score,
    fuse,
    pages,
    reconstruct,
    repair,
    report,
    revalidate,
    samples,
    score,
    split,
    tensors,
    traffic,
    validate,
)
from tracklake.pipeline.stages.stage import Stage

STAGES: tuple[Stage, ...] = (
    validate.STAGE,
    reconstruct.STAGE,
    revalidate.STAGE,
    repair.STAGE,
    assess.STAGE,
    traffic.STAGE,
    samples.STAGE,
    split.STAGE,
    tensors.STAGE,
    score.STAGE,
    fuse.STAGE,
    drive_findings.STAGE,
    drive_score.STAGE,
    pages.STAGE,
    drive_pages.STAGE,
    report.STAGE,
)
"""Every stage after ingestion."""

STAGE_BY_NAME = {stage.name: stage for stage in STAGES}
"""The stages by name."""
