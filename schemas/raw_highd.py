"""highD's three files per recording as shipped (format of levelxdata.com's highD data set, Krajewski et al. 2018).

Image coordinates: y points down; (x, y) is the upper-left corner of an axis-aligned box; `width` is the vehicle's
length along x and `height` its width. Of the tracks file only the columns that the lake keeps are declared; all 25 must
stand in the file.
"""

import polars as pl

from tracklake.schemas.columns import Table, column

RAW_TRACKS_FIELDS = (
    *("frame", "id", "x", "y", "width", "height", "xVelocity", "yVelocity", "xAcceleration", "yAcceleration"),
    *("frontSightDistance", "backSightDistance", "dhw", "thw", "ttc", "precedingXVelocity", "precedingId"),
    *("followingId", "leftPrecedingId", "leftAlongsideId", "leftFollowingId"),
    *("rightPrecedingId", "rightAlongsideId", "rightFollowingId", "laneId"),
)
"""Header of NN_tracks.csv, in order."""

RAW_HIGHD_TRACKS = Table(
    "raw_highd_tracks",
    "One row per line of NN_tracks.csv.",
    key=("line",),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "frame": column(pl.Int32, "from 1", ge=1),
        "id": column(pl.Int32, "of the vehicle", ge=1),
        "x": column(pl.Float64, "upper-left corner of the box", unit="m", ge=-1_000, le=2_000),
        "y": column(pl.Float64, "upper-left corner of the box, pointing down", unit="m", ge=-200, le=200),
        "width": column(pl.Float64, "length of the vehicle", unit="m", ge=0, le=60),
        "height": column(pl.Float64, "width of the vehicle", unit="m", ge=0, le=10),
        "xVelocity": column(pl.Float64, "negative on the upper carriageway", unit="m/s", ge=-100, le=100),
        "yVelocity": column(pl.Float64, "in image coordinates: positive is down", unit="m/s", ge=-50, le=50),
        "xAcceleration": column(pl.Float64, "in image coordinates", unit="m/s2", ge=-200, le=200),
        "dhw": column(pl.Float64, "distance headway to precedingId, 0 = none", unit="m"),
        "precedingId": column(pl.Int32, "vehicle ahead in the lane, 0 = none", ge=0),
        "followingId": column(pl.Int32, "vehicle behind in the lane, 0 = none", ge=0),
        "laneId": column(pl.Int16, "from the top of the image, over both carriageways", ge=0, le=50),
    },
)

RAW_HIGHD_VEHICLES = Table(
    "raw_highd_vehicles",
    "One row per line of NN_tracksMeta.csv.",
    key=("line",),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "id": column(pl.Int32, "of the vehicle", ge=1),
        "width": column(pl.Float64, "length of the vehicle", unit="m", ge=0, le=60),
        "height": column(pl.Float64, "width of the vehicle", unit="m", ge=0, le=10),
        "initialFrame": column(pl.Int32, "first in which the vehicle appears", ge=0, nullable=True),
        "finalFrame": column(pl.Int32, "last in which the vehicle appears", ge=0, nullable=True),
        "numFrames": column(pl.Int32, "rows of the vehicle in the tracks file", ge=1),
        "class": column(pl.String, "Car or Truck"),
        "drivingDirection": column(pl.Int16, "1 upper carriageway (to the left), 2 lower", ge=1, le=2),
    },
)

RAW_VEHICLES_FIELDS = (
    *("id", "width", "height", "initialFrame", "finalFrame", "numFrames", "class", "drivingDirection"),
    *("traveledDistance", "minXVelocity", "maxXVelocity", "meanXVelocity", "minDHW", "minTHW", "minTTC"),
    "numLaneChanges",
)
"""Header of NN_tracksMeta.csv, in order."""

RAW_HIGHD_RECORDING = Table(
    "raw_highd_recording",
    "The one row of NN_recordingMeta.csv.",
    key=("line",),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "id": column(pl.Int32, "of the recording", ge=1),
        "frameRate": column(pl.Float64, "of the camera", unit="Hz", ge=1, le=1_000),
        "locationId": column(pl.Int32, "of the site", ge=0),
        "weekDay": column(pl.String, "of the recording; `synthetic` marks generated files", nullable=True),
        "duration": column(pl.Float64, "of the recording", unit="s", ge=0.01),
        "numVehicles": column(pl.Int32, "in both carriageways", ge=0),
        "numCars": column(pl.Int32, "of them, cars", ge=0, nullable=True),
        "numTrucks": column(pl.Int32, "of them, trucks", ge=0, nullable=True),
        "upperLaneMarkings": column(pl.String, "y of the upper carriageway's markings, `;` between", unit="m"),
        "lowerLaneMarkings": column(pl.String, "y of the lower carriageway's markings, `;` between", unit="m"),
    },
)

RAW_RECORDING_FIELDS = (
    *("id", "frameRate", "locationId", "speedLimit", "month", "weekDay", "startTime", "duration"),
    *("totalDrivenDistance", "totalDrivenTime", "numVehicles", "numCars", "numTrucks"),
    *("upperLaneMarkings", "lowerLaneMarkings"),
)
"""Header of NN_recordingMeta.csv, in order."""
