"""How good the estimates of missing starts are: whole tracks are cut, and what is estimated is held against the truth.

DESIGN section 6, last paragraph. A fully tracked vehicle is taken as if it had first been seen at a known position; the
other fully tracked vehicles are its references, and its own track tells the truth about the part that was cut off.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.starts.estimators import ESTIMATES, Cut
from tracklake.pipeline.transforms.starts.references import Floats, Ints, References
from tracklake.schemas.start_assessments import START_ASSESSMENTS

POSITIONS_M = tuple(20.0 * number for number in range(1, 11))
"""Beyond the cut-off. Late starts of recordings are known up to 200 m; steps of 20 m show how estimates worsen with the
distance, and are long beside what a vehicle drives in a frame."""
TRACKS_AT_ONCE = 128
"""Cut tracks held against all references in one go: bounds the memory."""

CUT_SCHEMA = {
    "vehicle_id": pl.Int32,
    "beyond_m": pl.Float64,
    "start_frame": pl.Int64,
    "frames_true": pl.Float64,
    "first_true_frame": pl.Int64,
    "references": pl.Int64,
    "estimator": pl.String,
    "frames_estimated": pl.Float64,
    "margin_frames": pl.Float64,
    "first_missing_frame": pl.Int64,
}


def assess_starts(
    tracks: pl.DataFrame,
    vehicle_starts: pl.DataFrame,
    *,
    dataset: str,
    subset: str,
    cutoff_m: float | None,
    first_frame: int,
    frame_rate_hz: float,
) -> pl.DataFrame:
    """Measure coverage and excess of each estimator per start position, on tracks cut on purpose.

    Args:
        tracks: vehicle_id, frame, x_m, lane, speed_mps of one subset, sorted by vehicle_id, frame.
        vehicle_starts: vehicle_id, fully_tracked, from `classify_starts`.
        dataset: the subset's.
        subset: its name.
        cutoff_m: from `classify_starts`, of the whole tracks; None = nothing to assess.
        first_frame: the recording's first frame.
        frame_rate_hz: the source's.

    Returns:
        `start_assessments`; a position that no fully tracked vehicle reaches has no row.
    """
    cut = cut_and_estimate(
        tracks, vehicle_starts, cutoff_m=cutoff_m, first_frame=first_frame, frame_rate_hz=frame_rate_hz
    )
    missing = pl.col("start_frame") - pl.col("first_true_frame")
    covered = pl.col("start_frame") - pl.max_horizontal("first_missing_frame", "first_true_frame")
    excess = (pl.col("first_true_frame") - pl.col("first_missing_frame")).clip(lower_bound=0)
    error_s = (pl.col("frames_estimated") - pl.col("frames_true")) / frame_rate_hz
    some = pl.when(pl.col("frames_missing") > 0).then("frames_missing")
    table = (
        cut.group_by("estimator", "beyond_m")
        .agg(
            starts=pl.len(),
            starts_covered=(covered == missing).sum(),
            frames_missing=missing.sum(),
            frames_covered=covered.sum(),
            frames_excess=excess.sum(),
            error_mean_s=error_s.mean(),
            error_median_s=error_s.median(),
        )
        .with_columns(
            dataset=pl.lit(dataset),
            subset=pl.lit(subset),
            start_x_m=pl.col("beyond_m") + pl.lit(cutoff_m, pl.Float64),
            coverage=pl.col("frames_covered") / some,
            excess=pl.col("frames_excess") / some,
        )
        .sort("estimator", "beyond_m")
    )
    return START_ASSESSMENTS.conform(table.lazy()).collect()


def cut_and_estimate(
    tracks: pl.DataFrame,
    vehicle_starts: pl.DataFrame,
    *,
    cutoff_m: float | None,
    first_frame: int,
    frame_rate_hz: float,
) -> pl.DataFrame:
    """Cut every fully tracked vehicle's track at each position that it reaches, and estimate what was cut off.

    The first entry at or beyond the position is the first one left. The cut-off stays that of the whole tracks. Neither
    the vehicle's own drive nor the speeds that were cut off enter its estimates.

    Args:
        tracks: as for `assess_starts`.
        vehicle_starts: likewise.
        cutoff_m: likewise.
        first_frame: likewise.
        frame_rate_hz: likewise.

    Returns:
        A row per vehicle, position and estimator: vehicle_id, beyond_m, start_frame; frames_true (since the vehicle's
        own interpolated crossing of the cut-off) and first_true_frame (of its first entry there or beyond); references
        (vehicles), estimator, frames_estimated, margin_frames, first_missing_frame.
    """
    if cutoff_m is None or not vehicle_starts["fully_tracked"].any():
        return pl.DataFrame(schema=CUT_SCHEMA)
    track = _Whole.gather(tracks, vehicle_starts, cutoff_m, first_frame, frame_rate_hz)
    frames = [
        _estimate(vehicles, cut, beyond_m, track)
        for beyond_m in POSITIONS_M
        for vehicles, cut in track.cut_at(cutoff_m + beyond_m)
    ]
    return pl.concat([pl.DataFrame(schema=CUT_SCHEMA), *frames])


@dataclass(frozen=True)
class _Whole:
    """The tracks before they are cut."""

    references: References
    cutoff_m: float
    first_frame: int
    frame_rate_hz: float
    entries: int
    """Of all vehicles of the subset."""
    speeds_mps: float
    """The sum of their speeds."""
    speeds_before_mps: Floats
    """Of each of the references' rows: the sum of the speeds of the rows before it."""

    @classmethod
    def gather(
        cls,
        tracks: pl.DataFrame,
        vehicle_starts: pl.DataFrame,
        cutoff_m: float,
        first_frame: int,
        frame_rate_hz: float,
    ) -> "_Whole":
        references = References.gather(tracks, vehicle_starts, cutoff_m)
        speeds_mps = float(tracks["speed_mps"].to_numpy().sum(dtype=np.float64))
        before = np.concatenate(([0.0], np.cumsum(references.speed_mps)[:-1]))
        return cls(references, cutoff_m, first_frame, frame_rate_hz, tracks.height, speeds_mps, before)

    def cut_at(self, x_m: float) -> Iterator[tuple[Ints, Cut]]:
        """Cut the tracks that reach x_m, TRACKS_AT_ONCE at a time: which vehicles, and what the others say of them."""
        whole = self.references
        reach = whole.find_reaching(x_m)
        first, last, left_cutoff = whole.first[reach], whole.last[reach], whole.left_cutoff[reach]
        starts = whole.find_row(first, last, x_m)
        # All tracks begin now within the length that one of them drives in a frame: others cross their starts here.
        latest = whole.find_row(starts, last, whole.x_m[starts].max(initial=x_m))
        for begin in range(0, reach.size, TRACKS_AT_ONCE):
            own = np.arange(begin, min(begin + TRACKS_AT_ONCE, reach.size))
            start = starts[own]
            start_x_m = whole.x_m[start, np.newaxis]
            after = whole.find_row(starts, latest, start_x_m)
            known = whole.farthest_m[after] >= start_x_m
            known[np.arange(own.size), own] = False
            passed_frame, nearer = whole.cross(first, after, start_x_m)
            yield (
                reach[own],
                Cut(
                    start_frame=whole.frame[start],
                    speed_mps=whole.speed_mps[start],
                    lane=whole.lane[start],
                    by_mean_speed=self._drive_at_mean_speed(first[own], start),
                    known=known,
                    frames=np.where(known, passed_frame - left_cutoff, 0.0),
                    speeds_mps=whole.speed_mps[nearer],
                    lanes=whole.lane[nearer],
                    passed_frame=passed_frame,
                    frame_rate_hz=self.frame_rate_hz,
                ),
            )

    def _drive_at_mean_speed(self, first: Ints, start: Ints) -> Floats:
        """Frames from the cut-off to the start at the mean speed of what is left of all tracks.

        Since the recording's first frame where that speed is not positive.
        """
        whole = self.references
        cut_off_mps = self.speeds_before_mps[start] - self.speeds_before_mps[first]
        mean_mps = (self.speeds_mps - cut_off_mps) / (self.entries - (start - first))
        longest = (whole.frame[start] - self.first_frame).astype(np.float64)
        frames = (whole.x_m[start] - self.cutoff_m) * self.frame_rate_hz
        return np.divide(frames, mean_mps, out=longest, where=mean_mps > 0)


