"""Validate: findings of every rule, scores, and which subsets are excluded."""

from pathlib import Path

import polars as pl

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, load, scan, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import Job, make_commit, make_job, recordings
from tracklake.quality_reports.rules.evaluate import judge, tracks_needed
from tracklake.quality_reports.rules.findings import judge_subset
from tracklake.quality_reports.rules.registry import RULES, resolve
from tracklake.quality_reports.rules.scene import SUBSET_COLUMNS, VEHICLE_COLUMNS, Scene, find_lacking
from tracklake.schemas import FINDINGS, SUBSET_SCORES, SUBSET_STATUS, SUBSETS, TRACKS, VEHICLE_SCORES, VEHICLES

VERSION = 2


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


def build(root: Path, job: Job, settings: Settings) -> Commit:
    """Find what breaks rules in each subset of a recording, score it, and judge the subset."""
    manifest, dataset = load(root), job.inputs["dataset"]
    files: dict[str, list[LakeFile]] = {}
    notes = []
    for subset in job.inputs["subsets"]:
        values = {"dataset": dataset, "subset": subset}
        tracks, vehicles, facts = (
            scan(root, manifest, table, **values).select(columns).collect()
            for table, columns in (
                (TRACKS, tracks_needed()),
                (VEHICLES, ("vehicle_id", *VEHICLE_COLUMNS)),
                (SUBSETS, (*SUBSET_COLUMNS, "columns_missing")),
            )
        )
        frame_rate_hz, lane_markings_m = facts.select(SUBSET_COLUMNS).row(0)
        scene = Scene(tracks, vehicles, frame_rate_hz, lane_markings_m)
        judged = judge(scene, find_lacking(vehicles, facts), settings.thresholds)
        status = judge_subset(tracks, max_backward_share=settings.max_backward_share)
        tables = (
            (FINDINGS, judged.findings),
            (VEHICLE_SCORES, judged.vehicle_scores),
            (SUBSET_SCORES, judged.subset_scores),
            (SUBSET_STATUS, status),
        )
        for table, frame in tables:
            written = write_table(root, table, frame, values, job.fingerprint, where=subset)
            files.setdefault(table.name, []).extend(written)
        # That no NGSIM recording has lane markings is nothing to tell about each of them.
        lacking = [rule.name for rule in judged.unchecked if "lane_markings_m" not in rule.columns]
        if lacking:
            notes.append(f"{subset}: rules not checked, since the files lack what they read: {', '.join(lacking)}")
        reasons = status.filter(pl.col("excluded"))["excluded_reason"].to_list()
        notes += [f"{subset} is excluded from samples and splits: {reason}" for reason in reasons]
    return make_commit(job, files, {"notes": notes})
