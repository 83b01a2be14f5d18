"""What an instrumented vehicle perceives: camera boxes, LiDAR returns and clusters, and the vehicles around it.

Frame of the ego: x ahead and y to the right of its centre, z up from the ground, in m.
"""

import polars as pl

from tracklake.schemas.columns import PLACE, SEVERITIES, Table, column
from tracklake.schemas.drives import TICK, TIME_S, VEHICLE_ID

FIRST_LIDAR_ID = 1_000_000
"""Least vehicle_id of vehicles that sent no messages and that only LiDAR saw."""
SIDES = ("rear", "front", "left", "right")
"""Sides of a vehicle that LiDAR returns can lie on, as its driver names them."""

DETECTIONS = Table(
    "detections",
    "One row per camera box.",
    key=("time_s", "detection"),
    columns={
        **PLACE,
        "time_s": TIME_S,
        "detection": column(pl.Int32, "number within its image, from 0", ge=0),
        "left_px": column(pl.Float32, "left edge, from the image's left", unit="px"),
        "top_px": column(pl.Float32, "upper edge, from the image's top", unit="px"),
        "width_px": column(pl.Float32, "width of the box", unit="px", gt=0),
        "height_px": column(pl.Float32, "height of the box", unit="px", gt=0),
        "score": column(pl.Float32, "the detector's confidence", nullable=True, ge=0, le=1),
        "class": column(pl.String, "as the detector names it", nullable=True),
    },
)


LIDAR_RETURNS = Table(
    "lidar_returns",
    "One row per LiDAR return above the ground, in the ego's frame.",
    key=("scan", "point"),
    columns={
        **PLACE,
        "scan": column(pl.Int32, "number of the scan in the drive, from 0", ge=0),
        "point": column(pl.Int32, "number of the return in its scan, from 0", ge=0),
        "time_s": TIME_S,
        "x_m": column(pl.Float32, "ahead of the ego's centre", unit="m"),
        "y_m": column(pl.Float32, "to the right of the ego's centre", unit="m"),
        "z_m": column(pl.Float32, "above the ground", unit="m"),
    },
)


LIDAR_CLUSTERS = Table(
    "lidar_clusters",
    "One row per cluster of LiDAR returns.",
    key=("tick", "cluster"),
    columns={
        **PLACE,
        "tick": TICK,
        "cluster": column(pl.Int32, "number within its tick, from 0", ge=0),
        "returns": column(pl.Int32, "returns in the cluster", ge=1),
        "x_m": column(pl.Float32, "mean of the returns, ahead of the ego's centre", unit="m"),
        "y_m": column(pl.Float32, "mean of the returns, to the right of the ego's centre", unit="m"),
        "nearest_x_m": column(pl.Float32, "the return nearest to the ego: ahead", unit="m"),
        "nearest_y_m": column(pl.Float32, "the return nearest to the ego: to the right", unit="m"),
        "least_x_m": column(pl.Float32, "extent along the ego's axis, rearmost", unit="m"),
        "most_x_m": column(pl.Float32, "extent along the ego's axis, foremost", unit="m"),
        "least_y_m": column(pl.Float32, "extent across, leftmost", unit="m"),
        "most_y_m": column(pl.Float32, "extent across, rightmost", unit="m"),
        "height_m": column(pl.Float32, "highest return above the ground", unit="m"),
    },
)


ASSOCIATION = Table(
    "association",
    "One row per vehicle and tick with something assigned to it: a cluster, a camera box, or both.",
    key=("vehicle_id", "tick"),
    columns={
        **PLACE,
        "vehicle_id": VEHICLE_ID,
        "tick": TICK,
        "cluster": column(pl.Int32, "its LiDAR cluster; null = none", nullable=True, ge=0),
        "detection": column(pl.Int32, "its camera box, of the image nearest in time; null = none", nullable=True, ge=0),
        "side": column(pl.String, "side of the vehicle that the returns lie on", nullable=True, isin=SIDES),
        "distance_m": column(
            pl.Float32, "from the predicted centre to that of the cluster", unit="m", nullable=True, ge=0
        ),
        "gate": column(pl.Float32, "squared Mahalanobis distance of the cluster's centre", nullable=True, ge=0),
        "candidates": column(pl.Int32, "clusters within the gate", ge=0),
    },
)


