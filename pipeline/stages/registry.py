"""The stages after ingestion, in the order in which `tracklake run` goes through them."""

from tracklake.pipeline.stages import assess, pages, repair, report, samples, score, split, tensors, validate
from tracklake.pipeline.stages.stage import Stage

STAGES: tuple[Stage, ...] = (
    Stage("validate", "Check every entry against the rules.", validate.plan, validate.build),
    Stage("repair", "Find late starts and estimate what is missing of them.", repair.plan, repair.build),
    Stage("assess", "Measure the estimates on tracks cut on purpose.", assess.plan, assess.build),
    Stage("samples", "Draw samples with maneuvers and neighbors.", samples.plan, samples.build),
    Stage("split", "Divide the subsets into train and eval.", split.plan, split.build),
    Stage("tensors", "Write the split as flat arrays.", tensors.plan, tensors.build),
    Stage("score", "Score the constant-velocity baseline.", score.plan, score.build),
    Stage("pages", "Draw the report's page of each subset.", pages.plan, pages.build),
    Stage("report", "Write the quality report.", report.plan, report.build),
)

STAGE_BY_NAME = {stage.name: stage for stage in STAGES}
