"""Flow, density and speed on a grid of road and time by Edie's definition, exact for straight lines between entries."""

import math
from collections.abc import Sequence

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.traffic.scene import NO_LANE, Scene
from tracklake.schemas.arrays import Floats, Integers, expand_ranges

DIGITS = 9
"""Digits after the point to which positions in cells are rounded, so that 0.3 s are three cells of 0.1 s."""


def measure_cells(scene: Scene, *, cell_m: float, cell_s: float) -> tuple[pl.DataFrame, dict[str, int]]:
    """Measure distance driven and time spent in every cell of road and time, by lane.

    Between two successive entries a vehicle drives at constant speed, in the lane of the first; what crosses borders of
    cells is divided there. Cells are counted from x_m = 0 and from the recording's first frame. A lane has rows for all
    times in the cells of road where anybody drove in it.

    Returns:
        Columns of `edie` without dataset and subset, sorted; and numbers of what is left out, by reason.
    """
    by_vehicle, skipped = divide_tracks(scene, cell_m=cell_m, cell_s=cell_s)
    return gather_cells([by_vehicle], scene.road_m, scene.end_s, cell_m=cell_m, cell_s=cell_s), skipped


def divide_tracks(scene: Scene, *, cell_m: float, cell_s: float) -> tuple[pl.DataFrame, dict[str, int]]:
    """Divide the tracks of own vehicles into cells: lane, along, at, vehicle_id, distance_m, time_s.

    Also returns numbers of what is left out, by reason.
    """
    skipped = count_unmeasured(scene)
    road = scene.road_m
    if road is None or not scene.end_s > 0:
        return pl.DataFrame(), {**skipped, "no_extent": int(scene.own.sum())}
    pieces = _divide_segments(scene, cell_m, cell_s)
    cells_s = count_cells(scene.end_s, cell_s)
    low, high = math.floor(road[0] / cell_m), math.ceil(road[1] / cell_m) - 1
    by_vehicle = (
        pieces.with_columns(pl.col("along").clip(low, high), pl.col("at").clip(0, cells_s - 1))
        # In the order of the rows: the last digits of sums depend on it.
        .group_by("lane", "along", "at", "vehicle_id", maintain_order=True)
        .agg(pl.col("distance_m", "time_s").sum())
    )
    return by_vehicle, skipped


def gather_cells(
    by_vehicle: Sequence[pl.DataFrame], road: tuple[float, float] | None, end_s: float, *, cell_m: float, cell_s: float
) -> pl.DataFrame:
    """Gather what the vehicles of all scenes of a subset did in each cell; see `measure_cells` and `divide_tracks`."""
    if road is None or not end_s > 0:
        return pl.DataFrame()
    parts = pl.concat(by_vehicle).sort("lane", "along", "at", "vehicle_id")
    cells = parts.group_by("lane", "along", "at", maintain_order=True).agg(
        pl.len().alias("vehicles"), pl.col("distance_m", "time_s").sum()
    )
    times = pl.DataFrame({"at": np.arange(count_cells(end_s, cell_s), dtype=np.int64)})
    grid = parts.select("lane", "along").unique().join(times, how="cross")
    begin_m, begin_s = pl.col("along") * float(cell_m), pl.col("at") * float(cell_s)
    area = pl.col("length_m") * pl.col("seconds")
    return (
        grid.join(cells, on=["lane", "along", "at"], how="left")
        .with_columns(pl.col("vehicles", "distance_m", "time_s").fill_null(0))
        .with_columns(
            from_m=begin_m,
            from_s=begin_s,
            length_m=pl.min_horizontal(begin_m + cell_m, road[1]) - pl.max_horizontal(begin_m, road[0]),
            seconds=pl.min_horizontal(begin_s + cell_s, end_s) - begin_s,
        )
        .with_columns(
            flow_vph=3600 * pl.col("distance_m") / area,
            density_vpkm=1000 * pl.col("time_s") / area,
            speed_mps=pl.when(pl.col("time_s") > 0).then(pl.col("distance_m") / pl.col("time_s")),
        )
    )


