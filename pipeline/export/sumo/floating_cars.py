"""Floating-car data of SUMO: the tracks of a subset by time, and the same for SUMO's replay of such data.

SUMO's replay puts a vehicle on its lane's middle in the step in which it enters, and lets it drive on after its last
position. So the replay runs at half of the frames' interval: vehicles enter half an interval before their first frame
and are put at the road's end half an interval after their last one, where they leave. At the frames themselves, all
positions are those of the tracks.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.export.folder import ExportError
from tracklake.pipeline.export.sumo.road import Road

FIRST_MS = 1000
"""SUMO's time of the recording's first frame, in ms: a replay cannot begin before 0."""
CHUNK_ROWS = 100_000
"""Rows that are turned into text at once."""
CLASSES = {"car": "passenger", "truck": "truck", "motorcycle": "motorcycle"}
"""SUMO's vehicle class of each class of vehicles; others are passenger cars."""
VEHICLE = '        <vehicle id="{}" x="{}" y="{}" angle="{}" type="{}" speed="{}" pos="{}" lane="road_{}"/>'
"""A vehicle at a time; angles are degrees clockwise from SUMO's y axis."""


def find_half_step(frame_rate_hz: float) -> int:
    """Return half of the frames' interval in whole ms, SUMO's unit of time.

    Raises:
        ExportError: it is no whole number.
    """
    half_ms = 500 / frame_rate_hz
    if abs(half_ms - round(half_ms)) > 1e-9:
        raise ExportError(
            f"SUMO counts time in whole milliseconds, and half of the frames' interval must be some: expected 10, 20 "
            f"or 25 Hz, for instance, got {frame_rate_hz:g} Hz"
        )
    return round(half_ms)


def list_types(vehicles: pl.DataFrame) -> pl.DataFrame:
    """Name the type of each vehicle by class and size: vehicle_id, type, class, length_m, width_m."""
    size = [pl.col(name).cast(pl.Float64).round(2) for name in ("length_m", "width_m")]
    named = vehicles.select("vehicle_id", pl.col("class").fill_null("unknown"), *size)
    text = [pl.col(name).cast(pl.String).fill_null("unknown") for name in ("length_m", "width_m")]
    return named.with_columns(type=pl.format("{}_{}_{}", "class", *text)).sort("vehicle_id")


def write_types(path: Path, types: pl.DataFrame) -> None:
    """Write a vType for every class and size; a size that is unknown is SUMO's own of the class."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', "<additional>"]
    for row in types.unique("type").sort("type").iter_rows(named=True):
        size = [f' {name}="{row[f"{name}_m"]}"' for name in ("length", "width") if row[f"{name}_m"]]
        lines.append(
            f'    <vType id="{row["type"]}" vClass="{CLASSES.get(row["class"], "passenger")}"{"".join(size)} '
            'maxSpeed="100" minGap="0"/>'
        )
    path.write_text("\n".join([*lines, "</additional>"]) + "\n", encoding="utf-8")


def place_vehicles(tracks: pl.DataFrame, types: pl.DataFrame, road: Road, facts: Mapping[str, Any]) -> pl.DataFrame:
    """Put the entries of a subset on SUMO's road and clock.

    Returns:
        vehicle_id, step (half intervals since the first frame), part (how many gaps the track had before), enters and
        leaves (it is the first, last entry of the part), x, y, angle, type, speed, lane; sorted by vehicle_id, step.
    """
    frame, vehicle = pl.col("frame").cast(pl.Int64), pl.col("vehicle_id")
    y = tracks["y_m"].to_numpy()
    beside = np.clip(np.searchsorted(road.markings_m, y, side="right"), 1, road.lanes)
    ordered = tracks.with_columns(beside=pl.Series(beside)).sort("vehicle_id", "frame")
    follows = ((vehicle == vehicle.shift(1)) & (frame - frame.shift(1) == 1)).fill_null(value=False)
    return (
        ordered.join(types.select("vehicle_id", "type"), on="vehicle_id", how="left", maintain_order="left")
        .with_columns(enters=~follows, leaves=~follows.shift(-1, fill_value=False))
        .select(
            "vehicle_id",
            "enters",
            "leaves",
            "type",
            step=2 * (frame - facts["first_frame"]),
            part=pl.col("enters").cast(pl.Int32).cum_sum().over("vehicle_id"),
            x="x_m",
            y=-pl.col("y_m"),
            angle=90 + pl.col("heading_rad").cast(pl.Float64).fill_null(0.0).degrees(),
            speed=pl.col("speed_mps").cast(pl.Float64).clip(lower_bound=0.0),
            lane=road.lanes - pl.col("lane").fill_null(pl.col("beside")).clip(1, road.lanes).cast(pl.Int32),
        )
    )


def add_ends(placed: pl.DataFrame, road: Road, half_ms: int) -> pl.DataFrame:
    """Add the entries of the replay half an interval before the first and after the last frame of each part."""
    before = pl.col("x") - pl.col("speed") * half_ms / 1000
    enter = placed.filter("enters").with_columns(step=pl.col("step") - 1, x=before)
    leave = placed.filter("leaves").with_columns(step=pl.col("step") + 1, x=pl.lit(road.end_m))
    return pl.concat([placed, enter, leave])


def write_fcd(path: Path, placed: pl.DataFrame, road: Road, half_ms: int, *, number_parts: bool) -> None:
    """Write entries as floating-car data, in pieces; `number_parts` gives the parts of a track after gaps other ids."""
    ordered = placed.sort("step", "vehicle_id", "part")
    changes = (pl.col("step") != pl.col("step").shift(1)).fill_null(value=True)
    ordered = ordered.with_columns(opens=changes, closes=changes & (pl.int_range(pl.len()) > 0))
    vehicle = pl.col("vehicle_id").cast(pl.String)
    part = pl.when(pl.col("part") > 1).then(pl.format("{}.{}", vehicle, "part")).otherwise(vehicle)
    time_s = (FIRST_MS + pl.col("step") * half_ms) / 1000
    numbers = [pl.col(name).round(3) for name in ("x", "y", "angle")]
    entry = pl.format(
        VEHICLE,
        part if number_parts else vehicle,
        *numbers,
        "type",
        pl.col("speed").round(3),
        (pl.col("x") - road.begin_m).round(3),
        "lane",
    )
    line = (
        pl.when("closes").then(pl.lit("    </timestep>\n")).otherwise(pl.lit(""))
        + pl.when("opens").then(pl.format('    <timestep time="{}">\n', time_s)).otherwise(pl.lit(""))
        + entry
    )
    with path.open("wb") as stream:
        stream.write(b'<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for rows in ordered.iter_slices(CHUNK_ROWS):
            rows.select(line).write_csv(stream, include_header=False, quote_style="never")
        stream.write(b"    </timestep>\n</fcd-export>\n")
