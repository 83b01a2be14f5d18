"""Recorded excerpts before and after the reconstruction: accelerations and jerk, beside published figures."""

import tempfile
from pathlib import Path

import numpy as np
from reconstruction_data import Recording, apply_reconstruction, build_scene, ingest, read_tables
from reconstruction_methods import Motion
from reconstruction_scores import Scene, count_jerk_changes

from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.quality_reports.published import TOTALS, list_published

EXCERPTS = {
    "ngsim/us101_0750_290_vehicles.csv.gz": "US-101, 07:50, 290 vehicles",
    "i80_coifman_li_2017/trajectories-i80-1600-1615.csv.gz": "I-80, 16:00, of Coifman and Li (2017)",
}
"""Files below the folder of excerpts, and what they are."""
HIGH_MPS2 = 3.0
"""Acceleration, of either sign, whose share is stated, in m/s2."""
RATE_HZ = 10.0
PUBLISHED = "us-101-0750"
"""Recording with published figures."""


def render_excerpts(folder: Path) -> str:
    """Render a table of the excerpts that are there."""
    lines = [
        "| recording | | entries | beyond 3 m/s² | above 3.05 m/s² | exactly 0 | jerk sign changes, 1/s | backward |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, title in EXCERPTS.items():
        if (folder / name).exists():
            lines += _compare_excerpt(folder / name, title)
    counts = {row["recording"]: row["acceleration_entries"] for row in list_published()}
    entries, total = counts[PUBLISHED] or 0, TOTALS[PUBLISHED][1]
    lines.append(
        f"| US-101, 07:50, all 2,169 vehicles: published (Hamalainen 2020) | recorded | {total:,} | - | "
        f"{entries / total:.1%} | - | - | - |"
    )
    return "\n".join(lines)


def _compare_excerpt(file: Path, title: str) -> list[str]:
    """Reconstruct an excerpt; returns a row of the table before and one after."""
    with tempfile.TemporaryDirectory() as inside:
        ingest(file, Path(inside) / "lake")
        tables = read_tables(Path(inside) / "lake", RATE_HZ)
    lines = []
    for tracks, vehicles, facts in tables:
        # Nothing is known of the truth: the recorded values stand in for it, and no error is computed.
        scene = build_scene(tracks, vehicles, tracks, [], RATE_HZ)
        after = apply_reconstruction(Recording(tracks, vehicles, facts, scene), ReconstructionConfig())
        for when, motion in (("recorded", scene.recorded), ("reconstructed", after)):
            lines.append(f"| {title} | {when} | {tracks.height:,} | {' | '.join(_measure(motion, scene))} |")
    return lines


def _measure(motion: Motion, scene: Scene) -> list[str]:
    """Measure shares of accelerations, changes of the jerk's sign per second, and the share of backward motion."""
    shares = (
        np.abs(motion.accel) > HIGH_MPS2,
        motion.accel > 3.05,
        motion.accel == 0,
    )
    changes, seconds = count_jerk_changes(motion.accel, scene)
    backward = f"{np.mean(motion.speed < 0):.2%}"
    return [*(f"{np.mean(each):.1%}" for each in shares), f"{changes.sum() / seconds.sum():.2f}", backward]
