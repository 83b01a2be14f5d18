"""Recorded excerpts before and after the reconstruction: accelerations and jerk, beside published figures."""

import tempfile
from pathlib import Path

import numpy as np
from reconstruction_data import Recording, apply_reconstruction, build_scene, ingest, read_tables
from reconstruction_methods import Motion
from reconstruction_scores import Scene, count_jerk_changes

from tracklake.pipeline.transforms.reconstruction.config import ReconstructionConfig
from tracklake.quality_reports.published import TOTALS, list_published
from tracklake.schemas.arrays import Floats

EXCERPTS = {
    "ngsim/us101_0750_290_vehicles.csv.gz": "US-101, 07:50, 290 vehicles",
    "i80_coifman_li_2017/trajectories-i80-1600-1615.csv.gz": "I-80, 16:00, of Coifman and Li (2017)",
}
"""Files below the folder of excerpts, and what they are."""
HIGH_MPS2 = 3.0
"""Acceleration, of either sign, whose share is stated, in m/s2."""
RATE_HZ = 10.0
LARGE_MPS3 = 15.0
"""Jerk, of either sign, whose share is stated, in m/s3."""
ARTICLE = "I-80, NGSIM's own: published (J. Adv. Transp. 2023, 2661136, table 2)"
PUBLISHED_LINES = (
    f"| {ARTICLE} | recorded | - | - | - | - | - | 22.8% | 75.2% | - | - |",
    f"| {ARTICLE} | filtered | - | - | - | - | - | 0.2% | 13.5% | - | - |",
)
"""Means over vehicles in the Journal of Advanced Transportation 2023, article 2661136."""
PUBLISHED = "us-101-0750"
"""Recording with published figures."""


def render_excerpts(folder: Path) -> str:
    """Render a table of the excerpts that are there."""
    lines = [
        "| recording | | entries | beyond 3 m/s² | above 3.05 m/s² | exactly 0 | jerk sign changes, 1/s | "
        "jerk beyond 15 m/s³ | seconds with two changes | backward | overlaps |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, title in EXCERPTS.items():
        if (folder / name).exists():
            lines += _compare_excerpt(folder / name, title)
    counts = {row["recording"]: row["acceleration_entries"] for row in list_published()}
    entries, total = counts[PUBLISHED] or 0, TOTALS[PUBLISHED][1]
    lines.append(
        f"| US-101, 07:50, all 2,169 vehicles: published (Hamalainen 2020) | recorded | {total:,} | - | "
        f"{entries / total:.1%} | - | - | - | - | - | - |"
    )
    lines += PUBLISHED_LINES
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
    return [
        *(f"{np.mean(each):.1%}" for each in shares),
        f"{changes.sum() / seconds.sum():.2f}",
        *(f"{each:.1%}" for each in _measure_jerk(motion.accel, scene)),
        backward,
        _count_overlaps(motion.x, scene),
    ]


def _measure_jerk(accel: Floats, scene: Scene) -> tuple[float, float]:
    """Return means over vehicles of shares: of large jerks, and of seconds in which the jerk changes its sign twice."""
    run = np.repeat(np.arange(len(scene.runs.begins)), scene.runs.lengths)
    steps = np.flatnonzero(np.diff(run) == 0)
    jerk = (accel[steps + 1] - accel[steps]) * scene.runs.rate_hz
    vehicle = scene.vehicle[steps]
    large = np.bincount(vehicle, np.abs(jerk) > LARGE_MPS3) / np.bincount(vehicle)
    windows = (steps - scene.runs.begins[run[steps]]) // int(scene.runs.rate_hz)
    moves = np.flatnonzero(jerk)
    turns = moves[1:][(np.diff(np.sign(jerk[moves])) != 0) & (np.diff(run[steps[moves]]) == 0)]
    _, first, window = np.unique(run[steps] * len(run) + windows, return_index=True, return_inverse=True)
    several = np.bincount(window[turns], minlength=len(first)) > 1
    number = vehicle[first]
    return float(large.mean()), float((np.bincount(number, several) / np.bincount(number)).mean())


def _count_overlaps(x: Floats, scene: Scene) -> str:
    """Count entries whose front is nearer to their recorded leader's than its length, and vehicles that have some."""
    led = np.flatnonzero((scene.leader >= 0) & (scene.leader_length > 0))
    if not led.size:
        return "-"
    near = led[x[scene.leader[led]] - scene.leader_length[led] < x[led]]
    return f"{near.size:,} of {led.size:,} ({len(np.unique(scene.vehicle[near]))} vehicles)"
