"""Files in the formats of exiD, inD and rounD: three CSVs per recording, and a Lanelet2 map for exiD's location 0.

Choices where the formats leave some: `leadDHW` is bumper to bumper; of lists the first value is of the lanelet that
the vehicle is on, `latLaneCenterOffset` is positive to its left; no leader is -1, as are the values about it.
"""

from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.synthetic.bent_roads import BENT, LevelxScenario, Line
from tracklake.pipeline.synthetic.lanelet_files import ORIGIN_M, SITE_DEG, Lanelets, list_lanelets, write_map
from tracklake.pipeline.synthetic.neighbors import NO_ROW, find_surroundings, gather_values
from tracklake.pipeline.synthetic.scenarios import Job
from tracklake.pipeline.synthetic.truth import FileCount
from tracklake.schemas.arrays import Floats, Integers

Number = TypeVar("Number", bound=np.generic)

WEEK_DAY = "synthetic"
"""Value of weekday in recordingMeta: the mark of generated data, which every copy of the file has."""
CLASSES = {
    "exid": {1: "motorcycle", 2: "car", 3: "truck"},
    "ind": {1: "car", 2: "car", 3: "truck_bus"},
    "round": {1: "motorcycle", 2: "car", 3: "truck"},
}
LEAST_HEADING_MPS = 2.0
"""Speed below which vehicles point along the road, in m/s."""
WRONG_SIZE_M, WRONG_SIZE_EVERY = 0.15, 7
"""What is added to the width in tracksMeta of every such vehicle, in m."""
NEIGHBORS = {
    "rearId": "follower",
    "leftLeadId": "left_preceding",
    "leftRearId": "left_following",
    "leftAlongsideId": "left_alongside",
    "rightLeadId": "right_preceding",
    "rightRearId": "right_following",
    "rightAlongsideId": "right_alongside",
}
OTHERS_FRAMES = 200
"""Rows of each road user that is none of the traffic."""


class LevelxFormat:
    """The writer of one of the formats."""

    def __init__(self, name: str) -> None:
        self._scenarios = BENT[name]

    def list_jobs(self, minutes: float) -> list[Job]:
        """List the carriageways to simulate."""
        return [
            Job(
                scenario.dataset,
                scenario.recording,
                f"{scenario.recording}-{way.name}",
                _name_file(scenario, "tracks"),
                scenario.index + side,
                scenario.road,
                way.traffic,
                max(1, round(scenario.share * minutes * 60 * scenario.road.rate_hz)),
            )
            for scenario in self._scenarios
            for side, way in enumerate(scenario.ways)
        ]

    def write_files(self, folder: Path, tracks: dict[str, pl.DataFrame]) -> list[FileCount]:
        """Write the recordings, from noisy tracks by subset, and count their lines."""
        return [count for scenario in self._scenarios for count in _write_recording(folder, scenario, tracks)]


LEVELX_FORMATS = {name: LevelxFormat(name) for name in BENT}
"""Writers by format."""


def _name_file(scenario: LevelxScenario, kind: str) -> str:
    return f"{scenario.dataset}/data/{scenario.recording}_{kind}.csv"


def _write_recording(folder: Path, scenario: LevelxScenario, tracks: dict[str, pl.DataFrame]) -> list[FileCount]:
    """Write the files of one recording, and count their lines."""
    lines = [way.course.draw() for way in scenario.ways]
    own = [tracks[f"{scenario.recording}-{way.name}"] for way in scenario.ways]
    rows = [build_rows(each, scenario, line, side) for side, (each, line) in enumerate(zip(own, lines, strict=True))]
    kinds = dict(pl.concat(own).select("vehicle", "v_class").unique().iter_rows())
    named = {vehicle: CLASSES[scenario.dataset][v_class] for vehicle, v_class in kinds.items()}
    others = [] if scenario.dataset == "exid" else _draw_others(max(named, default=-1) + 1, scenario.dataset)
    named |= {int(each["trackId"][0]): name for each, name in others}
    table = pl.concat([*rows, *(each for each, _ in others)], how="diagonal").sort("trackId", "frame")
    table = table.with_columns(recordingId=pl.lit(int(scenario.recording), pl.Int32)).select(rows[0].columns)
    meta = describe_tracks(table, named, scenario)
    frames = int(table.select(pl.col("frame").max().fill_null(0)).item()) + 1
    files = {
        "recordingMeta": _describe_recording(scenario, frames / scenario.road.rate_hz, meta),
        "tracksMeta": meta.write_csv(float_precision=2),
        "tracks": table.write_csv(float_precision=4),
    }
    counts = []
    for kind, text in files.items():
        name, read = _name_file(scenario, kind), text.count("\n") - 1
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(text.encode())
        counts.append(FileCount(name, scenario.dataset, scenario.recording, read=read, kept=read))
    if scenario.has_map:
        name = f"{scenario.dataset}/maps/lanelets/{scenario.location_id}_generated/location{scenario.location_id}.osm"
        written = write_map(
            folder / name, [list_lanelets(scenario.road, line, side) for side, line in enumerate(lines)]
        )
        counts.append(FileCount(name, scenario.dataset, scenario.recording, read=written, kept=written))
    return counts


