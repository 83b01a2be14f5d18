"""exiD, inD and rounD alike: road users in the plane, by the middle of their bodies, put on road axes."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from tracklake.pipeline.sources.accounting import account_rows
from tracklake.pipeline.sources.assembly import assemble_subset
from tracklake.pipeline.sources.completeness import Announced, compare_counts
from tracklake.pipeline.sources.levelx import RECORDING, TRACKS, VEHICLES, LevelxFormat, LevelxRecording
from tracklake.pipeline.sources.source import Canonical, Part, RawFile, Subset
from tracklake.pipeline.transforms.tracks.axes import Axis, fit_axis, trace_track, wrap_angle
from tracklake.schemas import TRACKS as TRACKS_TABLE
from tracklake.schemas import Table
from tracklake.schemas.columns import Dataset, Origin
from tracklake.schemas.completeness import RECORDING_META, TRACKS_META
from tracklake.schemas.raw_levelx import (
    RAW_EXID_TRACKS,
    RAW_EXID_TRACKS_FIELDS,
    RAW_LEVELX_RECORDING,
    RAW_LEVELX_RECORDING_FIELDS,
    RAW_LEVELX_VEHICLES,
    RAW_LEVELX_VEHICLES_FIELDS,
    RAW_URBAN_TRACKS,
    RAW_URBAN_TRACKS_FIELDS,
)

CLASSES = {
    **{"car": "car", "van": "car", "truck": "truck", "truck_bus": "truck", "bus": "truck", "trailer": "truck"},
    **{"motorcycle": "motorcycle"},
}
"""Classes of `vehicles` by those of the files; another class is unknown, unless it is one of NO_MOTOR."""
NO_MOTOR = ("pedestrian", "bicycle", "animal")
"""Classes of road users that are no motor vehicles; their rows are dropped, and counted."""
SYNTHETIC_DAY = "synthetic"
"""Value of recordingMeta's weekday that marks a generated recording."""
FIRST_FRAME = 0
"""Number of a recording's first frame, where time_s = 0."""
SIZE_DIFFERENCE_M = 0.02
"""Greatest difference of a size in tracksMeta from that in tracks that is no disagreement, in m."""
MAX_HEADING_RAD = 1.57
"""Greatest angle of a vehicle from the axis of its road; beyond it the vehicle is on no part of it, in rad."""
FITTED_EVERY = 5
"""Every so many entries one counts where an axis is fitted to them: five a second."""
NO_ROAD = "heading is more than 90 degrees off the road's axis"
NO_PLACE = "position is none on the road's axis"
NO_SPEED = "velocity is no speed along the road's axis"


def make_format(dataset: Dataset, tracks: Table, fields: tuple[str, ...]) -> LevelxFormat:
    """Make the format of a dataset whose metadata files are as those of exiD, inD and rounD."""
    return LevelxFormat(
        dataset=dataset,
        title="levelXdata",
        fields={RECORDING: RAW_LEVELX_RECORDING_FIELDS, VEHICLES: RAW_LEVELX_VEHICLES_FIELDS, TRACKS: fields},
        raw={RECORDING: RAW_LEVELX_RECORDING, VEHICLES: RAW_LEVELX_VEHICLES, TRACKS: tracks},
        recording_id="recordingId",
        vehicle_id="trackId",
        any_header=True,
    )


EXID_FORMAT = make_format("exid", RAW_EXID_TRACKS, RAW_EXID_TRACKS_FIELDS)
URBAN_FORMAT = make_format("ind", RAW_URBAN_TRACKS, RAW_URBAN_TRACKS_FIELDS)


def split_motor_vehicles(
    entries: pl.DataFrame, vehicles: pl.DataFrame
) -> tuple[pl.DataFrame, list[tuple[pl.DataFrame, str]]]:
    """Split the rows of motor vehicles from those of other road users, a set for each class."""
    others = vehicles.select("trackId", pl.col("class").str.to_lowercase()).filter(pl.col("class").is_in(NO_MOTOR))
    if others.is_empty():
        return entries, []
    kept = entries.join(others, on="trackId", how="anti", maintain_order="left")
    dropped = entries.join(others, on="trackId", how="inner", maintain_order="left")
    return kept, [
        (rows, f"no motor vehicle: {name}")
        for (name,), rows in sorted(dropped.partition_by("class", as_dict=True).items())
    ]


