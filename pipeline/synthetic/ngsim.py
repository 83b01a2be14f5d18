"""Files in NGSIM's formats: the original 18-column text, the same as CSV, and the portal's 25-column export.

Choices where the format leaves some: Total_Frames counts the rows of the vehicle in the file, so that neither what a
late start lost nor a missing frame is in it; Space_Headway is front to front; Time_Headway is 9999.99 for a standing
vehicle with a leader and 0 without a leader.
"""

from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.neighbors import find_surroundings, gather_values
from tracklake.pipeline.synthetic.recording_errors import get_headway_errors, select_recorded_leaders

FOOT_M = 0.3048
LOCATION = "us-101"
DAY = "2005-06-15"
ZONE = ZoneInfo("America/Los_Angeles")
MARK_MS = 42
"""Milliseconds past the full second of frame 1, and so past the tenth in every Global_Time: the mark of generated data.
Recorded times end in 00."""
STANDING_HEADWAY = 9999.99
ORIGIN_FT = (6_451_110.0, 1_873_360.0)
HEADING_RAD = -0.7653
"""Direction of the section on the state's plane in rad; only Global_X and Global_Y depend on it."""

COLUMNS = (
    "Vehicle_ID", "Frame_ID", "Total_Frames", "Global_Time", "Local_X", "Local_Y", "Global_X", "Global_Y", "v_Length",
    "v_Width", "v_Class", "v_Vel", "v_Acc", "Lane_ID", "Preceding", "Following", "Space_Headway", "Time_Headway",
)  # fmt: skip
DECIMALS = {
    "Local_X": 3, "Local_Y": 3, "Global_X": 3, "Global_Y": 3, "v_Length": 1, "v_Width": 1, "v_Vel": 2, "v_Acc": 2,
    "Space_Headway": 2, "Time_Headway": 2,
}  # fmt: skip
ZONES = ("O_Zone", "D_Zone", "Int_ID", "Section_ID", "Direction", "Movement")
PORTAL_COLUMNS = tuple("v_length" if name == "v_Length" else name for name in COLUMNS[:14])
PORTAL_COLUMNS += (*ZONES, *COLUMNS[14:], "Location")
SEPARATED = ("Total_Frames", "Preceding", "Following", "Space_Headway", "Time_Headway")
"""Columns that the portal writes with thousands separators, quoted where one occurs."""
TEXT_WIDTHS = (5, 6, 6, 14, 8, 9, 12, 12, 5, 5, 2, 6, 7, 3, 6, 6, 9, 8)


def compute_time_key(start_time: str) -> int:
    """Compute Global_Time - 100 * Frame_ID of a recording by the local time of frame 1 (`HH:MM`), less its MARK_MS."""
    local = datetime.fromisoformat(f"{DAY}T{start_time}").replace(tzinfo=ZONE)
    return round(local.timestamp() * 1000) + MARK_MS - 100


def name_recording(start_time: str) -> str:
    """Name a recording by site, local date and local time of frame 1, as unpublished recordings are named."""
    return f"{LOCATION}-{DAY.replace('-', '')}-{start_time.replace(':', '')}00"


def build_rows(tracks: pl.DataFrame, start_time: str) -> pl.DataFrame:
    """Build a recording's 18 columns, in feet, rounded as in the files, sorted by Vehicle_ID, Frame_ID.

    `lost` entries are removed; `start_time` is the local time of frame 1, `HH:MM`.
    """
    x_ft, y_ft, length_ft, width_ft, speed, accel = (
        tracks[name].to_numpy() / FOOT_M for name in ("x", "y", "length", "width", "speed", "accel")
    )
    x_ft, y_ft, speed = np.round(x_ft, 3), np.round(y_ft, 3), np.round(speed, 2) + 0.0
    vehicle, frame = tracks["vehicle"].to_numpy(), tracks["frame"].to_numpy().astype(np.int64)
    around = find_surroundings(tracks.with_columns(pl.Series("x", x_ft), pl.Series("length", length_ft)))
    leader = select_recorded_leaders(around.leader, tracks)
    led = leader >= 0
    headway = np.where(led, np.round(gather_values(x_ft, leader) - x_ft + get_headway_errors(tracks) / FOOT_M, 2), 0.0)
    moving = speed > 0
    seconds = np.divide(headway, speed, out=np.full_like(headway, STANDING_HEADWAY), where=moving)
    east, north = np.cos(HEADING_RAD), np.sin(HEADING_RAD)
    rows = pl.DataFrame(
        {
            "Vehicle_ID": vehicle,
            "Frame_ID": frame,
            "Total_Frames": frame,
            "Global_Time": compute_time_key(start_time) + 100 * frame,
            "Local_X": y_ft,
            "Local_Y": x_ft,
            "Global_X": ORIGIN_FT[0] + east * x_ft + north * y_ft,
            "Global_Y": ORIGIN_FT[1] + north * x_ft - east * y_ft,
            "v_Length": length_ft,
            "v_Width": width_ft,
            "v_Class": tracks["v_class"],
            "v_Vel": speed,
            "v_Acc": accel,
            "Lane_ID": tracks["lane"],
            "Preceding": gather_values(vehicle, leader),
            "Following": gather_values(vehicle, around.follower),
            "Space_Headway": headway,
            "Time_Headway": np.where(led, np.minimum(seconds, STANDING_HEADWAY), 0.0),
        }
    )
    return (
        rows.filter(~tracks["lost"])
        .with_columns(Total_Frames=pl.len().over("Vehicle_ID"))
        .sort("Vehicle_ID", "Frame_ID")
    )


