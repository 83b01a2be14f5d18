"""Entries of a subset that its page draws, read once: scenes around findings and at the beginning, points of tracks."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.quality_reports.pages.examples import AROUND_S
from tracklake.quality_reports.plots.scenes import Window
from tracklake.quality_reports.plots.time_space import choose_step
from tracklake.quality_reports.summaries import Connection, Row, query_frame
from tracklake.schemas.arrays import Integers

RATE_HZ = 5.0
"""Scenes per second; the nearest rate that divides the source's is taken."""
FIRST_S = 120.0
"""Time from the recording's beginning, in seconds."""


@dataclass(frozen=True)
class SubsetScenes:
    """Entries of a subset at chosen frames. A tick is a frame that is a multiple of `stride`, counted in these.

    Args:
        entries: rows of subset_scenes.sql, sorted by vehicle_id and frame.
        markings: y_m of the lane markings; None where they are unknown.
        stride: frames from one tick to the next.
        step: frames from one point of a track in the diagrams to the next, a multiple of `stride`.
        rate_hz: frames per second.
        first: ticks of the recording's beginning.
        windows: ticks around each listed finding.
        ticks: all of these, in order.
        partners: the other vehicle of each listed finding at its moment; None where there is none.
    """

    entries: pl.DataFrame
    markings: list[float] | None
    stride: int
    step: int
    rate_hz: float
    first: Window
    windows: list[Window]
    ticks: Integers
    partners: list[int | None]

    @property
    def lanes(self) -> list[tuple[int, float]]:
        """Each lane with its middle between the markings, or with the median y_m of its entries."""
        medians = self.entries.drop_nulls("lane").group_by("lane").agg(pl.col("y_m").median()).sort("lane")
        borders = self.markings or []
        return [
            (lane, (borders[lane - 1] + borders[lane]) / 2 if 0 < lane < len(borders) else round(y_m, 2))
            for lane, y_m in medians.iter_rows()
        ]


def read_scenes(
    connection: Connection, where: Mapping[str, str], extent: Row, examples: Sequence[Row], rate_hz: float
) -> SubsetScenes | None:
    """Read the scenes of a subset; None where none of its frames is shown.

    Args:
        connection: connection to a lake.
        where: dataset and subset.
        extent: row of subset_extent.sql.
        examples: listed findings: rule, vehicle_id, first_frame, last_frame, moment, partner.
        rate_hz: frame rate of the subset.
    """
    if not extent["entries"]:
        return None
    stride = max(1, round(rate_hz / RATE_HZ))
    low, high = math.ceil(extent["first_frame"] / stride), extent["last_frame"] // stride
    around = AROUND_S * rate_hz
    windows = [
        (
            max(low, int((example["first_frame"] - around) // stride)),
            min(high, int((min(example["last_frame"], example["first_frame"] + around) + around) // stride) + 1),
        )
        for example in examples
    ]
    first = (low, min(high, low + round(FIRST_S * rate_hz / stride)))
    ticks = np.unique(np.concatenate([np.arange(begin, end + 1) for begin, end in [first, *windows]]))
    step = choose_step(extent["entries"], stride)
    frames = {*(ticks * stride).tolist(), *(example["moment"] for example in examples)}
    if not frames:
        return None
    # Text, since DuckDB looks for pandas once for every number of a list.
    parameters = {**where, "frames": ",".join(map(str, sorted(frames))), "step": step}
    entries = query_frame(connection, "subset_scenes", parameters).sort("vehicle_id", "frame")
    return SubsetScenes(
        entries=entries,
        markings=extent["lane_markings_m"],
        stride=stride,
        step=step,
        rate_hz=rate_hz,
        first=first,
        windows=windows,
        ticks=ticks,
        partners=find_partners(entries, examples),
    )


def find_partners(entries: pl.DataFrame, examples: Sequence[Row]) -> list[int | None]:
    """Find the other vehicle of each finding at its moment.

    Of an overlap that is the vehicle that lies deepest in the finding's own, as boxes along the road; of rules about
    the leader it is the recorded leader.

    Args:
        entries: entries of all moments.
        examples: vehicle_id, moment, partner (overlap, leader or None).
    """
    schema = {"number": pl.Int64, "vehicle_id": pl.Int32, "frame": pl.Int32, "partner": pl.String}
    numbered = [(i, row["vehicle_id"], row["moment"], row["partner"]) for i, row in enumerate(examples)]
    own = pl.DataFrame(numbered, schema=schema, orient="row").join(entries, on=["vehicle_id", "frame"])
    others = own.join(entries, on="frame", suffix="_of_other").filter(
        pl.col("vehicle_id") != pl.col("vehicle_id_of_other")
    )
    behind = pl.col("x_m_of_other") - pl.col("length_m_of_other") - pl.col("x_m")
    ahead = pl.col("x_m") - pl.col("length_m") - pl.col("x_m_of_other")
    beside = (pl.col("y_m") - pl.col("y_m_of_other")).abs() - (pl.col("width_m") + pl.col("width_m_of_other")) / 2
    overlapping = (pl.col("partner") == "overlap") & beside.is_not_null()
    leading = (pl.col("partner") == "leader") & (pl.col("vehicle_id_of_other") == pl.col("leader_id"))
    found = (
        others.filter(overlapping | leading)
        .with_columns(apart=pl.max_horizontal(behind, ahead, beside))
        .sort("number", "apart", "vehicle_id_of_other", nulls_last=True)
        .unique("number", keep="first", maintain_order=True)
    )
    partners = dict(found.select("number", "vehicle_id_of_other").iter_rows())
    return [partners.get(number) for number in range(len(examples))]
