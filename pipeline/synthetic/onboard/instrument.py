"""A drive of virtual instruments as a folder: logs in real formats, and the truth beside them."""

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import polars as pl

from tracklake.pipeline.synthetic.onboard import bag_files
from tracklake.pipeline.synthetic.onboard.bsmp1_files import write_bsmp1
from tracklake.pipeline.synthetic.onboard.hex_files import write_hex
from tracklake.pipeline.synthetic.onboard.pilot_files import write_pilot
from tracklake.pipeline.synthetic.onboard.sensing import TICK_US, InstrumentConfig, SensedDrive, sense_drive
from tracklake.pipeline.synthetic.onboard.truth_files import write_truth
from tracklake.schemas.errors import UsageError, explain_file_errors
from tracklake.schemas.extras import require_extras
from tracklake.schemas.files import name_unfinished
from tracklake.schemas.text import suggest_name

MESSAGE_FILES: Mapping[str, tuple[str, Callable[[Path, pl.DataFrame], None]]] = {
    "wyoming": ("messages.json", partial(write_pilot, dialect="wyoming")),
    "tampa": ("messages.json", partial(write_pilot, dialect="tampa")),
    "hex": ("messages.json", write_hex),
    "bsmp1": ("messages.csv", write_bsmp1),
}
"""File of messages and its writer, by format."""
BAGS: Mapping[str, tuple[str, Literal[1, 2]]] = {"rosbag1": ("drive.bag", 1), "rosbag2": ("bag", 2)}
"""File or folder of a bag and the version of ROS, by format."""
FORMATS = (*MESSAGE_FILES, *BAGS)
"""Formats of a drive's logs."""
DEFAULT_FORMATS = ("wyoming", "rosbag2")
"""Formats of a drive's logs, unless set."""
TRUTH_FILE = "truth.csv"
"""File of the truth in a drive's folder."""


@dataclass(frozen=True)
class DriveSummary:
    """What a drive's folder holds."""

    out: Path
    ego_id: int
    seconds: float
    messages: int
    truth_rows: int
    heard: int
    """Vehicles whose messages were received."""
    vehicles: int
    """Vehicles that came within the radio's range."""
    scans: int
    images: int
    usual_sizes: int
    """Vehicles whose recorded length or width is missing, and was taken as usual for their class."""


def instrument_drive(
    tracks: pl.DataFrame,
    vehicles: pl.DataFrame,
    facts: Mapping[str, Any],
    ego_id: int,
    config: InstrumentConfig,
    out: Path,
    formats: Sequence[str],
) -> DriveSummary:
    """Write the drive of one vehicle of a subset into a folder, which appears whole or not at all.

    LiDAR and camera are in a bag: without one, they are left out.

    Args:
        tracks: the subset's rows of the table `tracks`.
        vehicles: its rows of the table `vehicles`.
        facts: its `dataset` and `subset`.
        ego_id: vehicle_id of the ego.
        config: instruments and their errors.
        out: folder to be made; it is missing or empty.
        formats: some of FORMATS, at most one of messages and at most one bag.

    Raises:
        UsageError: a format, the vehicle or the folder cannot be used.
    """
    require_usable(out, formats)
    if not any(name in BAGS for name in formats):
        config = replace(config, lidar=None, camera=None)
    sensed = sense_drive(tracks, vehicles, facts, ego_id, config)
    unfinished = name_unfinished(out)
    with explain_file_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        unfinished.mkdir()
        try:
            for name in formats:
                if name in MESSAGE_FILES:
                    file, write_messages = MESSAGE_FILES[name]
                    write_messages(unfinished / file, sensed.messages)
                else:
                    _write_bag(unfinished, name, sensed, config)
            write_truth(unfinished / TRUTH_FILE, sensed.truth, sensed.start_us)
            if out.exists():
                out.rmdir()  # empty; Windows does not rename over it
            unfinished.rename(out)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
    return DriveSummary(
        out,
        ego_id,
        float(sensed.motion.time_s[-1] - sensed.motion.time_s[0]),
        sensed.messages.height,
        sensed.truth.height,
        sensed.messages.filter(~pl.col("own"))["sender"].n_unique(),
        sensed.truth["truth_id"].n_unique(),
        len(sensed.scans),
        len(sensed.images),
        sensed.motion.usual_sizes,
    )


def require_usable(out: Path, formats: Sequence[str]) -> None:
    """Refuse formats that are unknown or say the same twice, and a folder that holds something."""
    for name in formats:
        if name not in FORMATS:
            raise UsageError(f"format {name!r}: {suggest_name(name, FORMATS)}")
    for kind, known in (("of messages", MESSAGE_FILES), ("of bags", BAGS)):
        if sum(name in known for name in formats) > 1:
            raise UsageError(
                f"formats: expected at most one {kind} ({', '.join(known)}), got {', '.join(formats)}: a drive that "
                "holds its messages twice is read as duplicates."
            )
    if not formats:
        raise UsageError(f"formats: expected some of {', '.join(FORMATS)}, got none")
    if any(name in BAGS for name in formats):
        require_extras("writing ROS bags", "onboard")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} exists and is not an empty folder. Name another one with --out, or remove it.")


def _write_bag(folder: Path, name: str, sensed: SensedDrive, config: InstrumentConfig) -> None:
    """Write what the ego's own sensors logged; messages of others are in files of their own."""
    file, version = BAGS[name]
    lidar, camera = config.lidar, config.camera
    mounts = {
        sensor: (each.x_m, each.y_m, each.z_m)
        for sensor, each in (("lidar", lidar), ("camera", camera))
        if each is not None
    }
    pinhole = None
    if camera is not None:
        pinhole = bag_files.Camera(
            camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width_px, camera.height_px
        )
    bag_files.write_bag(
        folder / file,
        version=version,
        ego=sensed.messages.filter("own").sort("utc_us"),
        scans=((sensed.start_us + tick * TICK_US, scan.points_m) for tick, scan in enumerate(sensed.scans)),
        images=_list_images(sensed),
        camera=pinhole,
        mounts=mounts,
    )


def _list_images(sensed: SensedDrive) -> Iterator[bag_files.Image]:
    """Yield the images as bags hold them, with a class for each box."""
    for tick, image in enumerate(sensed.images):
        vehicles = sensed.seen[tick]
        classes = tuple("car" if box < 0 else sensed.motion.kind[vehicles[box]] for box in image.box.tolist())
        yield bag_files.Image(sensed.start_us + tick * TICK_US, image.boxes_px, image.score, classes)
