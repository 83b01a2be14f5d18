"""exiD: drone recordings of exits and entries of German motorways, 25 Hz, three CSV files per recording and a map."""

from collections.abc import Sequence

import numpy as np
import polars as pl

from tracklake.pipeline.sources.lanelet_map import read_lanelet_map
from tracklake.pipeline.sources.levelx import KINDS
from tracklake.pipeline.sources.levelx_plane import (
    EXID_FORMAT,
    build_subset,
    finish_recording,
    fit_to_entries,
    place_entries,
    split_impossible,
    split_motor_vehicles,
    summarise_vehicles,
    trace_longest,
)
from tracklake.pipeline.sources.levelx_recognition import SIGNATURE, describe_columns, detect, group
from tracklake.pipeline.sources.source import Canonical, Part, Source
from tracklake.pipeline.transforms.tracks.axes import Axis, fit_axis, wrap_angle
from tracklake.pipeline.transforms.tracks.carriageways import (
    LaneLayout,
    find_lanes,
    name_direction,
    part_directions,
)
from tracklake.schemas import references
from tracklake.schemas.arrays import Floats

NO_DRIVE = "no vehicle of this direction drives, so that its road has no axis"


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn a recording's three files, and its map where there is one, into its tables, a subset per carriageway."""
    files = [part.file for part in parts]
    read, entries = EXID_FORMAT.read_recording(parts[: len(KINDS)], recording)
    entries, dropped = split_motor_vehicles(entries, read.vehicles)
    sizes, notes = summarise_vehicles(entries, read.vehicles)
    map_points, map_part = None, None
    about_map, is_mapped = f"SOURCE has no location{read.meta['locationId']}.osm", False
    if len(parts) > len(KINDS):
        about_map = f"{files[-1].name} is of no use, as the recording has no lonLocation"
    if len(parts) > len(KINDS) and read.meta["lonLocation"] is not None:
        origin = read.meta["xUtmOrigin"], read.meta["yUtmOrigin"]
        lanelets = read_lanelet_map(files[-1], read.meta["lonLocation"], origin)
        map_points, map_part = lanelets.points, (Part(files[-1]), lanelets.lanelets)
        about_map = f"{files[-1].name} has none of the lanelets that vehicles use"
    subsets = []
    for carriageway in _part_carriageways(_read_lists(entries)):
        axis = trace_longest(carriageway)
        if axis is None:
            dropped.append((carriageway, NO_DRIVE))
            continue
        points = _find_map_points(carriageway, map_points)
        if points is None:
            axis = fit_to_entries(axis, carriageway)
        else:
            is_mapped = True
            axis = fit_axis(axis, *_list_points(points, "x_m", "y_m"), points["angle_rad"].to_numpy())
        placed, impossible = split_impossible(place_entries(carriageway, axis))
        dropped += impossible
        if placed.is_empty():
            continue
        lanes = find_lanes(_place_lane_points(placed) if points is None else _place_map_points(points, axis))
        placed = placed.join(lanes.lanes, on="lanelet", how="left", maintain_order="left")
        direction = name_direction(axis.angle_rad)
        subsets.append(
            build_subset(
                placed.with_columns(
                    leader_id=pl.when(pl.col("leadId") >= 0).then("leadId"),
                    follower_id=pl.when(pl.col("rearId") >= 0).then("rearId"),
                    headway_recorded_m=pl.when(pl.col("leadId") >= 0).then("leadDHW"),
                ),
                sizes,
                read.meta,
                files,
                dataset="exid",
                recording=recording,
                direction=direction,
                facts=_describe_lanes(lanes),
            )
        )
    about_map += ": road axes and lanes are fitted to the tracks"
    if is_mapped:
        about_map = f"road axes and lanes from {files[-1].name}, {lanelets.lanelets} lanelets"
        about_map += f"; {lanelets.skipped} without their bounds are skipped" if lanelets.skipped else ""
    return finish_recording("exid", recording, read, dropped, subsets, (about_map, *notes), map_part)