def _estimate(vehicles: Ints, cut: Cut, beyond_m: float, track: _Whole) -> pl.DataFrame:
    """Every estimator's windows for the vehicles cut beyond_m after the cut-off."""
    whole = track.references
    first = whole.first[vehicles]
    begun = whole.find_row(first, whole.last[vehicles], track.cutoff_m)
    truth = pl.DataFrame(
        {
            "vehicle_id": whole.vehicle_id[vehicles],
            "start_frame": cut.start_frame,
            "frames_true": cut.start_frame - whole.left_cutoff[vehicles],
            "first_true_frame": whole.frame[begun],
            "references": cut.known.sum(axis=1),
        }
    )
    windows = []
    for estimator, estimate in ESTIMATES.items():
        frames, margin = estimate(cut)
        begins = np.floor(cut.start_frame - np.maximum(1.0, frames) - margin)
        windows.append(
            truth.with_columns(
                pl.Series("frames_estimated", frames),
                pl.Series("margin_frames", margin),
                pl.Series("first_missing_frame", np.maximum(begins, track.first_frame)),
                estimator=pl.lit(estimator),
                beyond_m=pl.lit(beyond_m),
            ).select(pl.col(name).cast(dtype) for name, dtype in CUT_SCHEMA.items())
        )
    return pl.concat(windows)