def summarise_vehicles(entries: pl.DataFrame, vehicles: pl.DataFrame) -> tuple[pl.DataFrame, tuple[str, ...]]:
    """Describe vehicles as `assemble_subset` takes them; also return notes.

    Sizes are those of the tracks file; where tracksMeta has others, a note says so.
    """
    size = {
        side: pl.when(pl.col(side).median() > 0).then(pl.col(side).median().round(3)) for side in ("length", "width")
    }
    spans = {side: (pl.col(side).max() - pl.col(side).min()).round(3) for side in ("length", "width")}
    found = entries.group_by("trackId").agg(
        length_m=size["length"],
        width_m=size["width"],
        length_range_m=spans["length"],
        width_range_m=spans["width"],
    )
    known = vehicles.join(found, on="trackId", how="inner").with_columns(pl.col("class").str.to_lowercase())
    differs = pl.any_horizontal(
        (pl.col(f"{side}_m") - pl.col(side)).abs() > SIZE_DIFFERENCE_M for side in ("length", "width")
    )
    other = known.filter(differs)["trackId"].sort()
    notes = (
        (
            f"{other.len():,} of {known.height:,} vehicles have another size in tracksMeta than in tracks, which "
            f"counts (first: vehicle {other[0]})",
        )
        if len(other)
        else ()
    )
    return known.select(
        pl.col("class").replace_strict(CLASSES, default=None, return_dtype=pl.String),
        *("length_m", "width_m", "length_range_m", "width_range_m"),
        vehicle_id="trackId",
        source_vehicle_id="trackId",
        entries_announced="numFrames",
    ), notes


def trace_longest(entries: pl.DataFrame) -> Axis | None:
    """Draw an axis along the track whose ends are farthest apart; None where no vehicle drives.

    `entries` are sorted by vehicle and frame.
    """
    way = [(pl.col(name).last() - pl.col(name).first()) ** 2 for name in ("xCenter", "yCenter")]
    ends = entries.group_by("trackId").agg(way=pl.sum_horizontal(way)).sort("way", "trackId", descending=[True, False])
    if ends.is_empty():
        return None
    track = entries.filter(pl.col("trackId") == ends["trackId"][0])
    x, y, x_speed, y_speed = (track[name].to_numpy() for name in ("xCenter", "yCenter", "xVelocity", "yVelocity"))
    return trace_track(x, y, np.hypot(x_speed, y_speed))


def fit_to_entries(axis: Axis, entries: pl.DataFrame) -> Axis:
    """Fit an axis to the vehicles' positions and headings in some of the entries."""
    some = entries.gather_every(FITTED_EVERY)
    x, y, heading = (some[name].to_numpy() for name in ("xCenter", "yCenter", "heading"))
    return fit_axis(axis, x, y, np.radians(heading))


def place_entries(entries: pl.DataFrame, axis: Axis) -> pl.DataFrame:
    """Put vehicles on a road axis.

    The middle of the body is projected on the axis, and the heading is kept relative to it; the front centre lies half
    a length from the middle in this direction, as in highD. Speeds and accelerations are rates of change along the
    axis: outside of a bend it is shorter than the way that the vehicle drives.

    Adds along_m, right_m (of the middle), x_m, y_m (of the front centre, from the axis), heading_rad, speed_mps,
    accel_mps2, lateral_speed_mps.
    """
    places = axis.project(entries["xCenter"].to_numpy(), entries["yCenter"].to_numpy())
    heading = wrap_angle(places.angle_rad - np.radians(entries["heading"].to_numpy()))
    cosine, sine = np.cos(places.angle_rad), np.sin(places.angle_rad)
    stretch = np.maximum(places.stretch, 0.2)
    half = entries["length"].to_numpy() / 2
    x_speed, y_speed, x_accel, y_accel = (
        entries[name].to_numpy() for name in ("xVelocity", "yVelocity", "xAcceleration", "yAcceleration")
    )
    values = {
        "along_m": places.along_m,
        "right_m": places.right_m,
        "x_m": places.along_m + half * np.cos(heading),
        "y_m": places.right_m + half * np.sin(heading),
        "heading_rad": heading.round(4),
        "speed_mps": (x_speed * cosine + y_speed * sine) / stretch,
        "accel_mps2": (x_accel * cosine + y_accel * sine) / stretch,
        "lateral_speed_mps": x_speed * sine - y_speed * cosine,
    }
    return entries.with_columns(pl.Series(name, each) for name, each in values.items())