def _describe_lanes(lanes: LaneLayout) -> dict[str, object]:
    return {
        "freeway": True,
        "lanes": lanes.main,
        "on_ramp_lanes": lanes.others,
        "lane_markings_m": lanes.markings_m,
        "columns_missing": [] if lanes.main else ["lane"],
        "left_m": lanes.left_m,
    }


def _read_lists(entries: pl.DataFrame) -> pl.DataFrame:
    """Read the first values of lists: lanelet, offset_m and width_m; null where there is none."""
    names = {"laneletId": ("lanelet", pl.Int64), "latLaneCenterOffset": ("offset_m", pl.Float64)}
    names |= {"laneWidth": ("lane_width_m", pl.Float64)}
    return entries.with_columns(
        pl.col(name).str.extract(r"^\s*([^;]*)").cast(dtype, strict=False).alias(new)
        for name, (new, dtype) in names.items()
    ).with_columns(lanelet=pl.when(pl.col("lanelet") >= 0).then("lanelet"))


def _part_carriageways(entries: pl.DataFrame) -> list[pl.DataFrame]:
    """Part the entries of the two directions of travel, by the mean heading of each vehicle.

    A lanelet is that of the direction with most of its entries: vehicles of the other one have no lane there.
    """
    angle = pl.col("heading").radians()
    means = entries.group_by("trackId", maintain_order=True).agg(angle=pl.arctan2(angle.sin().sum(), angle.cos().sum()))
    way = pl.Series("way", part_directions(means["angle"].to_numpy()))
    parted = entries.join(means.select("trackId", way), on="trackId", how="left", maintain_order="left")
    is_own = (pl.col("way").mean().over("lanelet") - pl.col("way")).abs() <= 0.5
    parted = parted.with_columns(lanelet=pl.when(is_own).then("lanelet"))
    return [rows.drop("way") for _, rows in sorted(parted.partition_by("way", as_dict=True).items())]


def _find_map_points(carriageway: pl.DataFrame, points: pl.DataFrame | None) -> pl.DataFrame | None:
    """Find the points of the lanelets that the vehicles of a carriageway use; None where the map has none of them."""
    if points is None:
        return None
    used = carriageway.select(pl.col("lanelet").drop_nulls().unique())
    own = points.join(used, on="lanelet", how="semi", maintain_order="left")
    return None if own.is_empty() else own


def _place_map_points(points: pl.DataFrame, axis: Axis) -> pl.DataFrame:
    """Put the points of a map's lanelets on an axis, as `find_lanes` takes them.

    Points beyond the axis's ends, and those of lanelets in the opposite direction, are left out.
    """
    places = axis.project(*_list_points(points, "x_m", "y_m"))
    placed = points.select("lanelet", "width_m", along_m=pl.Series(places.along_m), right_m=pl.Series(places.right_m))
    is_ahead = np.abs(wrap_angle(points["angle_rad"].to_numpy() - places.angle_rad)) < np.pi / 2
    return placed.filter(pl.Series(is_ahead) & pl.col("along_m").is_between(0, axis.length_m))


def _place_lane_points(placed: pl.DataFrame) -> pl.DataFrame:
    """Find points of lanelets' middles, as `find_lanes` takes them, by the vehicles' distances from them.

    The side to which the distances count is the one that makes the lanes narrower.
    """
    points = placed.drop_nulls(["lanelet", "offset_m"]).select(
        *("lanelet", "along_m"),
        width_m="lane_width_m",
        left=pl.col("right_m") + pl.col("offset_m"),
        right=pl.col("right_m") - pl.col("offset_m"),
    )
    spread = points.group_by("lanelet").agg(pl.col("left", "right").std().fill_null(0.0)).sum()
    side = "left" if spread["left"].item() <= spread["right"].item() else "right"
    return points.select("lanelet", "along_m", "width_m", right_m=side)


def _list_points(frame: pl.DataFrame, x: str, y: str) -> tuple[Floats, Floats]:
    return frame[x].to_numpy(), frame[y].to_numpy()


EXID = Source(
    name="exid",
    title="exiD: trajectories at entries and exits of German highways",
    licence="non-commercial, on request from levelXdata (exid-dataset.com)",
    citation=references.MOERS.full,
    signature=SIGNATURE,
    version=1,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    describe_columns=describe_columns,
)
