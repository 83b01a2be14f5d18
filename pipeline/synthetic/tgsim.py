"""Files in TGSIM's two dialects, with lane centrelines beside one of them; the generator's road is straight.

Vehicles of I-294 drive to the image's left, those of I-395 down. One vehicle in ten is automated.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.scenarios import CLEAN, TGSIM, Job, Road, Traffic
from tracklake.pipeline.synthetic.truth import FileCount

ROAD = Road(lanes=4, lane_width_m=3.6576, window_m=500.0, rate_hz=10.0, limit_mps=29.0)
TRAFFIC = Traffic(0.3, trucks=0.1, plan=CLEAN)
MARK_S = 42_424.2
"""Time of frame 1 in s: the mark of generated data, as recorded runs begin near 0."""
AUTOMATED_EVERY = 10
"""Number of vehicles among which one is automated."""
EDGE_M = 60.0
"""Place of the carriageway's left edge in the image, in m."""
LINE_STEP_M = 10.0
"""Distance between two points of a centreline, in m."""
COLUMNS = (
    *("id", "time", "xloc_kf", "yloc_kf", "lane_kf", "speed_kf", "acceleration_kf", "length_smoothed"),
    *("width_smoothed", "type_most_common"),
)


@dataclass(frozen=True)
class TgsimScenario:
    """One run: its file, and whether that is a portal's export of I-294 or I-395's original file."""

    file: str
    recording: str
    direction: str
    share: float
    portal: bool


SCENARIOS = (
    TgsimScenario("TGSIM_I-294_L1_Trajectories.csv", "i-294-l1-run-1", "leftward", 1.0, portal=True),
    TgsimScenario("TGSIM_I-294_L1_Trajectories.csv", "i-294-l1-run-2", "leftward", 0.6, portal=True),
    TgsimScenario("I395_final.csv", "i-395", "downward", 0.8, portal=False),
)
CENTRELINES = "I-294-L1-Run_1-geometry-with-ramps.csv"


def list_jobs(minutes: float) -> list[Job]:
    """List the carriageways to simulate."""
    return [
        Job(
            TGSIM,
            each.recording,
            f"{each.recording}-{each.direction}",
            each.file,
            200 + number,
            ROAD,
            TRAFFIC,
            max(1, round(each.share * minutes * 60 * ROAD.rate_hz)),
        )
        for number, each in enumerate(SCENARIOS)
    ]


def write_files(folder: Path, tracks: dict[str, pl.DataFrame]) -> list[FileCount]:
    """Write the files, from noisy tracks by subset, and count their lines."""
    made: dict[str, list[pl.DataFrame]] = {}
    for each in SCENARIOS:
        rows = build_rows(tracks[f"{each.recording}-{each.direction}"], portal=each.portal)
        if each.portal:
            rows = rows.with_columns(run_index=pl.lit(int(each.recording[-1])))
        else:
            names = {name: name.replace("_", "-") for name in rows.columns}
            rows = rows.rename({**names, "id": "ID"})
        made.setdefault(each.file, []).append(rows)
    counts = []
    for file, parts in made.items():
        rows = pl.concat(parts)
        rows.write_csv(folder / file, float_precision=3)
        counts.append(FileCount(file, TGSIM, None, read=rows.height, kept=rows.height))
    lines = build_centrelines()
    lines.write_csv(folder / CENTRELINES, float_precision=3)
    return [*counts, FileCount(CENTRELINES, TGSIM, None, read=lines.height, kept=lines.height)]


def build_rows(tracks: pl.DataFrame, *, portal: bool) -> pl.DataFrame:
    """Build a run's rows, as the portal exports I-294, or without the flag of automated vehicles, as of I-395."""
    middle, across = pl.col("x") - pl.col("length") / 2, EDGE_M - pl.col("y")
    automated = pl.col("vehicle") % AUTOMATED_EVERY == 0
    is_truck = pl.col("v_class") == 3
    named = pl.when(is_truck).then(pl.lit("large-vehicle")).otherwise(pl.lit("small-vehicle"))
    coded = pl.when(automated).then(4).when(is_truck).then(2).otherwise(1)
    rows = tracks.sort("vehicle", "frame").select(
        id="vehicle",
        time=MARK_S + (pl.col("frame") - 1) / ROAD.rate_hz,
        xloc_kf=ROAD.window_m - middle if portal else across,
        yloc_kf=across if portal else middle,
        lane_kf="lane",
        speed_kf="speed",
        acceleration_kf="accel",
        length_smoothed="length",
        width_smoothed="width",
        type_most_common=named if portal else coded,
        **({"acc": pl.when(automated).then(pl.lit("Yes")).otherwise(pl.lit("No"))} if portal else {}),
    )
    return rows.with_columns(pl.col(pl.Float64).round(3) + 0.0)


def build_centrelines() -> pl.DataFrame:
    """Build the lane centrelines of I-294, a line of three columns per lane."""
    x = ROAD.window_m - np.arange(0.0, ROAD.window_m + LINE_STEP_M, LINE_STEP_M)
    lanes = range(1, ROAD.lanes + 1)
    places = {lane: np.full(len(x), EDGE_M - (lane - 0.5) * ROAD.lane_width_m) for lane in lanes}
    columns = [{f"x{lane}": x, f"y{lane}": places[lane], f"ramp{lane}": np.zeros(len(x), np.int64)} for lane in lanes]
    return pl.DataFrame({name: values for one in columns for name, values in one.items()})
