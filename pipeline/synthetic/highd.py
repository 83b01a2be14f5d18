"""Files in highD's format: three CSVs per recording, exactly as shipped.

Choices where the format leaves some: `dhw` is bumper to bumper (0 without a leader); `thw` = dhw / own speed and
`ttc` = dhw / closing speed, both 0 where that speed is 0 or there is no leader; `numFrames`, `initialFrame` and
`finalFrame` describe the rows in the file, so that a late start begins late in the metadata as well and a missing
frame is not counted; minima of nothing are -1. Sight distances run from the vehicle's centre to the window's ends.
The simulated `y` and lateral speed are those of the body's middle, by which `laneId` is written, too.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.synthetic.neighbors import find_surroundings, gather_values
from tracklake.pipeline.synthetic.recording_errors import get_headway_errors, select_recorded_leaders
from tracklake.pipeline.synthetic.scenarios import HighdScenario
from tracklake.schemas.arrays import Floats

UPPER_FIRST_MARKING_M = 8.5
MEDIAN_M = 4.2
WEEK_DAY = "synthetic"
"""Value of weekDay in recordingMeta: the mark of generated data, which every copy of the file has."""
CLASSES = {1: "Car", 2: "Car", 3: "Truck"}
"""highD knows no motorcycles."""

NEIGHBORS = {
    "precedingId": "leader",
    "followingId": "follower",
    "leftPrecedingId": "left_preceding",
    "leftAlongsideId": "left_alongside",
    "leftFollowingId": "left_following",
    "rightPrecedingId": "right_preceding",
    "rightAlongsideId": "right_alongside",
    "rightFollowingId": "right_following",
}


Markings = tuple[tuple[float, ...], tuple[float, ...]]
"""y of the lane markings in the image, in m, top to bottom: of the upper and of the lower carriageway."""


def build_markings(lanes: int, lane_width_m: float) -> Markings:
    """Build the markings of a site with the same number of lanes on both carriageways."""
    upper = tuple(round(UPPER_FIRST_MARKING_M + i * lane_width_m, 2) for i in range(lanes + 1))
    return upper, tuple(round(upper[-1] + MEDIAN_M + i * lane_width_m, 2) for i in range(lanes + 1))


def build_rows(tracks: pl.DataFrame, markings: Markings, *, upper: bool, window_m: float) -> pl.DataFrame:
    """Build the 25 columns of one carriageway's rows in image coordinates, rounded as in the file, sorted by id, frame.

    The generator's tracks have x from the entrance in the direction of travel; `lost` entries are removed.
    """
    lanes = len(markings[0]) - 1
    sign = -1.0 if upper else 1.0
    x, y, length, width, speed, accel, lateral = (
        tracks[name].to_numpy() for name in ("x", "y", "length", "width", "speed", "accel", "lateral_speed")
    )
    vehicle, lane = tracks["vehicle"].to_numpy(), tracks["lane"].to_numpy().astype(np.int64)
    corner_x = np.round(window_m - x if upper else x - length, 2)
    middle_y = markings[0][-1] - y if upper else markings[1][0] + y
    front = window_m - corner_x if upper else corner_x + length
    around = find_surroundings(tracks.with_columns(pl.Series("x", front)))
    around = replace(around, leader=select_recorded_leaders(around.leader, tracks))
    led = around.leader >= 0
    gap: Floats = np.where(led, gather_values(front - length, around.leader) - front + get_headway_errors(tracks), 0.0)
    leader_speed = gather_values(speed, around.leader)
    x_speed, y_speed = np.round(sign * speed, 2), sign * lateral
    rate_of = _central_acceleration(tracks, y_speed)
    closing = np.round(speed, 2) - np.round(leader_speed, 2)
    columns: dict[str, npt.NDArray[np.generic]] = {
        "frame": tracks["frame"].to_numpy(),
        "id": vehicle,
        "x": corner_x,
        "y": middle_y - width / 2,
        "width": length,
        "height": width,
        "xVelocity": x_speed,
        "yVelocity": y_speed,
        "xAcceleration": sign * accel,
        "yAcceleration": rate_of,
        "frontSightDistance": window_m - (front - length / 2),
        "backSightDistance": front - length / 2,
        "dhw": gap,
        "thw": _divide(gap, np.round(speed, 2)),
        "ttc": _divide(gap, closing),
        "precedingXVelocity": np.where(led, sign * leader_speed, 0.0),
        **{name: gather_values(vehicle, getattr(around, where)) for name, where in NEIGHBORS.items()},
        "laneId": lanes + 2 - lane if upper else lane + lanes + 2,
    }
    # Adding zero turns -0.00 into 0.00.
    rounded = {
        name: np.round(values.astype(np.float64), 2) + 0.0 if values.dtype.kind == "f" else values
        for name, values in columns.items()
    }
    return pl.DataFrame(rounded).filter(~tracks["lost"]).sort("id", "frame")


def _divide(gap: Floats, speed: Floats) -> Floats:
    quotient: Floats = np.divide(gap, speed, out=np.zeros_like(gap), where=speed != 0)
    return quotient


def _central_acceleration(tracks: pl.DataFrame, speed: Floats) -> Floats:
    """Compute the change of lateral speed since the entry before, at 25 Hz; 0 for a track's first entry."""
    same = np.diff(tracks["vehicle"].to_numpy(), prepend=-1) == 0
    steps: Floats = np.where(same, np.diff(speed, prepend=0.0) * 25.0, 0.0)
    return steps