def build_rows(tracks: pl.DataFrame, scenario: LevelxScenario, line: Line, side: int) -> pl.DataFrame:
    """Build the columns of one carriageway's rows, sorted by trackId, frame.

    The generator's tracks have x of the front from the window's entrance, and y of the body's middle from the left
    edge, along a straight road; the same lengths are laid along the line.
    """
    x, right, length, width, speed, accel, lateral = (
        tracks[name].to_numpy() for name in ("x", "y", "length", "width", "speed", "accel", "lateral_speed")
    )
    vehicle, frame = (tracks[name].to_numpy().astype(np.int64) for name in ("vehicle", "frame"))
    along = x - length / 2
    x_center, y_center, angle = line.locate(along, right)
    bend = line.measure_bend(along)
    stretch = 1 + bend * right
    ahead = speed * stretch
    turn = np.where(ahead >= LEAST_HEADING_MPS, np.arctan2(lateral, np.maximum(ahead, 0.1)), 0.0)
    cosine, sine = np.cos(angle), np.sin(angle)
    to_left = ahead**2 * bend / stretch
    columns: dict[str, npt.NDArray[np.generic] | pl.Series] = {
        "recordingId": np.full(len(x), int(scenario.recording)),
        "trackId": vehicle,
        "frame": frame,
        "trackLifetime": frame - _get_first(vehicle, frame),
        "xCenter": x_center,
        "yCenter": y_center,
        "heading": np.degrees(angle - turn) % 360,
        "width": width,
        "length": length,
        "xVelocity": ahead * cosine + lateral * sine,
        "yVelocity": ahead * sine - lateral * cosine,
        "xAcceleration": accel * stretch * cosine - to_left * sine,
        "yAcceleration": accel * stretch * sine + to_left * cosine,
        "lonVelocity": ahead * np.cos(turn) + lateral * np.sin(turn),
        "latVelocity": ahead * np.sin(turn) - lateral * np.cos(turn),
        "lonAcceleration": accel * stretch,
        "latAcceleration": to_left,
    }
    if scenario.dataset == "exid":
        columns |= _describe_lanes(tracks, list_lanelets(scenario.road, line, side), along, right, vehicle)
        columns |= _describe_neighbors(tracks, speed)
    return pl.DataFrame(columns).sort("trackId", "frame")


