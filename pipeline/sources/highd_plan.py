"""highD's subsets from the metadata files alone, to plan a split before any track has been read."""

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from tracklake.pipeline.sources.highd import CARRIAGEWAYS, FIRST_FRAME, HIGHD_FORMAT, find_origin, read_metadata
from tracklake.pipeline.sources.source import RawFile, SourceError, Unit
from tracklake.pipeline.transforms.splits.tables import COLUMNS


@dataclass(frozen=True)
class Announcement:
    """The subsets that metadata files announce, and messages about recordings that cannot be used.

    A row per carriageway with vehicles: the columns of `splits.tables.COLUMNS`, `recording`, `origin`, `lanes` and
    `seconds`. `weight` is the sum of numFrames.
    """

    subsets: pl.DataFrame
    refusals: tuple[str, ...]


def announce_subsets(files: Sequence[RawFile]) -> Announcement:
    """Read recordingMeta and tracksMeta of every recording among highD's files; tracks may be missing.

    Raises:
        SourceError: none of them is a recordingMeta or tracksMeta file.
    """
    grouping = HIGHD_FORMAT.group_metadata(files)
    if not grouping.units and not grouping.refusals:
        raise SourceError(
            "no metadata of highD there. Expected NN_recordingMeta.csv and NN_tracksMeta.csv with the headers as "
            f"shipped, got {len(files)} other file(s) of highD. Give the folder with the downloads, unpacked or not."
        )
    rows: list[dict[str, object]] = []
    refusals = list(grouping.refusals)
    for unit in grouping.units:
        try:
            rows += _describe_carriageways(unit)
        except SourceError as damage:
            refusals.append(str(damage))
    schema = {**COLUMNS, "recording": pl.String, "origin": pl.String, "lanes": pl.Int64, "seconds": pl.Float64}
    return Announcement(pl.DataFrame(rows, schema=schema), tuple(refusals))


def _describe_carriageways(unit: Unit) -> list[dict[str, object]]:
    """Describe the carriageways of a recording, a row each."""
    recording = str(unit.recording)
    meta, lanes, vehicles = read_metadata(unit.files, recording)
    rows: list[dict[str, object]] = []
    for direction, side in CARRIAGEWAYS.items():
        own = vehicles.filter(pl.col("drivingDirection") == direction)
        if own.is_empty():
            continue
        rows.append(
            {
                "dataset": "highd",
                "subset": f"{recording}-{side}",
                "site": f"location-{meta['locationId']}",
                "direction": side,
                "vehicles": own.height,
                "weight": own["numFrames"].cast(pl.Int64).sum(),
                "vehicles_per_lane_s": own.height / lanes[direction] / meta["duration"],
                "first_frame": FIRST_FRAME,
                "last_frame": own["finalFrame"].max() or FIRST_FRAME,
                "recording": recording,
                "origin": find_origin(meta),
                "lanes": lanes[direction],
                "seconds": meta["duration"],
            }
        )
    return rows
