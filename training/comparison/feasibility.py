"""Feasibility of jointly predicted scenes: how often predictions break rules that recorded tracks are judged by.

All samples of a scene are predicted and put on the road together, and judged by the definitions of
`quality_reports.rules` at the ticks at which their true positions are known. The true positions of the same vehicles
and ticks break rules too, by errors of tracking and of lanes that are read from positions: their share is the floor.
"""

from collections.abc import Iterator

import numpy as np
import polars as pl

from tracklake.quality_reports.rules.motion import HIGH_JERK
from tracklake.quality_reports.rules.place import NEGATIVE_HEADWAY, OVERLAP
from tracklake.quality_reports.rules.scene import Scene
from tracklake.quality_reports.rules.within_frames import measure_overlaps, sort_rows
from tracklake.schemas.arrays import Flags, Floats, Integers
from tracklake.schemas.comparisons import ANY_RULE, FEASIBILITY, FEASIBILITY_RULES
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.comparison.bootstrap import estimate_shares
from tracklake.training.data.gathers import NEAREST, locate_rows, read_samples, select_ego_truth
from tracklake.training.data.tensor_folder import TensorFolder
from tracklake.training.evaluation.scores import find_vehicles
from tracklake.training.runs.forecasters import Forecaster

BATCH_SIZE = 1024
"""Least number of samples that are judged at once; a scene is never divided."""
JERK_TICKS = 3
"""Last observed positions to which a prediction is joined, so that jerk is judged from its first tick on."""


def measure_feasibility(model: Forecaster, folder: TensorFolder, part: str, nearest: int = NEAREST) -> pl.DataFrame:
    """Measure how many predictions, and scenes, break rules up to each horizon: rows of `FEASIBILITY`."""
    samples = folder.samples_of(part)
    scene = folder.scene_of_sample[samples].astype(np.int64)
    order = np.argsort(scene, kind="stable")
    samples, scene = samples[order], scene[order]
    ticks, rate_hz = np.array(folder.protocol.scored_ticks), folder.protocol.rate_hz
    broken: list[Flags] = []
    true: list[Flags] = []
    squares: list[Floats] = []
    for batch in _cut_scenes(scene):
        observed, truth = read_samples(folder, samples[batch], model.reads, nearest=nearest)
        own = select_ego_truth(truth)
        predicted = model.predictor.predict(observed).position_m
        history = observed.history if observed.history.ndim == 3 else observed.history[:, 0]
        for position, found in ((predicted, broken), (own.future, true)):
            path = np.concatenate([history[:, -JERK_TICKS:], position], axis=1)
            flags = find_violations(folder, samples[batch], scene[batch], path, own.future_mask)
            found.append(np.logical_or.accumulate(flags, axis=1)[:, ticks - 1])
        error = predicted[:, ticks - 1].astype(np.float64) - own.future[:, ticks - 1]
        squares.append(np.where(own.future_mask[:, ticks - 1], (error**2).sum(axis=-1), np.nan))
    subset, vehicle = find_vehicles(folder, samples)
    rmse, rules = np.sqrt(np.nanmean(np.concatenate(squares), axis=0)), list(FEASIBILITY_RULES)
    if folder.lane_centred[subset].any():  # the carriageway's edges mean nothing there
        rmse[:] = np.nan
        rules.remove("off_road")
    judged = [FEASIBILITY_RULES.index(rule) for rule in rules]
    numbers = (np.unique(scene, return_inverse=True)[1], vehicle)
    seconds = [tick / rate_hz for tick in ticks.tolist()]
    both = (np.concatenate(broken)[..., judged], np.concatenate(true)[..., judged])
    return _summarise(model.name, seconds, rules, both, numbers, rmse)


def _cut_scenes(scene: Integers) -> Iterator[slice]:
    """Cut samples, sorted by their scenes (B,), into batches of whole scenes."""
    begins = np.append(np.flatnonzero(np.diff(scene, prepend=-1)), len(scene))
    first = 0
    while first < len(scene):
        end = int(begins[min(int(np.searchsorted(begins, first + BATCH_SIZE)), len(begins) - 1)])
        yield slice(first, end)
        first = end


