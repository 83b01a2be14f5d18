"""Rows of a drive's tables, sound and of one value each but for what a test says."""

from collections.abc import Sequence

import polars as pl

from tracklake.quality_reports.rules.along_messages import measure_boxes, prepare_messages
from tracklake.quality_reports.rules.rule import Rule
from tracklake.schemas import BSM, EGO_STATES, SURROUNDING, Table

DRIVE = {"dataset": "v2v", "subset": "drive-1"}
USUAL = {
    BSM.name: {
        **{"vehicle_id": 1, "own": False, "temporary_id": "0000000A", "lost_before": 0, "lat_deg": 0.0, "lon_deg": 0.0},
    },
    EGO_STATES.name: {"source": "gnss", "lat_deg": 0.0, "lon_deg": 0.0, "speed_mps": 0.0, "heading_deg": 0.0},
    SURROUNDING.name: {
        **dict.fromkeys(("from_v2v", "from_lidar", "from_camera"), False),
        **{"vehicle_id": 1, "box_length_m": 4.5, "box_width_m": 1.8, "box_height_m": 1.5},
        **dict.fromkeys(("rel_heading_deg", "cov_xy_m2", "cov_xx_m2", "cov_yy_m2", "speed_mps", "accel_mps2"), 0.0),
        **dict.fromkeys(("rel_x_m", "rel_y_m", "rel_speed_x_mps", "rel_speed_y_mps", "box_x_m", "box_y_m"), 0.0),
        **dict.fromkeys(("smoothed_x_m", "smoothed_y_m", "smoothed_speed_mps", "smoothed_accel_mps2", "box_z_m"), 0.0),
    },
}
"""Values of a table's columns where a test names none; others are null."""


def make_rows(table: Table, **columns: Sequence[object]) -> pl.DataFrame:
    """Return rows of a table of one drive, in the order given."""
    height = len(next(iter(columns.values())))
    usual = {**DRIVE, **USUAL.get(table.name, {})}
    values = {name: columns.get(name, [usual.get(name)] * height) for name in table.dtypes}
    return pl.DataFrame({name: list(own) for name, own in values.items()}, schema=table.dtypes)


def lay_out_case(rule: Rule) -> pl.DataFrame:
    """Return a drive rule's case as prepared messages or ticks."""
    entries = rule.case.entries
    if rule.over == "messages":
        return prepare_messages(make_rows(BSM, **entries))
    placed = {name: entries[name] for name in ("message_x_m", "message_y_m")}
    ticks = make_rows(SURROUNDING, tick=range(len(placed["message_x_m"])), **{
        name: values for name, values in entries.items() if name not in placed
    })  # fmt: skip
    return measure_boxes(ticks.with_columns(pl.Series(name, values) for name, values in placed.items()))
