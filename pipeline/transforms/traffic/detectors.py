"""Virtual loop detectors: counts, speeds and occupancy at cross sections, linear between entries."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.traffic.edie import count_cells, count_unmeasured
from tracklake.pipeline.transforms.traffic.scene import NO_LANE, Scene
from tracklake.schemas.arrays import Floats, expand_ranges, find_run_starts

KEY = ("detector", "lane", "interval")
"""Columns that name a detector by its number, a lane and an interval by its number."""


def count_passages(scene: Scene, *, spacing_m: float, interval_s: float) -> tuple[pl.DataFrame, dict[str, int]]:
    """Count the fronts that pass cross sections at whole multiples of a spacing, by lane and interval.

    A front passes once: when it first reaches the cross section between two successive frames. The lane is that of the
    entry before. A lane has rows for all intervals at the cross sections that anybody passed in it.

    Returns:
        Columns of `virtual_detectors` without dataset and subset, sorted; and numbers of what is left out, by reason.
    """
    found, skipped = find_passages(scene, spacing_m=spacing_m)
    return gather_passages([found], scene.end_s, spacing_m=spacing_m, interval_s=interval_s), skipped


@dataclass(frozen=True)
class Passages:
    """Fronts that pass cross sections, and the times for which vehicles are above them; None without a road.

    Args:
        fronts: vehicle_id, detector, lane, time_s, passing_mps, has_length.
        stays: detector, lane, from_s, to_s.
    """

    fronts: pl.DataFrame
    stays: pl.DataFrame


def find_passages(scene: Scene, *, spacing_m: float) -> tuple[Passages | None, dict[str, int]]:
    """Find the passages of own vehicles; also return numbers of what is left out, by reason."""
    skipped = count_unmeasured(scene)
    if scene.road_m is None or not scene.end_s > 0:
        return None, {**skipped, "no_extent": int(scene.own.sum())}
    fronts = _find_passages(scene, scene.read("x_m"), spacing_m).filter(pl.col("lane") != NO_LANE)
    stays = _find_stays(scene, fronts, spacing_m)
    return Passages(fronts.drop("piece"), stays), skipped


def gather_passages(
    found: Sequence[Passages | None], end_s: float, *, spacing_m: float, interval_s: float
) -> pl.DataFrame:
    """Gather the passages of all scenes of a subset; see `count_passages`."""
    known = [each for each in found if each is not None]
    if not known:
        return pl.DataFrame()
    intervals = count_cells(end_s, interval_s)
    # In this order: the last digits of means depend on it.
    passages = pl.concat(each.fronts for each in known).sort("vehicle_id", "time_s", "detector")
    counted = (
        passages.unique(["vehicle_id", "detector"], keep="first", maintain_order=True)
        .with_columns(_number("time_s", interval_s, intervals).alias("interval"))
        .group_by(KEY, maintain_order=True)
        .agg(
            pl.len().alias("vehicles"),
            pl.col("passing_mps").mean().alias("time_mean_speed_mps"),
            (pl.len() / (1 / pl.col("passing_mps")).sum()).alias("space_mean_speed_mps"),
            pl.col("has_length").all(),
        )
    )
    covered = _measure_cover(pl.concat(each.stays for each in known), interval_s, intervals)
    grid = (
        passages.select("detector", "lane")
        .unique()
        .join(pl.DataFrame({"interval": np.arange(intervals, dtype=np.int64)}), how="cross")
    )
    begin_s = pl.col("interval") * float(interval_s)
    return (
        grid.join(counted, on=KEY, how="left")
        .join(covered, on=KEY, how="left")
        .with_columns(
            pl.col("vehicles", "covered_s").fill_null(0),
            detector_m=pl.col("detector") * float(spacing_m),
            interval_s=begin_s,
            seconds=pl.min_horizontal(begin_s + interval_s, end_s) - begin_s,
        )
        .with_columns(
            flow_vph=3600 * pl.col("vehicles") / pl.col("seconds"),
            occupancy=pl.when(pl.col("has_length").fill_null(value=True)).then(
                (pl.col("covered_s") / pl.col("seconds")).clip(0, 1)
            ),
        )
    )


def _number(time: str, interval_s: float, intervals: int) -> pl.Expr:
    """Return the number of the interval that holds a time; the recording's end belongs to the last one."""
    return (pl.col(time) / interval_s).round(9).floor().cast(pl.Int64).clip(0, intervals - 1)


