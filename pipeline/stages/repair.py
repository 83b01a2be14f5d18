"""Repair: where tracks should begin, which begin late, and the frames that are missing of those."""

from pathlib import Path

from tracklake.pipeline.lake import Entry, LakeFile, Manifest, load, scan, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.stage import Job, make_entry, make_job, recordings
from tracklake.pipeline.transforms.starts.late_starts import classify_starts, estimate_missing_starts
from tracklake.schemas import MISSING_STARTS, START_CUTOFFS, SUBSETS, TRACKS, VEHICLE_STARTS, VEHICLES

VERSION = 2


def plan(_root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job per freeway recording."""
    return [
        make_job(
            f"repair/{recording['dataset']}/{recording['recording']}",
            version_of_stage=VERSION,
            made_of={"ingest": recording["fingerprint"], "on_ramp_lanes": settings.on_ramp_lanes},
            inputs={"dataset": recording["dataset"], "subsets": [item["subset"] for item in recording["subsets"]]},
        )
        for recording in recordings(manifest, freeway_only=True)
    ]


def build(root: Path, job: Job, settings: Settings) -> Entry:
    """Judge every vehicle's start and estimate what is missing of the late ones."""
    manifest, dataset = load(root), job.inputs["dataset"]
    files: dict[str, list[LakeFile]] = {}
    late = 0
    for subset in job.inputs["subsets"]:
        values = {"dataset": dataset, "subset": subset}
        tracks = scan(root, manifest, TRACKS, **values).collect()
        vehicles = scan(root, manifest, VEHICLES, **values).collect()
        facts = scan(root, manifest, SUBSETS, **values).collect().row(0, named=True)
        on_ramps = settings.on_ramp_lanes.get(facts["site"], facts["on_ramp_lanes"])
        starts, cutoffs = classify_starts(
            vehicles,
            dataset=dataset,
            subset=subset,
            first_frame=facts["first_frame"],
            frame_rate_hz=facts["frame_rate_hz"],
            on_ramp_lanes=tuple(on_ramps),
        )
        missing = estimate_missing_starts(
            tracks,
            starts,
            dataset=dataset,
            subset=subset,
            cutoff_m=cutoffs["cutoff_m"][0],
            first_frame=facts["first_frame"],
            frame_rate_hz=facts["frame_rate_hz"],
        )
        for table, frame in ((VEHICLE_STARTS, starts), (START_CUTOFFS, cutoffs), (MISSING_STARTS, missing)):
            written = write_table(root, table, frame, values, job.fingerprint, where=subset)
            files.setdefault(table.name, []).extend(written)
        late += missing.height
    return make_entry(job, files, {"late": late})
