"""Raw files of real size, made quickly: straight traffic without defects, in the exact formats."""

from datetime import datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import polars as pl

from tracklake.schemas.raw_highd import RAW_RECORDING_FIELDS, RAW_TRACKS_FIELDS, RAW_VEHICLES_FIELDS

HIGHD_FRAMES_PER_VEHICLE = 360
NGSIM_FRAMES_PER_VEHICLE = 600


def write_highd(folder: Path, recordings: int, rows: int) -> int:
    """Write highD recordings of about `rows` rows each; returns the rows written."""
    folder.mkdir(parents=True, exist_ok=True)
    return sum(_write_highd_recording(folder, number, rows) for number in range(1, recordings + 1))


def _write_highd_recording(folder: Path, number: int, rows: int) -> int:
    random = np.random.default_rng(number)
    vehicles = max(2, rows // HIGHD_FRAMES_PER_VEHICLE)
    ids = np.arange(1, vehicles + 1)
    upper = ids % 2 == 0
    lane = np.where(upper, 2 + ids // 2 % 2, 5 + ids // 2 % 2)
    speed = random.uniform(24, 34, vehicles).round(2)
    first_frame = 1 + (ids - 1) * 6
    vehicle = np.repeat(np.arange(vehicles), HIGHD_FRAMES_PER_VEHICLE)
    step = np.tile(np.arange(HIGHD_FRAMES_PER_VEHICLE), vehicles)
    along = speed[vehicle] * step / 25
    ahead = np.where(step < HIGHD_FRAMES_PER_VEHICLE - 12, np.maximum(vehicle + 1 - 4, 0), 0)
    sign = np.where(upper, -1, 1)[vehicle]
    rows = len(vehicle)
    gap = random.uniform(10, 80, rows).round(2)
    beside = {
        name: np.where(random.random(rows) < 0.5, ids[vehicle] + offset, 0)
        for offset, name in enumerate(field for field in RAW_TRACKS_FIELDS if field.startswith(("left", "right")))
    }
    columns = {
        "frame": first_frame[vehicle] + step,
        "id": ids[vehicle],
        "x": np.where(upper[vehicle], 420 - along, along).round(2),
        "y": (np.where(upper[vehicle], 8.5, 21.0) + lane[vehicle] + random.normal(0, 0.2, rows)).round(2),
        "width": np.full(rows, 4.5),
        "height": np.full(rows, 1.9),
        "xVelocity": (sign * speed[vehicle]).round(2),
        "yVelocity": random.normal(0, 0.1, rows).round(2),
        "xAcceleration": random.normal(0, 0.2, rows).round(2),
        "yAcceleration": random.normal(0, 0.1, rows).round(2),
        "frontSightDistance": (420 - along).round(2),
        "backSightDistance": along.round(2),
        "dhw": np.where(ahead > 0, gap, 0),
        "thw": np.where(ahead > 0, gap / speed[vehicle], 0).round(2),
        "ttc": np.where(ahead > 0, gap * random.uniform(-9, 9, rows), 0).round(2),
        "precedingXVelocity": np.where(ahead > 0, sign * speed[vehicle] + 0.5, 0).round(2),
        "precedingId": ahead,
        "followingId": np.minimum(vehicle + 1 + 4, vehicles),
        **beside,
        "laneId": lane[vehicle],
    }
    tracks = pl.DataFrame({name: columns[name] for name in RAW_TRACKS_FIELDS})
    tracks.write_csv(folder / f"{number:02d}_tracks.csv")
    meta = pl.DataFrame({"id": ids}).with_columns(
        width=4.5,
        height=1.9,
        initialFrame=pl.Series(first_frame),
        finalFrame=pl.Series(first_frame + HIGHD_FRAMES_PER_VEHICLE - 1),
        numFrames=HIGHD_FRAMES_PER_VEHICLE,
        drivingDirection=pl.Series(np.where(upper, 1, 2)),
        traveledDistance=400.0,
        minXVelocity=24.0,
        maxXVelocity=34.0,
        meanXVelocity=29.0,
        minDHW=-1.0,
        minTHW=-1.0,
        minTTC=-1.0,
        numLaneChanges=0,
        **{"class": pl.lit("Car")},
    )
    meta.select(*RAW_VEHICLES_FIELDS).write_csv(folder / f"{number:02d}_tracksMeta.csv")
    duration = (first_frame[-1] + HIGHD_FRAMES_PER_VEHICLE) / 25
    values = (number, 25, 1 + number % 6, -1, "09.2017", "Tue", "08:38", duration, 1.0, 1.0, vehicles, vehicles, 0)
    lines = [",".join(RAW_RECORDING_FIELDS), ",".join(map(str, values)) + ",8.51;12.59;16.43,21.00;24.96;28.80"]
    (folder / f"{number:02d}_recordingMeta.csv").write_text("\n".join(lines) + "\n")
    return tracks.height


def ngsim_rows(rows: int, recordings: int) -> pl.DataFrame:
    """About `rows` rows of NGSIM's 18 columns in several recordings, as text where the portal quotes thousands."""
    frames = []
    for number in range(recordings):
        random = np.random.default_rng(number)
        vehicles = max(2, rows // recordings // NGSIM_FRAMES_PER_VEHICLE)
        vehicle = np.repeat(np.arange(vehicles), NGSIM_FRAMES_PER_VEHICLE)
        step = np.tile(np.arange(NGSIM_FRAMES_PER_VEHICLE), vehicles)
        frame = 10 + vehicle * 4 + step
        start = datetime(2005, 6, 15, 9 + number, tzinfo=ZoneInfo("America/Los_Angeles"))
        base = int(start.timestamp() * 1000) - 100
        speed = random.uniform(20, 60, vehicles).round(2)
        along = (speed[vehicle] * step / 10).round(3)
        preceding = np.maximum(vehicle + 1 - 5, 0)
        spacing = random.gamma(4, 25, len(vehicle)).round(2)
        frames.append(
            pl.DataFrame(
                {
                    "Vehicle_ID": vehicle + 1,
                    "Frame_ID": frame,
                    "Total_Frames": np.full(len(vehicle), NGSIM_FRAMES_PER_VEHICLE),
                    "Global_Time": base + 100 * frame,
                    "Local_X": (6 + 12 * (vehicle % 5) + random.normal(0, 0.5, len(vehicle))).round(3),
                    "Local_Y": along,
                    "Global_X": (6_042_842.0 + along).round(3),
                    "Global_Y": (2_133_117.0 + along).round(3),
                    "v_length": np.full(len(vehicle), 14.5),
                    "v_Width": np.full(len(vehicle), 4.9),
                    "v_Class": np.full(len(vehicle), 2),
                    "v_Vel": speed[vehicle],
                    "v_Acc": random.normal(0, 1, len(vehicle)).round(2),
                    "Lane_ID": 1 + vehicle % 5,
                    "Preceding": preceding,
                    "Following": np.minimum(vehicle + 1 + 5, vehicles),
                    "Space_Headway": np.where(preceding > 0, spacing, 0.0),
                    "Time_Headway": np.where(preceding > 0, spacing / speed[vehicle], 0.0).round(2),
                }
            )
        )
    return pl.concat(frames)


TEXT_WIDTHS = (6, 6, 6, 14, 9, 9, 12, 12, 6, 6, 2, 8, 8, 4, 6, 6, 9, 8)
"""Widths of the 18 fields, in characters; with the blanks between them a line has 156 bytes (originals: 160)."""


def write_text(path: Path, rows: pl.DataFrame) -> None:
    """The original whitespace-delimited text: columns padded to a width, blanks at both ends of a line."""
    widths = zip(rows.columns, TEXT_WIDTHS, strict=True)
    padded = [pl.col(name).cast(pl.String).str.pad_start(width) for name, width in widths]
    lines = rows.select(line=pl.concat_str(padded, separator=" ") + " ")
    lines.write_csv(path, include_header=False, quote_style="never")


def write_export(path: Path, rows: pl.DataFrame, fields: tuple[str, ...], seed: int = 1) -> None:
    """The portal's 25-column export: BOM, CRLF, quoted thousands, not in order."""
    thousands = ("Total_Frames", "Preceding", "Following", "Space_Headway", "Time_Headway")
    quoted = {}
    for name in thousands:
        text = pl.col(name).cast(pl.String)
        quoted[name] = (
            pl.when(pl.col(name) >= 1_000)
            .then(pl.lit('"') + text.str.replace(r"^(\d+)(\d{3})", "$1,$2") + pl.lit('"'))
            .otherwise(text)
        )
    empty = {name: pl.lit("") for name in fields if name not in rows.columns and name != "Location"}
    shuffled = rows.sample(fraction=1.0, shuffle=True, seed=seed)
    body = shuffled.with_columns(**quoted, **empty, Location=pl.lit("us-101")).select(*fields)
    with path.open("wb") as file:
        file.write(b"\xef\xbb\xbf")
        body.write_csv(file, quote_style="never", line_terminator="\r\n")
