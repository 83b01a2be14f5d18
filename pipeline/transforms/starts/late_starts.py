"""Late starts: tracks that start late, the frames missing before them, and entries with incomplete surroundings.

DESIGN section 6. Positions are never invented: the tables only state where something is missing.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.resample import find_stride
from tracklake.pipeline.transforms.starts.references import References
from tracklake.schemas.arrays import Flags, Floats, divide_sum, sum_exactly
from tracklake.schemas.missing_starts import MISSING_STARTS, START_CUTOFFS
from tracklake.schemas.vehicles import VEHICLE_STARTS

ELIGIBLE_AFTER_S = 1.0
"""Least time from the recording's first frame to a track's first entry that shows it was not yet on the road, in s."""
CUTOFF_STEP_M = 2.0
"""Step between candidates for the cut-off, in m."""
LEAST_REFERENCES = 10
"""Least number of references for a regression; with fewer the subset's mean speed is used."""
SIGMAS = 2.0
"""Margin of a missing start in standard deviations."""
REACH_M = 40.0
"""Distance along the road within which a missing vehicle is a would-be neighbor, in m."""
DRIVES_AT_ONCE = 1 << 22
"""Drives of references to late starts that are held at once; a longer subset's tracks are read again for the rest."""
ROUNDING_M = 1e-6
"""Tolerance of inclusive bounds, in m; far below the precision of a position (1 mm)."""


def find_cutoff(start_x_m: Floats) -> float | None:
    """Find the first c = 0, 2, 4 ... m with at least half of the starts at or before it and none in (c, c + 2].

    `start_x_m` are the first positions of the eligible tracks; None if there are none.
    """
    if not start_x_m.size:
        return None
    starts = np.sort(start_x_m)
    steps = math.ceil(max(float(starts[-1]), 0.0) / CUTOFF_STEP_M) + 1
    candidates = CUTOFF_STEP_M * np.arange(steps)
    at_or_before = np.searchsorted(starts, candidates, side="right")
    none_just_beyond = np.searchsorted(starts, candidates + CUTOFF_STEP_M, side="right") == at_or_before
    return float(candidates[np.argmax((2 * at_or_before >= starts.size) & none_just_beyond)])


