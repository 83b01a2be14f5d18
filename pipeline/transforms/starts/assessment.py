"""Assessment of the estimates of missing starts: whole tracks are cut, and the estimates compared with the truth.

DESIGN section 6, last paragraph. A fully tracked vehicle is treated as if first seen at a known position; the other
fully tracked vehicles are its references, and its own track gives the truth about the part that was cut off.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.starts.estimators import ESTIMATES, Cut
from tracklake.pipeline.transforms.starts.references import References
from tracklake.schemas.arrays import Floats, Integers, Singles
from tracklake.schemas.start_assessments import START_ASSESSMENTS

POSITIONS_M = tuple(20.0 * number for number in range(1, 11))
"""Distances of the cuts from the cut-off, in m. Late starts are known up to 200 m; steps of 20 m show how estimates
worsen with distance, and are long compared with a vehicle's way in a frame."""
SPEED_UNITS = 2**30
"""Whole numbers in 1 m/s, in which speeds are added up: float sums would depend on the order."""
TRACKS_AT_ONCE = 128
"""Cut tracks compared with all references at once, which limits the memory."""

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


@dataclass(frozen=True)
class Totals:
    """The number of entries of a subset, and the sum of their speeds in SPEED_UNITS."""

    entries: int
    speeds: int

    @classmethod
    def of_tracks(cls, tracks: pl.DataFrame) -> "Totals":
        """Count and add up the entries of some tracks."""
        return cls(tracks.height, int(_count_units(tracks["speed_mps"].to_numpy()).sum()))


def _count_units(speed_mps: Singles | Floats) -> Integers:
    """Return speeds in SPEED_UNITS, whole numbers whose sums do not depend on their order."""
    units: Integers = np.rint(speed_mps.astype(np.float64) * SPEED_UNITS).astype(np.int64)
    return units


def keep_beginnings(
    read_tracks: Callable[[], Iterable[pl.DataFrame]], vehicle_starts: pl.DataFrame, *, cutoff_m: float | None
) -> tuple[pl.DataFrame, Totals]:
    """Return what of a long subset's tracks is needed to assess its starts, and its totals.

    These are the fully tracked vehicles' entries up to the first one beyond all cuts. `read_tracks` yields whole tracks
    of some vehicles at a time, with the columns that `assess_starts` needs.
    """
    farthest_m = (cutoff_m or 0.0) + max(POSITIONS_M)
    wanted = vehicle_starts.filter("fully_tracked").select("vehicle_id")
    limit_m, entries, speeds = farthest_m, 0, 0
    for tracks in read_tracks():
        own = Totals.of_tracks(tracks)
        entries, speeds = entries + own.entries, speeds + own.speeds
        beyond = tracks.join(wanted, on="vehicle_id", how="semi").filter(pl.col("x_m") >= farthest_m)
        firsts = beyond.sort("vehicle_id", "frame").unique("vehicle_id", keep="first", maintain_order=True)
        limit_m = max([limit_m, *firsts["x_m"].to_list()])
    before_m = pl.col("x_m").cum_max().shift(1).over("vehicle_id")
    kept = [
        tracks.join(wanted, on="vehicle_id", how="semi", maintain_order="left").filter(
            before_m.is_null() | (before_m < limit_m)
        )
        for tracks in read_tracks()
    ]
    return pl.concat(kept), Totals(entries, speeds)


def assess_starts(
    tracks: pl.DataFrame,
    vehicle_starts: pl.DataFrame,
    *,
    dataset: str,
    subset: str,
    cutoff_m: float | None,
    first_frame: int,
    frame_rate_hz: float,
    totals: Totals | None = None,
) -> pl.DataFrame:
    """Measure coverage and excess of each estimator per start position, on tracks cut on purpose.

    `tracks` have vehicle_id, frame, x_m, lane, speed_mps of one subset, sorted by the first two; `vehicle_starts`
    vehicle_id, fully_tracked. Without a cut-off (that of the whole tracks) there is no assessment. Returns rows of
    `start_assessments`; a position that no fully tracked vehicle reaches has none. With `totals`, the tracks are what
    `keep_beginnings` left of them.
    """
    cut = cut_and_estimate(
        tracks, vehicle_starts, cutoff_m=cutoff_m, first_frame=first_frame, frame_rate_hz=frame_rate_hz, totals=totals
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
    totals: Totals | None = None,
) -> pl.DataFrame:
    """Cut every fully tracked vehicle's track at each position that it reaches, and estimate the missing start.

    Arguments are those of `assess_starts`. The first entry at or beyond the position is the first one left. The cut-off
    stays that of the whole tracks. The vehicle's own drive and the speeds that were cut off are not used.

    Returns:
        A row per vehicle, position and estimator: vehicle_id, beyond_m, start_frame; frames_true (since the vehicle's
        own interpolated crossing of the cut-off) and first_true_frame (of its first entry there or beyond); references
        (vehicles), estimator, frames_estimated, margin_frames, first_missing_frame.
    """
    if cutoff_m is None or not vehicle_starts["fully_tracked"].any():
        return pl.DataFrame(schema=CUT_SCHEMA)
    references = References.from_tracks(tracks, vehicle_starts, cutoff_m)
    whole = _WholeTracks(
        references,
        cutoff_m,
        first_frame,
        frame_rate_hz,
        totals=totals or Totals.of_tracks(tracks),
        speeds_before=np.concatenate(([0], np.cumsum(_count_units(references.speed_mps))[:-1])),
    )
    frames = [
        _estimate_windows(vehicles, cut, beyond_m, whole)
        for beyond_m in POSITIONS_M
        for vehicles, cut in whole.cut_tracks(cutoff_m + beyond_m)
    ]
    return pl.concat([pl.DataFrame(schema=CUT_SCHEMA), *frames])