def _get_first(vehicle: Integers, values: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return the first value of each entry's vehicle; entries are sorted by vehicle."""
    begins = np.flatnonzero(np.diff(vehicle, prepend=vehicle[:1] - 1))
    return np.repeat(values[begins], np.diff(begins, append=len(vehicle)))


def _describe_lanes(
    tracks: pl.DataFrame, lanelets: Lanelets, along: Floats, right: Floats, vehicle: Integers
) -> dict[str, npt.NDArray[np.generic] | pl.Series]:
    lanes = tracks["lane"].to_numpy().astype(np.int64)
    place = lanelets.find(along, lanes)
    offset = lanelets.find_middle(place, along) - right
    way = along - _get_first(vehicle, along)
    same = np.diff(vehicle, prepend=-1) == 0
    lists = pl.DataFrame(
        {
            "latLaneCenterOffset": np.round(offset, 3),
            "laneWidth": np.full(len(along), lanelets.width_m),
            "laneletId": lanelets.ids[place],
            "lonLaneletPos": np.round(along - lanelets.begin_m[place], 3),
            "laneletLength": lanelets.end_m[place] - lanelets.begin_m[place],
            # Where the ramp joins, its lanelet overlaps with the one beside it, and rows have both.
            "joins": (lanes == lanelets.ramp_lane) & (along > lanelets.end_m[place] - 20),
        }
    )
    texts = lists.select(
        pl.when("joins")
        .then(pl.format("{};{}", name, pl.col(name) + add))
        .otherwise(pl.col(name).cast(pl.String))
        .alias(name)
        for name, add in (
            *(("latLaneCenterOffset", lanelets.width_m), ("laneWidth", 0), ("laneletId", 1_000)),
            *(("lonLaneletPos", 0), ("laneletLength", 0)),
        )
    )
    return {
        "traveledDistance": way,
        "latLaneCenterOffset": texts["latLaneCenterOffset"],
        "laneWidth": texts["laneWidth"],
        "laneletId": texts["laneletId"],
        "laneChange": (same & (np.diff(lanes, prepend=0) != 0)).astype(np.int64),
        "lonLaneletPos": texts["lonLaneletPos"],
        "laneletLength": texts["laneletLength"],
    }


def _describe_neighbors(tracks: pl.DataFrame, speed: Floats) -> dict[str, npt.NDArray[np.generic] | pl.Series]:
    around = find_surroundings(tracks)
    front, length, vehicle = (tracks[name].to_numpy() for name in ("x", "length", "vehicle"))
    led = around.leader != NO_ROW
    gap = gather_values(front - length, around.leader) - front
    closing = speed - gather_values(speed, around.leader)
    lane = tracks["lane"].to_numpy()
    return {
        "leadDHW": np.where(led, gap, -1.0),
        "leadDV": np.where(led, -closing, -1.0),
        "leadTHW": np.where(led & (speed > 0.1), gap / np.maximum(speed, 0.1), -1.0),
        "leadTTC": np.where(led & (closing > 0.1), gap / np.maximum(closing, 0.1), -1.0),
        "leadId": np.where(led, vehicle[around.leader], -1),
        **{
            name: np.where(getattr(around, where) != NO_ROW, vehicle[getattr(around, where)], -1)
            for name, where in NEIGHBORS.items()
        },
        "odrRoadId": np.ones(len(lane), np.int64),
        "odrSectionNo": np.zeros(len(lane), np.int64),
        "odrLaneId": -lane.astype(np.int64),
    }


def _draw_others(first_id: int, dataset: str) -> list[tuple[pl.DataFrame, str]]:
    """Draw road users beside the traffic, by class: a pedestrian, a bicycle and a parked vehicle."""
    parked = {"ind": "truck_bus", "round": "van"}[dataset]
    return [
        (_draw_other(first_id, (30.0, -40.0), 1.2, 0.0, 0.0), "pedestrian"),
        (_draw_other(first_id + 1, (25.0, -90.0), 4.0, 0.0, 0.0), "bicycle"),
        (_draw_other(first_id + 2, (80.0, -20.0), 0.0, 5.4, 2.0), parked),
    ]


def _draw_other(track: int, start: tuple[float, float], speed: float, length: float, width: float) -> pl.DataFrame:
    """Draw the rows of one road user that goes north at constant speed."""
    frame = np.arange(OTHERS_FRAMES)
    rest = ("xVelocity", "xAcceleration", "yAcceleration", "latVelocity", "lonAcceleration", "latAcceleration")
    return pl.DataFrame(
        {
            "trackId": np.full(len(frame), track),
            "frame": frame,
            "trackLifetime": frame,
            "xCenter": np.full(len(frame), start[0]),
            "yCenter": start[1] + speed * frame / 25,
            "heading": np.full(len(frame), 90.0),
            "width": np.full(len(frame), width),
            "length": np.full(len(frame), length),
            "yVelocity": np.full(len(frame), speed),
            "lonVelocity": np.full(len(frame), speed),
            **{name: np.zeros(len(frame)) for name in rest},
        }
    )


def describe_tracks(rows: pl.DataFrame, kinds: dict[int, str], scenario: LevelxScenario) -> pl.DataFrame:
    """Compute the metadata of tracks from the rows of the tracks file."""
    wrong = pl.lit(WRONG_SIZE_M if scenario.other_sizes else 0.0)
    return (
        rows.group_by("recordingId", "trackId", maintain_order=True)
        .agg(
            initialFrame=pl.col("frame").min(),
            finalFrame=pl.col("frame").max(),
            numFrames=pl.len(),
            width=pl.col("width").first(),
            length=pl.col("length").first(),
        )
        .with_columns(
            pl.col("width") + pl.when(pl.col("trackId") % WRONG_SIZE_EVERY == 0).then(wrong).otherwise(0.0),
            pl.col("trackId").replace_strict(kinds, return_dtype=pl.String).alias("class"),
        )
    )


def _describe_recording(scenario: LevelxScenario, seconds: float, meta: pl.DataFrame) -> str:
    others = int(meta["class"].is_in(["pedestrian", "bicycle"]).sum())
    fields = {
        "recordingId": str(int(scenario.recording)),
        "locationId": str(scenario.location_id),
        "frameRate": f"{scenario.road.rate_hz:.1f}",
        "speedLimit": f"{scenario.road.limit_mps:.2f}",
        "weekday": WEEK_DAY,
        "startTime": "10",
        "duration": f"{seconds:.2f}",
        "numTracks": str(meta.height),
        "numVehicles": str(meta.height - others),
        "numVRUs": str(others),
        "latLocation": str(SITE_DEG[0]),
        "lonLocation": str(SITE_DEG[1]),
        "xUtmOrigin": f"{ORIGIN_M[0]:.3f}",
        "yUtmOrigin": f"{ORIGIN_M[1]:.3f}",
        "orthoPxToMeter": "0.1",
    }
    return ",".join(fields) + "\n" + ",".join(fields.values()) + "\n"