SURROUNDING = Table(
    "surrounding",
    "One row per vehicle around the ego and tick: what the ego knows of it by then, and what it knew afterwards "
    "(smoothed).",
    key=("vehicle_id", "tick"),
    columns={
        **PLACE,
        "vehicle_id": VEHICLE_ID,
        "tick": TICK,
        "rel_x_m": column(pl.Float64, "its centre ahead of the ego's, by records until now alone", unit="m"),
        "rel_y_m": column(pl.Float64, "its centre to the right of the ego's, likewise", unit="m"),
        "rel_speed_x_mps": column(pl.Float32, "its velocity minus the ego's, along the ego's axis", unit="m/s"),
        "rel_speed_y_mps": column(pl.Float32, "its velocity minus the ego's, to the ego's right", unit="m/s"),
        "speed_mps": column(pl.Float32, "its own speed over ground", unit="m/s", ge=0),
        "accel_mps2": column(pl.Float32, "along its heading", unit="m/s2"),
        "rel_heading_deg": column(pl.Float32, "its heading minus the ego's, clockwise", unit="deg", ge=-180, le=180),
        "steering_angle_deg": column(
            pl.Float32,
            "of its steering wheel as sent, positive to the right; null where not sent",
            unit="deg",
            nullable=True,
        ),
        "box_x_m": column(pl.Float32, "centre of its box, ahead of the ego's centre", unit="m"),
        "box_y_m": column(pl.Float32, "centre of its box, to the right of the ego's centre", unit="m"),
        "box_z_m": column(pl.Float32, "centre of its box above the ground", unit="m"),
        "box_length_m": column(pl.Float32, "as sent or measured, else a usual one", unit="m", gt=0),
        "box_width_m": column(pl.Float32, "as sent or measured, else a usual one", unit="m", gt=0),
        "box_height_m": column(pl.Float32, "measured, else a usual one", unit="m", gt=0),
        "from_v2v": column(pl.Boolean, "a message arrived since the tick before"),
        "from_lidar": column(pl.Boolean, "a LiDAR cluster was assigned"),
        "from_camera": column(pl.Boolean, "a camera box was assigned"),
        "since_message_s": column(
            pl.Float32, "age of its last message; null = none yet", unit="s", nullable=True, ge=0
        ),
        "cov_xx_m2": column(pl.Float32, "variance of rel_x_m", unit="m2", ge=0),
        "cov_xy_m2": column(pl.Float32, "covariance of rel_x_m and rel_y_m", unit="m2"),
        "cov_yy_m2": column(pl.Float32, "variance of rel_y_m", unit="m2", ge=0),
        "smoothed_x_m": column(pl.Float64, "rel_x_m by all records of the drive (RTS smoother)", unit="m"),
        "smoothed_y_m": column(pl.Float64, "rel_y_m by all records of the drive", unit="m"),
        "smoothed_speed_mps": column(pl.Float32, "speed_mps by all records of the drive", unit="m/s", ge=0),
        "smoothed_accel_mps2": column(pl.Float32, "accel_mps2 by all records of the drive", unit="m/s2"),
    },
)


SURROUNDING_TRUTH = Table(
    "surrounding_truth",
    "One row per vehicle near the ego and tick of a synthetic drive: where it truly was, from the overhead recording.",
    key=("truth_id", "tick"),
    columns={
        **PLACE,
        "truth_id": column(pl.Int32, "vehicle_id in the overhead recording", ge=0),
        "tick": TICK,
        "truth_dataset": column(pl.String, "dataset of the overhead recording"),
        "truth_subset": column(pl.String, "subset of the overhead recording"),
        "vehicle_id": column(pl.Int32, "the same vehicle in the drive; null where it never sent", nullable=True, ge=0),
        "connected": column(pl.Boolean, "whether it sends messages"),
        "rel_x_m": column(pl.Float64, "its centre ahead of the ego's", unit="m"),
        "rel_y_m": column(pl.Float64, "its centre to the right of the ego's", unit="m"),
        "rel_heading_deg": column(pl.Float32, "its heading minus the ego's, clockwise", unit="deg", ge=-180, le=180),
        "speed_mps": column(pl.Float32, "its own speed", unit="m/s"),
        "accel_mps2": column(pl.Float32, "along its heading", unit="m/s2", nullable=True),
        "ego_speed_mps": column(pl.Float32, "the ego's speed", unit="m/s"),
        "ego_yaw_deg": column(pl.Float64, "the ego's heading from the road's axis, clockwise", unit="deg"),
        "ego_x_m": column(pl.Float64, "the ego's centre along the road", unit="m"),
        "ego_y_m": column(pl.Float64, "the ego's centre from the carriageway's left edge", unit="m"),
        "lane": column(pl.Int16, "its lane; null where unknown", nullable=True),
        "ego_lane": column(pl.Int16, "the ego's lane; null where unknown", nullable=True),
        "length_m": column(pl.Float32, "of the vehicle", unit="m", gt=0),
        "width_m": column(pl.Float32, "of the vehicle", unit="m", gt=0),
        "visible": column(
            pl.Float32, "share of its outline in free sight of the LiDAR; null without LiDAR", nullable=True, ge=0, le=1
        ),
    },
)


DRIVE_FINDINGS = Table(
    "drive_findings",
    "One row per run of consecutive ticks or messages of one vehicle of a drive that breaks one rule.",
    key=("rule", "vehicle_id", "first_tick"),
    columns={
        **PLACE,
        "vehicle_id": VEHICLE_ID,
        "rule": column(pl.String, "the rule's name"),
        "severity": column(pl.String, "error, warning or info", isin=SEVERITIES),
        "first_tick": column(pl.Int32, "first tick of the run", ge=0),
        "last_tick": column(pl.Int32, "last tick of the run", ge=0),
        "entries": column(pl.Int32, "ticks or messages in the run", ge=1),
        "worst": column(pl.Float64, "the most extreme value in the run, in the rule's unit"),
    },
)


DRIVE_CHECKS = Table(
    "drive_checks",
    "One row per rule of a drive: how many messages or ticks it was checked on, and how many break it.",
    key=("rule",),
    columns={
        **PLACE,
        "rule": column(pl.String, "the rule's name"),
        "severity": column(pl.String, "error, warning or info", isin=SEVERITIES),
        "checked": column(pl.Int64, "messages or ticks with what the rule reads; 0: not checked", ge=0),
        "entries": column(pl.Int64, "messages or ticks that break it", ge=0),
        "vehicles": column(pl.Int32, "vehicles with one", ge=0),
        "runs": column(pl.Int32, "rows of drive_findings", ge=0),
        "worst": column(pl.Float64, "the most extreme value, in the rule's unit; null = none breaks it", nullable=True),
    },
)
