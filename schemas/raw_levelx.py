"""The three files per recording of exiD, inD and rounD as shipped (formats of levelxdata.com).

Metres in the plane of UTM from (xUtmOrigin, yUtmOrigin): x points east, y north. (xCenter, yCenter) is the middle of
the body, `heading` its direction counterclockwise from east. Of the files only the columns that the lake keeps are
declared.
"""

import polars as pl

from tracklake.schemas.columns import Table, column

RAW_URBAN_TRACKS_FIELDS = (
    *("recordingId", "trackId", "frame", "trackLifetime", "xCenter", "yCenter", "heading", "width", "length"),
    *("xVelocity", "yVelocity", "xAcceleration", "yAcceleration"),
    *("lonVelocity", "latVelocity", "lonAcceleration", "latAcceleration"),
)
"""Header of NN_tracks.csv of inD and rounD, in order."""
RAW_EXID_TRACKS_FIELDS = (
    *RAW_URBAN_TRACKS_FIELDS,
    *("traveledDistance", "latLaneCenterOffset", "laneWidth", "laneletId", "laneChange", "lonLaneletPos"),
    *("laneletLength", "leadDHW", "leadDV", "leadTHW", "leadTTC", "leadId", "rearId", "leftLeadId", "leftRearId"),
    *("leftAlongsideId", "rightLeadId", "rightRearId", "rightAlongsideId", "odrRoadId", "odrSectionNo", "odrLaneId"),
)
"""Header of exiD's NN_tracks.csv, in order."""
RAW_LEVELX_VEHICLES_FIELDS = (
    *("recordingId", "trackId", "initialFrame", "finalFrame", "numFrames", "width", "length", "class"),
)
"""Header of NN_tracksMeta.csv, in order."""
RAW_LEVELX_RECORDING_FIELDS = (
    *("recordingId", "locationId", "frameRate", "speedLimit", "weekday", "startTime", "duration", "numTracks"),
    *("numVehicles", "numVRUs", "latLocation", "lonLocation", "xUtmOrigin", "yUtmOrigin", "orthoPxToMeter"),
)
"""Header of NN_recordingMeta.csv, in order."""

_MOTION = {
    "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
    "trackId": column(pl.Int32, "of the road user, from 0", ge=0),
    "frame": column(pl.Int32, "from 0", ge=0),
    "xCenter": column(pl.Float64, "middle of the body, to the east", unit="m", ge=-5_000, le=5_000),
    "yCenter": column(pl.Float64, "middle of the body, to the north", unit="m", ge=-5_000, le=5_000),
    "heading": column(pl.Float64, "of the body, counterclockwise from east", unit="deg", ge=-360, le=360),
    "width": column(pl.Float64, "of the body; 0 for pedestrians and bicycles", unit="m", ge=0, le=10),
    "length": column(pl.Float64, "of the body; 0 for pedestrians and bicycles", unit="m", ge=0, le=60),
    "xVelocity": column(pl.Float64, "to the east", unit="m/s", ge=-100, le=100),
    "yVelocity": column(pl.Float64, "to the north", unit="m/s", ge=-100, le=100),
    "xAcceleration": column(pl.Float64, "to the east", unit="m/s2", ge=-200, le=200),
    "yAcceleration": column(pl.Float64, "to the north", unit="m/s2", ge=-200, le=200),
}

RAW_URBAN_TRACKS = Table(
    "raw_urban_tracks",
    "One row per line of NN_tracks.csv of inD and rounD.",
    key=("line",),
    partition=(),
    columns=_MOTION,
)

RAW_EXID_TRACKS = Table(
    "raw_exid_tracks",
    "One row per line of exiD's NN_tracks.csv. Lists have `;` between; their first values are of the lanelet that the "
    "vehicle is on.",
    key=("line",),
    partition=(),
    columns={
        **_MOTION,
        "latLaneCenterOffset": column(pl.String, "list: distance from the lanelet's middle", unit="m", nullable=True),
        "laneWidth": column(pl.String, "list: of the lanelet", unit="m", nullable=True),
        "laneletId": column(pl.String, "list: id of the lanelet in the Lanelet2 map", nullable=True),
        "leadDHW": column(pl.Float64, "distance headway to leadId, -1 = none", unit="m", nullable=True),
        "leadId": column(pl.Int32, "vehicle ahead in the lane, -1 = none", ge=-1, nullable=True),
        "rearId": column(pl.Int32, "vehicle behind in the lane, -1 = none", ge=-1, nullable=True),
    },
)

RAW_LEVELX_VEHICLES = Table(
    "raw_levelx_vehicles",
    "One row per line of NN_tracksMeta.csv of exiD, inD and rounD.",
    key=("line",),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "trackId": column(pl.Int32, "of the road user, from 0", ge=0),
        "initialFrame": column(pl.Int32, "first in which it appears", ge=0, nullable=True),
        "finalFrame": column(pl.Int32, "last in which it appears", ge=0, nullable=True),
        "numFrames": column(pl.Int32, "its rows in the tracks file", ge=1),
        "width": column(pl.Float64, "may differ from that in the tracks file, which counts", unit="m", ge=0, le=10),
        "length": column(pl.Float64, "may differ from that in the tracks file, which counts", unit="m", ge=0, le=60),
        "class": column(pl.String, "car, van, truck, truck_bus, bus, trailer, motorcycle, bicycle, pedestrian ..."),
    },
)

RAW_LEVELX_RECORDING = Table(
    "raw_levelx_recording",
    "The one row of NN_recordingMeta.csv of exiD, inD and rounD.",
    key=("line",),
    partition=(),
    columns={
        "line": column(pl.Int64, "number of the line in its file, from 1", ge=1),
        "recordingId": column(pl.Int32, "of the recording, from 0", ge=0),
        "locationId": column(pl.Int32, "of the site, from 0", ge=0),
        "frameRate": column(pl.Float64, "of the camera", unit="Hz", ge=1, le=1_000),
        "weekday": column(pl.String, "of the recording; `synthetic` marks generated files", nullable=True),
        "duration": column(pl.Float64, "of the recording", unit="s", ge=0.01),
        "lonLocation": column(pl.Float64, "longitude of the site, WGS-84", unit="deg", nullable=True, ge=-180, le=180),
        "xUtmOrigin": column(pl.Float64, "easting of the tracks' origin, UTM", unit="m"),
        "yUtmOrigin": column(pl.Float64, "northing of the tracks' origin, UTM", unit="m"),
    },
)