def _find_passages(scene: Scene, positions_m: Floats, spacing_m: float) -> pl.DataFrame:
    """Find when positions first reach multiples of a spacing within a piece of track without gaps.

    Returns:
        vehicle_id, piece, detector, lane (of the entry before), time_s, passing_mps, has_length; in order of pieces.
    """
    furthest = _find_furthest(scene, positions_m)
    row = np.flatnonzero(scene.follows[:-1] & scene.own & (furthest > np.roll(furthest, 1)))
    reached = np.floor(furthest / spacing_m)
    reached = np.where(np.isnan(reached), 0, reached).astype(np.int64)
    detector, owner = expand_ranges(reached[row - 1] + 1, reached[row] - reached[row - 1])
    here = row[owner]
    start, way = positions_m[here - 1], positions_m[here] - positions_m[here - 1]
    share = (detector * spacing_m - start) / way
    return pl.DataFrame(
        {
            "vehicle_id": scene.ids[here],
            "piece": scene.pieces[here],
            "detector": detector,
            "lane": scene.lanes[here - 1],
            "time_s": scene.times_s[here - 1] + share / scene.rate_hz,
            "passing_mps": way * scene.rate_hz,
            "has_length": ~np.isnan(scene.lengths_m[here]),
        }
    )


def _find_furthest(scene: Scene, positions_m: Floats) -> Floats:
    """Find the furthest position so far in each piece of track, (N,)."""
    found = pl.DataFrame({"piece": scene.pieces, "at": positions_m}).select(pl.col("at").cum_max().over("piece"))
    furthest: Floats = found["at"].to_numpy()
    return furthest


def _find_stays(scene: Scene, passages: pl.DataFrame, spacing_m: float) -> pl.DataFrame:
    """Find the times for which own vehicles are above detectors: detector, lane, from_s, to_s.

    A vehicle is above it from its front's passage to its rear's, or as far as its track goes. It counts to the lane in
    which its front passed; to that of its first entry if it stood there already.
    """
    first = find_run_starts(scene.pieces)
    last = np.append(first[1:], len(scene.pieces)) - 1
    rears_m = scene.read("x_m") - scene.lengths_m
    known = ~np.isnan(rears_m[first]) & scene.own[first]
    first, last = first[known], last[known]
    low = np.floor(rears_m[first] / spacing_m).astype(np.int64)
    high = np.floor(_find_furthest(scene, scene.read("x_m"))[last] / spacing_m).astype(np.int64)
    detector, owner = expand_ranges(low + 1, high - low)
    on = ["piece", "detector"]
    stays = pl.DataFrame(
        {
            "piece": scene.pieces[first][owner],
            "detector": detector,
            "first_lane": scene.lanes[first][owner],
            "first_s": scene.times_s[first][owner],
            "last_s": scene.times_s[last][owner],
        }
    )
    return (
        stays.join(passages.select(*on, "lane", from_s="time_s"), on=on, how="left")
        .join(_find_passages(scene, rears_m, spacing_m).select(*on, to_s="time_s"), on=on, how="left")
        .select(
            "detector",
            pl.coalesce("lane", "first_lane"),
            from_s=pl.coalesce("from_s", "first_s"),
            to_s=pl.coalesce("to_s", "last_s"),
        )
    )


def _measure_cover(stays: pl.DataFrame, interval_s: float, intervals: int) -> pl.DataFrame:
    """Measure the time for which any vehicle is above a detector, by lane and interval: KEY, covered_s."""
    stays = stays.sort("detector", "lane", "from_s", "to_s")
    # What another vehicle covers already does not count twice.
    before = pl.col("to_s").cum_max().shift(1).over("detector", "lane")
    alone = stays.with_columns(from_s=pl.max_horizontal("from_s", before)).filter(pl.col("to_s") > pl.col("from_s"))
    return (
        alone.with_columns(
            interval=pl.int_ranges(_number("from_s", interval_s, intervals), _number("to_s", interval_s, intervals) + 1)
        )
        .explode("interval")
        .with_columns(begin_s=pl.col("interval") * float(interval_s))
        .group_by(KEY, maintain_order=True)
        .agg(
            covered_s=(
                pl.min_horizontal("to_s", pl.col("begin_s") + interval_s) - pl.max_horizontal("from_s", "begin_s")
            )
            .clip(0, None)
            .sum()
        )
    )
