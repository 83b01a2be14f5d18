"""Surveys of a long subset, slice by slice: what rules need to know of all of it before they judge a slice."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.quality_reports.rules.scene import Scene
from tracklake.quality_reports.rules.within_frames import count_shared_frames, reads_bumpers


@dataclass(frozen=True)
class Survey:
    """What is known of a whole subset after a look at its slices.

    Args:
        anchors: entries that tell where tracks begin and end, and which entries lie on both sides of a gap that is
            longer than a slice's context: rows of tracks, sorted by vehicle_id, frame.
        shared_frames: see `scene.Whole`.
        ends_at_bumpers: see `scene.Whole`.
        has_headings: whether any entry has a heading.
        least_speeds: dataset, subset, vehicle_id, frame (the last), speed_mps (the least), a row per vehicle.
    """

    anchors: pl.DataFrame
    shared_frames: pl.DataFrame
    ends_at_bumpers: bool
    has_headings: bool
    least_speeds: pl.DataFrame


def survey(slices: Iterable[pl.DataFrame], open_scene: Callable[[pl.DataFrame], Scene], longest_step: int) -> Survey:
    """Look at the slices of a subset, in order of time.

    Args:
        slices: tracks of each slice without context, sorted by vehicle_id, frame.
        open_scene: function from tracks to a scene.
        longest_step: most frames between two entries of a vehicle whose slices have both.
    """
    last: pl.DataFrame | None = None
    anchors, shared, speeds, by_fronts, by_bumpers = [], [], [], [], []
    has_headings = False
    for tracks in slices:
        joined = tracks if last is None else pl.concat([last, tracks]).sort("vehicle_id", "frame")
        known = (tracks.clear() if last is None else last)["vehicle_id"].implode()
        vehicle, step = pl.col("vehicle_id"), pl.col("frame").diff()
        begins = (vehicle != vehicle.shift(1)).fill_null(value=True)
        is_far = ~begins & (step > longest_step)
        is_first = begins & ~vehicle.is_in(known)
        anchors.append(joined.filter(is_first | is_far | is_far.shift(-1, fill_value=False)))
        last = joined.unique("vehicle_id", keep="last", maintain_order=True)
        scene = open_scene(tracks)
        shared.append(count_shared_frames(scene))
        speeds.append(tracks.group_by("vehicle_id").agg(pl.col("speed_mps").min()))
        has_headings |= tracks["heading_rad"].null_count() < tracks.height
        fronts, bumpers = _compare_headways(tracks, scene.vehicles)
        by_fronts.append(fronts)
        by_bumpers.append(bumpers)
    assert last is not None
    least = pl.concat(speeds).group_by("vehicle_id").agg(pl.col("speed_mps").min())
    return Survey(
        anchors=pl.concat([*anchors, last]).unique(["vehicle_id", "frame"]).sort("vehicle_id", "frame"),
        shared_frames=pl.concat(shared).group_by("one", "other").agg(pl.col("frames").sum()),
        ends_at_bumpers=reads_bumpers(np.concatenate(by_fronts), np.concatenate(by_bumpers)),
        has_headings=has_headings,
        least_speeds=last.select("dataset", "subset", "vehicle_id", "frame").join(
            least, on="vehicle_id", maintain_order="left"
        ),
    )


def _compare_headways(tracks: pl.DataFrame, vehicles: pl.DataFrame) -> list[np.ndarray]:
    """Return the differences of recorded headways from gap_m, by both readings, where both are known."""
    lengths = vehicles.select("vehicle_id", pl.col("length_m").cast(pl.Float64))
    headway = pl.col("headway_recorded_m").cast(pl.Float64)
    known = (
        tracks.select("leader_id", "headway_recorded_m", "gap_m")
        .drop_nulls()
        .join(lengths, left_on="leader_id", right_on="vehicle_id")
        .drop_nulls()
    )
    differences = known.select(fronts=headway - pl.col("length_m") - pl.col("gap_m"), bumpers=headway - pl.col("gap_m"))
    return [differences[name].to_numpy() for name in ("fronts", "bumpers")]