def fixed(column: str, decimals: int) -> pl.Expr:
    """Format a number with a fixed number of decimals, never as `-0.00`."""
    scaled = (pl.col(column) * 10**decimals).round().cast(pl.Int64)
    sign = pl.when(scaled < 0).then(pl.lit("-")).otherwise(pl.lit(""))
    whole, part = (scaled.abs() // 10**decimals).cast(pl.String), (scaled.abs() % 10**decimals).cast(pl.String)
    return pl.concat_str(sign, whole, pl.lit("."), part.str.zfill(decimals)).alias(column)


def _as_text(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.select(
        fixed(name, DECIMALS[name]) if name in DECIMALS else pl.col(name).cast(pl.String) for name in COLUMNS
    )


def format_text(rows: pl.DataFrame) -> list[str]:
    """Format lines of the original text: 18 columns, right-aligned, separated by blanks, no header."""
    padded = (pl.col(name).str.pad_start(width) for name, width in zip(COLUMNS, TEXT_WIDTHS, strict=True))
    return _as_text(rows).select(pl.concat_str(padded, separator=" ")).to_series().to_list()


def format_csv(rows: pl.DataFrame) -> list[str]:
    """Format lines of the 18 columns as CSV, the header first."""
    return [",".join(COLUMNS), *_as_text(rows).select(pl.concat_str(pl.all(), separator=",")).to_series().to_list()]


def format_portal(rows: pl.DataFrame) -> list[str]:
    """Format lines of the 25-column export, the header first, without BOM and line ends.

    Trailing zeros are trimmed (`15`, `33.96`), thousands separated and quoted (`"1,156"`) in SEPARATED.
    """
    trimmed = _as_text(rows).with_columns(
        pl.col(name).str.strip_chars_end("0").str.strip_suffix(".") for name in DECIMALS
    )
    separated = trimmed.with_columns(
        pl.col(name).str.replace(r"^(-?\d{1,3})(\d{3})(\.\d+)?$", '"$1,$2$3"') for name in SEPARATED
    )
    whole = separated.rename({"v_Length": "v_length"}).with_columns(
        *(pl.lit("").alias(name) for name in ZONES), Location=pl.lit(LOCATION)
    )
    return [",".join(PORTAL_COLUMNS), *whole.select(pl.concat_str(PORTAL_COLUMNS, separator=",")).to_series().to_list()]


def shuffle_rows(rows: pl.DataFrame, random: np.random.Generator) -> pl.DataFrame:
    """Shuffle rows like the portal's export: vehicles in random order, many of them last frame first."""
    keys = rows.select("Global_Time", "Frame_ID", "Vehicle_ID").with_columns(
        base=pl.col("Global_Time") - 100 * pl.col("Frame_ID")
    )
    vehicles = keys.select("base", "Vehicle_ID").unique(maintain_order=True)
    drawn = vehicles.with_columns(
        pl.Series("place", random.permutation(vehicles.height)),
        pl.Series("direction", np.where(random.random(vehicles.height) < 0.6, -1, 1)),
    )
    order = keys.join(drawn, on=("base", "Vehicle_ID"), maintain_order="left").select(
        "place", step=pl.col("direction") * pl.col("Frame_ID")
    )
    return rows[order.select(pl.arg_sort_by("place", "step")).to_series()]