@dataclass(frozen=True)
class _WholeTracks:
    """The tracks of a subset before they are cut.

    Args:
        totals: those of all vehicles of the subset.
        speeds_before: sum of the speeds of all earlier rows of the references in SPEED_UNITS, for each row.
    """

    references: References
    cutoff_m: float
    first_frame: int
    frame_rate_hz: float
    totals: Totals
    speeds_before: Integers

    def cut_tracks(self, x_m: float) -> Iterator[tuple[Integers, Cut]]:
        """Cut the tracks that reach x_m, and yield the vehicles and their cuts, TRACKS_AT_ONCE at a time."""
        whole = self.references
        reach = whole.find_reaching(x_m)
        first, last, left_cutoff = whole.first[reach], whole.last[reach], whole.left_cutoff[reach]
        starts = whole.find_row(first, last, x_m)
        # All cut tracks begin within a vehicle's way in a frame, so other tracks cross their starts in these rows.
        latest = whole.find_row(starts, last, whole.x_m[starts].max(initial=x_m))
        for begin in range(0, reach.size, TRACKS_AT_ONCE):
            own = np.arange(begin, min(begin + TRACKS_AT_ONCE, reach.size))
            start = starts[own]
            start_x_m = whole.x_m[start, np.newaxis]
            after = whole.find_row(starts, latest, start_x_m)
            known = whole.farthest_m[after] >= start_x_m
            known[np.arange(own.size), own] = False
            passed_frame, nearer = whole.find_crossings(first, after, start_x_m)
            yield (
                reach[own],
                Cut(
                    start_frame=whole.frame[start],
                    speed_mps=whole.speed_mps[start],
                    lane=whole.lane[start],
                    by_mean_speed=self._estimate_by_mean_speed(first[own], start),
                    known=known,
                    frames=np.where(known, passed_frame - left_cutoff, 0.0),
                    speeds_mps=whole.speed_mps[nearer],
                    lanes=whole.lane[nearer],
                    passed_frame=passed_frame,
                    frame_rate_hz=self.frame_rate_hz,
                ),
            )

    def _estimate_by_mean_speed(self, first: Integers, start: Integers) -> Floats:
        """Estimate the frames from the cut-off to the start by the mean speed of all entries that are left.

        If that speed is not positive, these are all frames since the recording's first.
        """
        whole = self.references
        cut_off = self.speeds_before[start] - self.speeds_before[first]
        mean_mps = (self.totals.speeds - cut_off) / SPEED_UNITS / (self.totals.entries - (start - first))
        longest = (whole.frame[start] - self.first_frame).astype(np.float64)
        frames = (whole.x_m[start] - self.cutoff_m) * self.frame_rate_hz
        return np.divide(frames, mean_mps, out=longest, where=mean_mps > 0)


def _estimate_windows(vehicles: Integers, cut: Cut, beyond_m: float, tracks: _WholeTracks) -> pl.DataFrame:
    """Estimate the windows of the vehicles cut beyond_m after the cut-off, with every estimator."""
    whole = tracks.references
    first = whole.first[vehicles]
    begun = whole.find_row(first, whole.last[vehicles], tracks.cutoff_m)
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
                pl.Series("first_missing_frame", np.maximum(begins, tracks.first_frame)),
                estimator=pl.lit(estimator),
                beyond_m=pl.lit(beyond_m),
            ).select(pl.col(name).cast(dtype) for name, dtype in CUT_SCHEMA.items())
        )
    return pl.concat(windows)
