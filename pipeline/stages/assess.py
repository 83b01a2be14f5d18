"""Assess: how good the estimates of missing starts are, measured on whole tracks that are cut on purpose."""

from pathlib import Path

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, load, scan, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import repair
from tracklake.pipeline.stages.stage import Job, make_commit, make_job, recordings, upstream
from tracklake.pipeline.transforms.starts.assessment import assess_starts
from tracklake.schemas import START_ASSESSMENTS, START_CUTOFFS, SUBSETS, TRACKS, VEHICLE_STARTS

VERSION = 1


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job per freeway recording; repair comes before."""
    repaired = upstream(repair.plan, root, manifest, settings)
    return [
        make_job(
            f"assess/{recording['dataset']}/{recording['recording']}",
            version_of_stage=VERSION,
            made_of={"repair": repaired[f"repair/{recording['dataset']}/{recording['recording']}"]},
            inputs={"dataset": recording["dataset"], "subsets": [item["subset"] for item in recording["subsets"]]},
        )
        for recording in recordings(manifest, freeway_only=True)
    ]


def build(root: Path, job: Job, _settings: Settings) -> Commit:
    """Cut the fully tracked vehicles' tracks and hold the estimates against what was cut off."""
    manifest, dataset = load(root), job.inputs["dataset"]
    files: dict[str, list[LakeFile]] = {}
    for subset in job.inputs["subsets"]:
        values = {"dataset": dataset, "subset": subset}
        facts = scan(root, manifest, SUBSETS, **values).collect().row(0, named=True)
        table = assess_starts(
            scan(root, manifest, TRACKS, **values).select("vehicle_id", "frame", "x_m", "lane", "speed_mps").collect(),
            scan(root, manifest, VEHICLE_STARTS, **values).collect(),
            dataset=dataset,
            subset=subset,
            cutoff_m=scan(root, manifest, START_CUTOFFS, **values).collect()["cutoff_m"][0],
            first_frame=facts["first_frame"],
            frame_rate_hz=facts["frame_rate_hz"],
        )
        written = write_table(root, START_ASSESSMENTS, table, values, job.fingerprint, where=subset)
        files.setdefault(START_ASSESSMENTS.name, []).extend(written)
    return make_commit(job, files, {})