def count_unmeasured(scene: Scene) -> dict[str, int]:
    """Count what detectors and cells do not see, by reason."""
    same = scene.ids[1:] == scene.ids[:-1]
    alone = np.ones(len(scene.ids), bool)
    alone[1:] &= ~same
    alone[:-1] &= ~same
    return {
        "one_entry": int((alone & scene.own).sum()),
        "frame_gap": int((same & ~scene.follows[1:-1] & scene.own[1:]).sum()),
        "no_lane": int(((scene.lanes == NO_LANE) & scene.own).sum()),
    }


def count_cells(length: float, cell: float) -> int:
    """Return the number of cells from 0 that hold a length, the last one perhaps in part; at least 1."""
    return max(1, math.ceil(round(length / cell, DIGITS)))


def _divide_segments(scene: Scene, cell_m: float, cell_s: float) -> pl.DataFrame:
    """Divide the lines between entries at the borders of cells: lane, along, at, vehicle_id, distance_m, time_s.

    `along` and `at` number the cells of road and of time. Lines within one cell come first, summed while the vehicle
    stays in it.
    """
    end = np.flatnonzero(scene.follows[:-1] & scene.own)
    end = end[scene.lanes[end - 1] != NO_LANE]
    x_m = scene.read("x_m")
    times = scene.times_s
    x = np.stack([x_m[end - 1], x_m[end]]) / cell_m
    t = (np.stack([times[end - 1], times[end]]) / cell_s).round(DIGITS)
    cuts = _count_borders(x) + _count_borders(t)
    whole = np.flatnonzero(cuts == 0)
    parted = np.flatnonzero(cuts)
    line, from_share, to_share = _cut_lines(x[:, parted], t[:, parted])
    segment = np.concatenate([whole, parted[line]])
    from_share = np.concatenate([np.zeros(len(whole)), from_share])
    to_share = np.concatenate([np.ones(len(whole)), to_share])
    middle, part = (from_share + to_share) / 2, to_share - from_share
    row = end[segment]
    pieces = pl.DataFrame(
        {
            "lane": scene.lanes[row - 1],
            "along": np.floor(x[0, segment] + middle * (x[1, segment] - x[0, segment])).astype(np.int64),
            "at": np.floor(t[0, segment] + middle * (t[1, segment] - t[0, segment])).astype(np.int64),
            "vehicle_id": scene.ids[row],
            "distance_m": part * (x_m[row] - x_m[row - 1]),
            "time_s": part / scene.rate_hz,
        }
    )
    return pieces.filter(pl.col("time_s") > 0)


def _count_borders(ends: Floats) -> Integers:
    """Count the whole numbers strictly between two ends, (2, S) to (S,)."""
    counts: Integers = np.maximum(np.ceil(ends.max(0)) - np.floor(ends.min(0)) - 1, 0).astype(np.int64)
    return counts


def _cut_lines(x: Floats, t: Floats) -> tuple[Integers, Floats, Floats]:
    """Cut lines at whole numbers of x and of t, in order along each line.

    Args:
        x: ends of the lines in one direction, (2, L), in cells.
        t: their ends in the other direction, (2, L).

    Returns:
        The line of each part, and the shares of the line at which the part begins and ends.
    """
    lines = np.arange(x.shape[1])
    owners, shares = [lines, lines], [np.zeros(len(lines)), np.ones(len(lines))]
    for ends in (x, t):
        border, owner = expand_ranges(np.floor(ends.min(0)).astype(np.int64) + 1, _count_borders(ends))
        owners.append(owner)
        shares.append((border - ends[0, owner]) / (ends[1, owner] - ends[0, owner]))
    owner, share = np.concatenate(owners), np.concatenate(shares)
    order = np.lexsort((share, owner))
    owner, share = owner[order], share[order]
    joined = np.flatnonzero(owner[1:] == owner[:-1])
    return owner[joined], share[joined], share[joined + 1]