def split_impossible(placed: pl.DataFrame) -> tuple[pl.DataFrame, list[tuple[pl.DataFrame, str]]]:
    """Split rows that are possible on their road's axis from the others, which come in sets with a reason each."""
    low, high = TRACKS_TABLE.bounds["speed_mps"]
    fastest = TRACKS_TABLE.bounds["accel_mps2"][1] or math.inf
    tests = {
        NO_ROAD: pl.col("heading_rad").abs() > MAX_HEADING_RAD,
        NO_PLACE: pl.col("x_m").abs().clip(lower_bound=pl.col("y_m").abs()) > -(TRACKS_TABLE.bounds["y_m"][0] or 0),
        NO_SPEED: ~pl.col("speed_mps").is_between(low, high) | (pl.col("accel_mps2").abs() > fastest),
    }
    reason = pl.coalesce(pl.when(test).then(pl.lit(name)) for name, test in tests.items())
    judged = placed.with_columns(reason=reason)
    kept = judged.filter(pl.col("reason").is_null()).drop("reason")
    return kept, [(rows, name) for name in tests if not (rows := judged.filter(pl.col("reason") == name)).is_empty()]


def build_subset(
    placed: pl.DataFrame,
    sizes: pl.DataFrame,
    meta: Mapping[str, Any],
    files: Sequence[RawFile],
    *,
    dataset: Dataset,
    recording: str,
    direction: str,
    facts: Mapping[str, Any],
) -> Subset:
    """Build a subset of placed entries with lane, leader_id, follower_id, headway_recorded_m; x_m begins at 0.

    `facts` are the columns of `subsets` that only the dataset knows: freeway, lanes, on_ramp_lanes, lane_markings_m,
    columns_missing, and left_m, what y_m counts from.
    """
    entries = placed.select(
        *("frame", "heading_rad", "lane", "speed_mps", "accel_mps2", "lateral_speed_mps"),
        *("leader_id", "follower_id", "headway_recorded_m"),
        vehicle_id="trackId",
        x_m=(pl.col("x_m") - pl.col("x_m").min()).round(3),
        y_m=(pl.col("y_m") - facts["left_m"]).round(3),
    )
    own = sizes.join(entries.select(pl.col("vehicle_id").unique()), on="vehicle_id", how="semi").sort("vehicle_id")
    return assemble_subset(
        entries,
        own,
        dataset=dataset,
        name=f"{recording}-{direction}",
        facts={
            "recording": recording,
            "site": f"location-{meta['locationId']}",
            "origin": find_origin(meta),
            "direction": direction,
            "frame_rate_hz": meta["frameRate"],
            "seconds": meta["duration"],
            "first_frame": FIRST_FRAME,
            "ids_split": 0,
            **{name: value for name, value in facts.items() if name != "left_m"},
        },
        use_recorded_headway=False,
        files=files,
    )


def find_origin(meta: Mapping[str, Any]) -> Origin:
    """Tell by the row of recordingMeta whether a recording was generated."""
    return "synthetic" if (meta["weekday"] or "").strip().lower() == SYNTHETIC_DAY else "recorded"


def finish_recording(
    dataset: Dataset,
    recording: str,
    read: LevelxRecording,
    dropped: Sequence[tuple[pl.DataFrame, str]],
    subsets: Sequence[Subset],
    notes: Sequence[str],
    map_part: tuple[Part, int] | None = None,
    left_out: pl.DataFrame | None = None,
) -> Canonical:
    """Account for every row and compare the counts with those that tracksMeta announces of motor vehicles.

    Args:
        dataset: name of the dataset.
        recording: name of the recording.
        read: recording as it was read.
        dropped: rows that were read and not used, with reasons, beside those that `read` has.
        subsets: what was made of it.
        notes: messages for the user.
        map_part: the map and the number of its lanelets.
        left_out: rows of vehicles that are left out on purpose, so that none of their rows is missing.
    """
    parts, rows = [*read.parts], [*read.rows_parsed]
    if map_part is not None:
        parts, rows = [*parts, map_part[0]], [*rows, map_part[1]]
    log, rejects = account_rows(dataset, recording, parts, rows, [*read.dropped, *dropped])
    motor = read.vehicles.filter(~pl.col("class").str.to_lowercase().is_in(NO_MOTOR))
    if left_out is not None:
        motor = motor.join(left_out, on="trackId", how="anti", maintain_order="left")
    announced = Announced(
        totals={},
        totals_by=RECORDING_META,
        vehicles=motor.select(
            source_vehicle_id="trackId",
            entries_announced="numFrames",
            first_frame="initialFrame",
            last_frame="finalFrame",
        ),
        vehicles_by=TRACKS_META,
    )
    of_tracks = log.filter(pl.col("dialect").str.ends_with(f"-{TRACKS}"))
    completeness, missing = compare_counts(dataset, recording, subsets, announced, of_tracks)
    found = (f"recording {recording}: {note}" for note in notes)
    return Canonical(tuple(subsets), log, rejects, completeness, (*found, *missing))