def classify_starts(
    vehicles: pl.DataFrame,
    *,
    dataset: str,
    subset: str,
    first_frame: int,
    frame_rate_hz: float,
    on_ramp_lanes: tuple[int, ...] = (),
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Classify how each track of a subset begins, by the subset's own cut-off (DESIGN section 6, points 1, 2, 5).

    If no track is eligible there is no cut-off, and no vehicle is late, fully tracked or early. A vehicle without a
    lane is not on a ramp. For early vehicles see `_find_first_arrival`.

    `vehicles` have vehicle_id, first_frame, last_frame, entries, start_x_m, end_x_m, start_lane of one subset. Returns
    `vehicle_starts` (a row per vehicle) and `start_cutoffs` (one row).
    """
    after_s = (pl.col("first_frame") - first_frame) / frame_rate_hz
    on_ramp = pl.col("start_lane").is_in(list(on_ramp_lanes)).fill_null(value=False)
    starts = vehicles.sort("vehicle_id").with_columns(
        on_ramp=on_ramp, eligible=(after_s >= ELIGIBLE_AFTER_S) & ~on_ramp
    )
    cutoff_m = find_cutoff(starts.filter("eligible")["start_x_m"].to_numpy())
    beyond = pl.lit(value=False) if cutoff_m is None else pl.col("start_x_m") > cutoff_m
    without_gap = pl.col("entries") == pl.col("last_frame") - pl.col("first_frame") + 1
    starts = starts.with_columns(
        starts_late=pl.col("eligible") & beyond,
        fully_tracked=pl.col("eligible") & ~beyond & without_gap,
        tracked_from_within=~pl.col("on_ramp") & (after_s < ELIGIBLE_AFTER_S) & beyond,
    )
    road_seen_from_frame = _find_first_arrival(starts)
    vehicle_starts = starts.with_columns(
        pl.lit(dataset).alias("dataset"),
        pl.lit(subset).alias("subset"),
        early=(pl.col("first_frame") < road_seen_from_frame)
        if road_seen_from_frame is not None
        else pl.lit(value=False),
    )
    cutoffs = pl.DataFrame(
        {
            "dataset": [dataset],
            "subset": [subset],
            "cutoff_m": [cutoff_m],
            "eligible": [starts["eligible"].sum()],
            "late": [starts["starts_late"].sum()],
            "fully_tracked": [starts["fully_tracked"].sum()],
            "road_seen_from_frame": [road_seen_from_frame],
        },
        schema=START_CUTOFFS.dtypes,
    )
    return VEHICLE_STARTS.conform(vehicle_starts.lazy()).collect(), cutoffs


def _find_first_arrival(starts: pl.DataFrame) -> int | None:
    """Find the last frame of the first fully tracked vehicle that reached the section's end.

    Vehicles first seen before that frame are early: tracking began only at the entrance, so the road ahead of them was
    not yet recorded. None if tracking began everywhere, that is if a track (not first seen on a ramp) starts beyond
    the cut-off within the first second, and if no vehicle is fully tracked.

    The section's end is the median last position of the fully tracked vehicles; a track that ends more than 40 m
    before it (on a ramp, or when the recording ended) has not reached it.
    """
    if starts["tracked_from_within"].any():
        return None
    arrived = starts.filter("fully_tracked").filter(pl.col("end_x_m") >= pl.col("end_x_m").median() - REACH_M)
    frames = arrived.sort("first_frame", "last_frame").select("last_frame").to_series()
    return int(frames[0]) if len(frames) else None


def estimate_missing_starts(
    read_tracks: Callable[[], Iterable[pl.DataFrame]],
    vehicle_starts: pl.DataFrame,
    *,
    dataset: str,
    subset: str,
    cutoff_m: float | None,
    first_frame: int,
    frame_rate_hz: float,
) -> pl.DataFrame:
    """Estimate for each late start the frames between the cut-off and its first entry (DESIGN section 6, points 2, 3).

    For a late start at x: frames = b0 + b1 * speed by ordinary least squares over the fully tracked vehicles that
    reach x; frames = difference of the linearly interpolated first crossings of the cut-off and of x, speed = the
    recorded one of the nearer of the two entries around the crossing of x (the earlier one of two equally near).
    first_missing_frame = max(first_frame, floor(start_frame - max(1, estimate) - 2 sigma)), sigma the sample standard
    deviation of the references' frames.

    With fewer than 10 references (`method` = mean_speed) the estimate is (x - cutoff) / mean recorded speed of all the
    subset's entries, and sigma is that of the references, or a quarter of the estimate with fewer than 2. If that mean
    speed is not positive, all frames since the recording's first count as missing. If all references have the same
    speed the slope is 0; r2 is null if their frames do not vary.

    `read_tracks` yields vehicle_id, frame, x_m, lane, speed_mps of one subset, sorted by the first two, whole tracks
    that need not fit into memory together; `vehicle_starts` have vehicle_id, starts_late, fully_tracked. Without a
    cut-off there are no late starts. Returns rows of `missing_starts`.
    """
    late = vehicle_starts.filter("starts_late").select("vehicle_id")
    if cutoff_m is None or late.is_empty():
        return MISSING_STARTS.empty()
    firsts, speeds, entries = [], 0, 0
    for tracks in read_tracks():
        first = tracks.join(late, on="vehicle_id", how="semi").sort("vehicle_id", "frame")
        firsts.append(first.unique("vehicle_id", keep="first", maintain_order=True))
        speeds += sum_exactly(tracks["speed_mps"].to_numpy().astype(np.float64))
        entries += tracks.height
    first_entries = pl.concat(firsts).select(
        "vehicle_id", "lane", start_x_m="x_m", start_frame="frame", start_speed_mps="speed_mps"
    )
    mean_speed_mps = divide_sum(speeds, entries)
    rows = []
    at_once = max(1, DRIVES_AT_ONCE // max(1, int(vehicle_starts["fully_tracked"].sum())))
    for some in first_entries.iter_slices(at_once):
        drives = _measure_drives(read_tracks(), vehicle_starts, cutoff_m, some["start_x_m"].to_list())
        for start, drive in zip(some.iter_rows(named=True), drives, strict=True):
            by_mean_speed = (
                (start["start_x_m"] - cutoff_m) / mean_speed_mps * frame_rate_hz
                if mean_speed_mps > 0
                else float(start["start_frame"] - first_frame)
            )
            estimate = _estimate_start(*drive, start, by_mean_speed)
            margin = SIGMAS * estimate["frames_sigma"]
            first_missing = math.floor(start["start_frame"] - max(1.0, estimate["frames_estimated"]) - margin)
            names = {"dataset": dataset, "subset": subset, "cutoff_m": cutoff_m}
            rows.append({**names, **start, **estimate, "first_missing_frame": max(first_frame, first_missing)})
    return pl.DataFrame(rows, schema=MISSING_STARTS.dtypes)


def _measure_drives(
    batches: Iterable[pl.DataFrame], vehicle_starts: pl.DataFrame, cutoff_m: float, places_m: Sequence[float]
) -> list[tuple[Floats, Floats]]:
    """Measure for each place the frames from the cut-off to it and the speeds there, of all references."""
    found: list[list[tuple[Floats, Floats]]] = [[] for _ in places_m]
    for tracks in batches:
        references = References.from_tracks(tracks, vehicle_starts, cutoff_m)
        for drives, place_m in zip(found, places_m, strict=True):
            drives.append(references.measure_drives(place_m))
    joined = ([np.concatenate(parts) for parts in zip(*drives, strict=True)] for drives in found)
    return [(frames, speeds) for frames, speeds in joined]


def _estimate_start(frames: Floats, speeds: Floats, start: Mapping[str, Any], by_mean_speed: float) -> dict[str, Any]:
    """Estimate the missing frames of one start: the columns of `missing_starts` from `method` to the fit.

    `frames` and `speeds` are those of the references' drives to the start.
    """
    if frames.size >= LEAST_REFERENCES:
        fit = fit_frames(speeds, frames)
        estimate = fit["intercept_frames"] + fit["slope_frames_per_mps"] * start["start_speed_mps"]
    else:
        fit, estimate = {}, by_mean_speed
    return {
        "method": "regression" if fit else "mean_speed",
        "references": frames.size,
        "frames_estimated": estimate,
        "frames_sigma": float(frames.std(ddof=1)) if frames.size >= 2 else estimate / 4,
        **fit,
    }


def fit_frames(speed_mps: Floats, frames: Floats) -> dict[str, Any]:
    """Fit frames = b0 + b1 * speed by ordinary least squares: intercept_frames (b0), slope_frames_per_mps (b1), r2.

    The slope is 0 if the speeds do not vary; r2 is None if the frames do not.
    """
    frames_vary = float(np.ptp(frames)) > 0
    if not frames_vary or float(np.ptp(speed_mps)) == 0:  # else rounding errors of the mean would give a slope
        return {
            "intercept_frames": float(frames.mean()),
            "slope_frames_per_mps": 0.0,
            "r2": 0.0 if frames_vary else None,
        }
    centred = frames - frames.mean()
    slope = np.linalg.lstsq((speed_mps - speed_mps.mean())[:, np.newaxis], centred)[0][0]
    intercept = frames.mean() - slope * speed_mps.mean()
    residuals = frames - (intercept + slope * speed_mps)
    return {
        "intercept_frames": float(intercept),
        "slope_frames_per_mps": float(slope),
        "r2": float(1 - np.sum(residuals**2) / np.sum(centred**2)),
    }


def find_would_be_neighbors(
    clock: pl.DataFrame, missing_starts: pl.DataFrame, *, first_frame: int, frame_rate_hz: float, rate_hz: int
) -> Flags:
    """Find (N,) flags of entries on the clock that have a missing vehicle near them (DESIGN section 6, point 4).

    In its window the missing vehicle drives at constant speed from the cut-off (at first_missing_frame) to its first
    position (at start_frame), in its first lane. An entry with abs(dx) <= 40 m and abs(lane difference) <= 1 is a
    would-be neighbor; if either lane is unknown, abs(dx) decides alone. A tick between the window's last frame and
    start_frame belongs to the window, since the vehicle has no entry there.

    The clock has tick (0 at `first_frame`), x_m, lane, from `put_on_clock`; `missing_starts` are of the same subset.
    """
    near = np.zeros(clock.height, np.bool_)
    if missing_starts.is_empty() or clock.is_empty():
        return near
    stride = find_stride(frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    tick = clock["tick"].cast(pl.Int64).to_numpy()
    order = np.argsort(tick, kind="stable")
    tick = tick[order]
    x_m = clock["x_m"].to_numpy()
    lane = clock["lane"].cast(pl.Float32).fill_null(float("nan")).to_numpy()
    columns = ("first_missing_frame", "start_frame", "cutoff_m", "start_x_m", "lane")
    for missing, start, cutoff_m, start_x_m, start_lane in missing_starts.select(columns).iter_rows():
        ticks = (math.ceil((missing - first_frame) / stride), math.ceil((start - first_frame) / stride))
        begin, end = np.searchsorted(tick, ticks)
        rows = order[begin:end]
        elapsed = first_frame + tick[begin:end] * float(stride) - missing
        would_be_m = cutoff_m + (start_x_m - cutoff_m) * elapsed / (start - missing)
        within_reach = np.abs(x_m[rows] - would_be_m) <= REACH_M + ROUNDING_M
        lane_apart = np.abs(lane[rows] - (float("nan") if start_lane is None else start_lane))
        near[rows] |= within_reach & ~(lane_apart > 1)
    return near
