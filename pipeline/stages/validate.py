"""Validate: findings of every rule, and which subsets are excluded."""

from pathlib import Path

import polars as pl

from pipeline.lake import Entry, LakeFile, Manifest, load, scan, write_table
from pipeline.settings import Settings
from pipeline.stages.base import Job, make_entry, make_job, recordings
from quality_reports.findings import find, judge_subset
from quality_reports.rules import RULES, resolve, select_broken
from schemas import FINDINGS, SUBSET_STATUS, TRACKS

VERSION = 1


def plan(_root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job per ingested recording."""
    thresholds = resolve(RULES, settings.thresholds)
    return [
        make_job(
            f"validate/{recording['dataset']}/{recording['recording']}",
            version_of_stage=VERSION,
            made_of={
                "ingest": recording["fingerprint"],
                "rules": [rule.name for rule in RULES],
                "thresholds": thresholds,
                "max_backward_share": settings.max_backward_share,
            },
            inputs={"dataset": recording["dataset"], "subsets": [item["subset"] for item in recording["subsets"]]},
        )
        for recording in recordings(manifest)
    ]


def build(root: Path, job: Job, settings: Settings) -> Entry:
    """Find what breaks rules in each subset of a recording, and judge the subset."""
    manifest, dataset = load(root), job.inputs["dataset"]
    files: dict[str, list[LakeFile]] = {}
    notes = []
    for subset in job.inputs["subsets"]:
        tracks = scan(root, manifest, TRACKS, dataset=dataset, subset=subset).collect()
        rules = select_broken(tracks, RULES, settings.thresholds)
        limits = {name: value for name, value in settings.thresholds.items() if any(name in r.defaults for r in rules)}
        findings = find(tracks, rules, limits)
        status = judge_subset(tracks, max_backward_share=settings.max_backward_share)
        values = {"dataset": dataset, "subset": subset}
        for table, frame in ((FINDINGS, findings), (SUBSET_STATUS, status)):
            written = write_table(root, table, frame, values, job.fingerprint, where=subset)
            files.setdefault(table.name, []).extend(written)
        reasons = status.filter(pl.col("excluded"))["excluded_reason"].to_list()
        notes += [f"{subset} is excluded from samples and splits: {reason}" for reason in reasons]
    return make_entry(job, files, {"notes": notes})