def find_violations(folder: TensorFolder, samples: Integers, scene: Integers, path_m: Floats, known: Flags) -> Flags:
    """Find which rule each sample breaks at each tick: (B, F, rules) in the order of FEASIBILITY_RULES.

    Args:
        folder: the tensors.
        samples: (B,) numbers of the samples.
        scene: (B,) their scenes.
        path_m: (B, JERK_TICKS + F, 2) last observed and future positions, relative to the last observed one.
        known: (B, F) ticks that are judged.
    """
    row = folder.sample_row[samples]
    run = folder.runs_of(row)
    subset = folder.run_subset[run]
    place_m = locate_rows(folder, row).astype(np.float64)[:, None] + path_m[:, JERK_TICKS:]
    jerk = np.round(np.diff(path_m[..., 0].astype(np.float64), n=3, axis=1) * folder.protocol.rate_hz**3, 3)
    width_m = np.array([own["width_m"] for own in folder.index["subsets"]])[subset]
    off_road = (place_m[..., 1] < 0) | (place_m[..., 1] > width_m[:, None])
    number, tick = np.nonzero(known)
    entries = pl.DataFrame(
        {
            "vehicle_id": number,
            "frame": np.unique(scene, return_inverse=True)[1][number] * known.shape[1] + tick,
            "x_m": place_m[known][:, 0],
            "y_m": place_m[known][:, 1],
            "lane": _find_lanes(folder, subset, place_m[..., 1])[known],
        },
        schema_overrides={"vehicle_id": pl.Int32, "frame": pl.Int32},
    ).with_columns(heading_rad=pl.lit(None, pl.Float32))
    overlap, headway = (np.zeros(known.shape, dtype=np.bool_) for _ in range(2))
    overlap[known], headway[known] = _judge_places(entries, folder.run_length_m[run], folder.run_width_m[run])
    high_jerk = np.abs(jerk) > HIGH_JERK.defaults["high_jerk_mps3"]
    found: Flags = np.stack([overlap, headway, high_jerk & known, off_road & known], axis=-1)
    return found


def _judge_places(entries: pl.DataFrame, length_m: Floats, width_m: Floats) -> tuple[Flags, Flags]:
    """Judge entries (N,) of vehicles by overlap and by the headway to the next vehicle ahead in the lane."""
    unknown = pl.lit(None, pl.Float32)
    vehicles = pl.DataFrame(
        {"vehicle_id": np.arange(len(length_m)), "length_m": length_m, "width_m": width_m},
        schema_overrides={"vehicle_id": pl.Int32},
    ).with_columns(pl.lit(None, pl.String).alias("class"), length_range_m=unknown, width_range_m=unknown)
    scene = Scene(entries, vehicles, frame_rate_hz=1.0)
    overlap = measure_overlaps(scene) > OVERLAP.defaults["overlap_m"]
    rows = sort_rows(scene.frame, scene.lane, scene.x_units, scene.track)  # abreast: by vehicle
    own, ahead = rows[:-1], rows[1:]
    beside = (scene.frame[own] == scene.frame[ahead]) & (scene.lane[own] == scene.lane[ahead]) & (scene.lane[own] > 0)
    x_m = entries["x_m"].to_numpy()
    gap_m = np.round(x_m[ahead] - scene.trait("length_m")[scene.track[ahead]] - x_m[own], 3)
    headway = np.zeros(len(rows), dtype=np.bool_)
    headway[own] = beside & (gap_m < NEGATIVE_HEADWAY.defaults["negative_headway_m"])
    return overlap, headway


def _find_lanes(folder: TensorFolder, subset: Integers, y_m: Floats) -> Integers:
    """Find lanes from lateral positions (B, F): by the markings, else NOMINAL_LANE_M wide; 0 off the road."""
    lane: Integers = np.zeros(y_m.shape, dtype=np.int64)
    for number in np.unique(subset):
        named = folder.index["subsets"][number]
        markings = named["lane_markings_m"] or np.arange(named["last_lane"] + 1) * NOMINAL_LANE_M
        of = subset == number
        found = np.searchsorted(markings, y_m[of], side="right")
        lane[of] = np.where(found < len(markings), found, 0)
    return lane


def _summarise(
    run: str,
    seconds: list[float],
    rules: list[str],
    judged: tuple[Flags, Flags],
    numbers: tuple[Integers, Integers],
    rmse_m: Floats,
) -> pl.DataFrame:
    """Summarise which predictions and true futures, `judged` (B, T, rules), of scenes and vehicles break rules."""
    scene, vehicle = numbers
    scenes = int(scene.max(initial=-1)) + 1
    rows = []
    for at, ahead in enumerate(seconds):
        both = [np.column_stack([own[:, at], own[:, at].any(axis=1)]) for own in judged]
        share, low, high, n, _ = estimate_shares(both[0], vehicle)
        in_scenes = []
        for own in both:
            hit = np.zeros((scenes, own.shape[1]), dtype=np.bool_)
            np.logical_or.at(hit, scene, own)
            in_scenes.append(hit.mean(axis=0))
        figures = {"share": share, "low": low, "high": high, "true_share": both[1].mean(axis=0)}
        figures |= dict(zip(("scene_share", "true_scene_share"), in_scenes, strict=True))
        constant = {"run": run, "seconds": ahead, "n": n, "scenes": scenes, "rmse_m": rmse_m[at]}
        rows.append(
            pl.DataFrame({"rule": (*rules, ANY_RULE), **figures}).with_columns(
                pl.lit(value).alias(name) for name, value in constant.items()
            )
        )
    return FEASIBILITY.conform(pl.concat(rows).fill_nan(None).lazy()).sort(FEASIBILITY.key).collect()
