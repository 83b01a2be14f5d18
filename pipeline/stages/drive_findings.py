"""Drive findings: what of a drive's messages and boxes breaks a rule."""

from typing import Any

from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.readers import SubsetReader
from tracklake.pipeline.stages.stage import INGEST, Stage, StageResult
from tracklake.quality_reports.rules.drive_findings import TICK_COLUMNS, Drive, judge_drive
from tracklake.quality_reports.rules.registry import DRIVE_RULES, resolve, select_thresholds
from tracklake.schemas import BSM, DRIVE_CHECKS, DRIVE_FINDINGS, EGO_STATES, SURROUNDING


def _describe_rules(settings: Settings) -> dict[str, Any]:
    thresholds = resolve(DRIVE_RULES, select_thresholds(DRIVE_RULES, settings.thresholds))
    return {"rules": [rule.name for rule in DRIVE_RULES], "thresholds": thresholds}


def build(reader: SubsetReader, settings: Settings) -> StageResult:
    """Find what breaks rules in a drive, and count what each rule was checked on."""
    drive = Drive(
        reader.scan(BSM).sort(BSM.key).collect(),
        reader.scan(SURROUNDING).select(TICK_COLUMNS).sort(SURROUNDING.key).collect(),
        reader.scan(EGO_STATES).sort(EGO_STATES.key).collect(),
    )
    findings, checks = judge_drive(drive, select_thresholds(DRIVE_RULES, settings.thresholds))
    return StageResult({DRIVE_FINDINGS: findings, DRIVE_CHECKS: checks})


STAGE = Stage(
    name="drive_findings",
    meaning="Check the messages and boxes of each drive against the rules.",
    scope="drive",
    after=(INGEST, "fuse"),
    settings=(_describe_rules,),
    version=1,
    build=build,
)
