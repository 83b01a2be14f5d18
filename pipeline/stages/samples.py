"""Samples: prediction origins with maneuvers, the nearest and the grid's neighbors; every entry dropped by reason."""

from pathlib import Path
from typing import Any

from tracklake.pipeline.lake import Commit, LakeFile, Manifest, load, scan, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages import repair, validate
from tracklake.pipeline.stages.stage import Job, make_commit, make_job, recordings, upstream
from tracklake.pipeline.transforms.samples.selection import TRACK_COLUMNS, draw_samples
from tracklake.schemas import (
    FINDINGS,
    MISSING_STARTS,
    NEIGHBORS,
    SAMPLE_COUNTS,
    SAMPLE_DROPS,
    SAMPLES,
    SUBSET_STATUS,
    SUBSETS,
    TRACKS,
    VEHICLE_STARTS,
)

VERSION = 2


def plan(root: Path, manifest: Manifest, settings: Settings) -> list[Job]:
    """One job per freeway recording; validation and repair come before."""
    protocol = settings.get_protocol()
    validated = upstream(validate.plan, root, manifest, settings)
    repaired = upstream(repair.plan, root, manifest, settings)
    return [
        make_job(
            f"samples/{recording['dataset']}/{recording['recording']}",
            version_of_stage=VERSION,
            made_of={
                "ingest": recording["fingerprint"],
                "validate": validated[f"validate/{recording['dataset']}/{recording['recording']}"],
                "repair": repaired[f"repair/{recording['dataset']}/{recording['recording']}"],
                "protocol": protocol.sampling_digest,
            },
            inputs={"dataset": recording["dataset"], "subsets": [item["subset"] for item in recording["subsets"]]},
        )
        for recording in recordings(manifest, freeway_only=True)
    ]


def build(root: Path, job: Job, settings: Settings) -> Commit:
    """Draw the samples of a recording's subsets."""
    manifest, dataset = load(root), job.inputs["dataset"]
    files: dict[str, list[LakeFile]] = {}
    info: dict[str, Any] = {"samples": 0, "notes": []}
    for subset in job.inputs["subsets"]:
        values = {"dataset": dataset, "subset": subset}
        facts = scan(root, manifest, SUBSETS, **values).collect().row(0, named=True)
        drawn = draw_samples(
            scan(root, manifest, TRACKS, **values).select(TRACK_COLUMNS).collect(),
            scan(root, manifest, VEHICLE_STARTS, **values).collect(),
            scan(root, manifest, MISSING_STARTS, **values).collect(),
            scan(root, manifest, FINDINGS, **values).collect(),
            protocol=settings.get_protocol(),
            dataset=dataset,
            subset=subset,
            first_frame=facts["first_frame"],
            frame_rate_hz=facts["frame_rate_hz"],
            excluded=scan(root, manifest, SUBSET_STATUS, **values).collect()["excluded"][0],
        )
        for table, frame in (
            (SAMPLES, drawn.samples),
            (SAMPLE_DROPS, drawn.sample_drops),
            (SAMPLE_COUNTS, drawn.sample_counts),
            (NEIGHBORS, drawn.neighbors),
        ):
            written = write_table(root, table, frame, values, job.fingerprint, where=subset)
            files.setdefault(table.name, []).extend(written)
        info["samples"] += drawn.samples.height
        if drawn.samples.is_empty():
            reasons = drawn.sample_drops.sort("entries", descending=True)["reason"].to_list()
            info["notes"].append(f"{subset}: no samples ({', '.join(reasons) or 'no entries'})")
    return make_commit(job, files, info)
