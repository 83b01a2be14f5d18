"""Drives of the sample: cars of its own simulated traffic as instrumented vehicles."""

from dataclasses import dataclass, replace
from pathlib import Path

import polars as pl

from tracklake.pipeline.synthetic.highd import CLASSES
from tracklake.pipeline.synthetic.onboard.instrument import MESSAGE_FILES, TRUTH_FILE, instrument_drive
from tracklake.pipeline.synthetic.onboard.lidar import Lidar
from tracklake.pipeline.synthetic.onboard.radio import Radio
from tracklake.pipeline.synthetic.onboard.sensing import InstrumentConfig

LONGEST_S = 12.0
"""Longest drive in s: the middle part of the ego's way through the window."""
LEAST_HEADING_MPS = 2.0
"""Speed below which vehicles point along the road, in m/s."""


@dataclass(frozen=True)
class DriveScenario:
    """One drive: the folder, the subset whose vehicle is instrumented, and the formats of its logs."""

    folder: str
    subset: str
    formats: tuple[str, ...]
    config: InstrumentConfig


SCENARIOS = (
    DriveScenario(
        "drive-1",
        "02-lower",
        ("wyoming", "rosbag2"),
        # A ray every 0.8 degrees keeps the files small.
        InstrumentConfig(lidar=Lidar(step_deg=0.8), channel=Radio(id_change_s=5.0)),
    ),
    DriveScenario("drive-2", "02-upper", ("bsmp1",), InstrumentConfig(receiver="dgps", penetration=0.9)),
)
RECORDING = "02"
"""Recording whose vehicles are instrumented."""


def write_drive(
    folder: Path, scenario: DriveScenario, tracks: pl.DataFrame, rate_hz: float, seed: int
) -> list[dict[str, object]]:
    """Write one drive, and list its files and the lines of messages and truth as rows of the sample's truth.

    Args:
        folder: folder of the sample.
        scenario: drive to write.
        tracks: simulated tracks of the subset without noise and defects, under the ids of its files.
        rate_hz: frames per second.
        seed: seed of the sample.
    """
    turn = pl.when(pl.col("speed") >= LEAST_HEADING_MPS).then(pl.arctan2("lateral_speed", "speed")).otherwise(0.0)
    entries = tracks.select(
        vehicle_id="vehicle",
        frame="frame",
        time_s=(pl.col("frame") - 1) / rate_hz,
        x_m="x",
        y_m=pl.col("y") + pl.col("length") / 2 * turn.sin(),  # simulated is the middle of the body
        lane="lane",
        speed_mps="speed",
        accel_mps2="accel",
    )
    vehicles = tracks.group_by("vehicle", maintain_order=True).agg(
        pl.col("v_class").first().replace_strict(CLASSES).str.to_lowercase().alias("class"),
        pl.col("length").first().alias("length_m"),
        pl.col("width").first().alias("width_m"),
    )
    longest = entries.group_by("vehicle_id").len().sort(pl.col("len"), "vehicle_id", descending=[True, False])
    ego_id = longest["vehicle_id"][0]
    is_ego, time_s = pl.col("vehicle_id") == ego_id, pl.col("time_s")
    middle_s = entries.filter(is_ego).select((time_s.min() + time_s.max()) / 2).item()
    cut = entries.filter(~is_ego | ((time_s - middle_s).abs() <= LONGEST_S / 2))
    drive = instrument_drive(
        cut,
        vehicles.rename({"vehicle": "vehicle_id"}),
        {"dataset": "highd", "subset": scenario.subset},
        ego_id,
        replace(scenario.config, seed=seed),
        folder / scenario.folder,
        scenario.formats,
    )
    place = {"dataset": "v2v", "recording": scenario.folder, "subset": scenario.subset, "vehicle_id": ego_id}
    files = sorted(file.relative_to(folder).as_posix() for file in drive.out.rglob("*") if file.is_file())
    rows: list[dict[str, object]] = [{"kind": "drive", **place, "file": file, "value": drive.seconds} for file in files]
    lines = {TRUTH_FILE: drive.truth_rows}
    lines |= {MESSAGE_FILES[name][0]: drive.messages for name in scenario.formats if name in MESSAGE_FILES}
    rows += [
        {"kind": "rows", **place, "file": f"{scenario.folder}/{file}", "name": name, "entries": count * counts}
        for file, count in lines.items()
        for name, counts in (("read", 1), ("kept", 1), ("malformed", 0), ("duplicate", 0))
    ]
    return rows