def describe_tracks(rows: pl.DataFrame, classes: Mapping[int, str], *, driving_direction: int) -> pl.DataFrame:
    """Compute the metadata of one carriageway's tracks from the rows of its tracks file."""
    speed = pl.col("xVelocity").abs()
    least = {
        "minDHW": pl.col("dhw").filter(pl.col("precedingId") != 0).min(),
        "minTHW": pl.col("thw").filter((pl.col("precedingId") != 0) & (pl.col("xVelocity") != 0)).min(),
        "minTTC": pl.col("ttc").filter((pl.col("precedingId") != 0) & (pl.col("ttc") > 0)).min(),
    }
    return (
        rows.group_by("id", maintain_order=True)
        .agg(
            pl.col("width", "height").first(),
            initialFrame=pl.col("frame").min(),
            finalFrame=pl.col("frame").max(),
            numFrames=pl.len(),
            drivingDirection=pl.lit(driving_direction),
            traveledDistance=(pl.col("x").last() - pl.col("x").first()).abs(),
            minXVelocity=speed.min(),
            maxXVelocity=speed.max(),
            meanXVelocity=speed.mean(),
            **{name: value.fill_null(-1.0) for name, value in least.items()},
            numLaneChanges=(pl.col("laneId").diff() != 0).sum(),
        )
        .with_columns(pl.col("id").replace_strict(classes, return_dtype=pl.String).alias("class"))
        .select(
            "id", "width", "height", "initialFrame", "finalFrame", "numFrames", "class", "drivingDirection",
            "traveledDistance", "minXVelocity", "maxXVelocity", "meanXVelocity", "minDHW", "minTHW", "minTTC",
            "numLaneChanges",
        )
    )  # fmt: skip


def build_recording(
    scenario: HighdScenario, upper: pl.DataFrame, lower: pl.DataFrame, *, frames: int
) -> dict[str, str]:
    """Build a recording's files, by ending, from its carriageways, whose tracks have `lost` and share no vehicle."""
    markings = build_markings(scenario.road.lanes, scenario.road.lane_width_m)
    window = scenario.road.window_m
    rows, meta = [], []
    for tracks, is_upper, direction in ((upper, True, 1), (lower, False, 2)):
        seen = build_rows(tracks, markings, upper=is_upper, window_m=window)
        classes = {
            vehicle: CLASSES[v_class] for vehicle, v_class in tracks.select("vehicle", "v_class").unique().iter_rows()
        }
        rows.append(seen)
        meta.append(describe_tracks(seen, classes, driving_direction=direction))
    tracks_meta = pl.concat(meta).sort("id")
    duration = frames / scenario.road.rate_hz
    fields = {
        "id": str(int(scenario.recording)),
        "frameRate": f"{scenario.road.rate_hz:.0f}",
        "locationId": str(scenario.location_id),
        "speedLimit": "-1.00",
        "month": scenario.month,
        "weekDay": WEEK_DAY,
        "startTime": scenario.start_time,
        "duration": f"{duration:.6e}" if scenario.exponent else f"{duration:.2f}",
        "totalDrivenDistance": f"{tracks_meta['traveledDistance'].sum():.2f}",
        "totalDrivenTime": f"{int(tracks_meta['numFrames'].sum()) / scenario.road.rate_hz:.2f}",
        "numVehicles": str(tracks_meta.height),
        "numCars": str(int((tracks_meta["class"] == "Car").sum())),
        "numTrucks": str(int((tracks_meta["class"] == "Truck").sum())),
        "upperLaneMarkings": ";".join(f"{value:.2f}" for value in markings[0]),
        "lowerLaneMarkings": ";".join(f"{value:.2f}" for value in markings[1]),
    }
    return {
        "recordingMeta": ",".join(fields) + "\n" + ",".join(fields.values()) + "\n",
        "tracksMeta": tracks_meta.write_csv(float_precision=2),
        "tracks": pl.concat(rows).sort("id", "frame").write_csv(float_precision=2),
    }
