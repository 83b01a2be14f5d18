"""NGSIM: the US DOT's trajectories of two freeways and two arterials, 10 Hz, in feet."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.sources.accounting import DUPLICATE, FILE, account, split_duplicates
from pipeline.sources.assemble import assemble_subset
from pipeline.sources.base import Canonical, Grouping, Part, RawFile, Source, Spilled, Subset, Unit
from pipeline.sources.lines import REJECT_SCHEMA, read_chunks
from pipeline.sources.ngsim_dialects import SITES, Site, detect, layout_of, name_recording
from pipeline.sources.raw_files import read_head
from pipeline.transforms.identities import identify_vehicles
from pipeline.transforms.orientation import DIRECTIONS, orient_ngsim
from schemas.columns import FOOT_M
from schemas.raw_ngsim import RAW_NGSIM

FRAME_RATE_HZ = 10.0
CLASSES = {1: "motorcycle", 2: "car", 3: "truck"}
DECIMALS = 6
"""To which measurements are rounded. The originals have three; files that passed through a program's binary numbers say
27.125999999999998 for 27.126, and are to give the same tables and to be recognised as repetitions."""

CONSTANTS = ("Total_Frames", "v_length", "v_Width", "v_Class")
"""The same in all rows of one vehicle, so that they tell apart vehicles that share an id."""

FED_BY = {
    "Lane_ID": ("lane",),
    "v_Acc": ("accel_mps2",),
    "v_length": ("gap_m",),
    "Preceding": ("leader_id", "gap_m"),
    "Following": ("follower_id",),
    "Space_Headway": ("headway_recorded_m",),
}
"""Columns of tracks that are null where a raw column is missing."""


def group(files: Sequence[RawFile]) -> Grouping:
    """One unit per file: what recordings it holds is known only from its rows."""
    return Grouping(tuple(Unit((file,)) for file in files))


def spill(file: RawFile, folder: Path) -> Spilled:
    """Read a file chunk by chunk into a folder per recording.

    Recordings are told apart by Global_Time - 100 * Frame_ID, which is constant in each.

    Args:
        file: any NGSIM dialect.
        folder: receives `<recording>/<chunk>.parquet` with the columns of schemas.RAW_NGSIM.
    """
    layout = layout_of(read_head(file.path), file.dialect, where=file.name)
    counts: Counter[str] = Counter()
    rejects, rows_read = [pl.DataFrame(schema=REJECT_SCHEMA)], 0
    for number, chunk in enumerate(read_chunks(file.path, layout)):
        rows_read += chunk.rows_read
        rejects.append(chunk.rejects)
        absent = [
            pl.lit(None, dtype).alias(name) for name, dtype in RAW_NGSIM.dtypes.items() if name not in chunk.frame
        ]
        raw = RAW_NGSIM.validate(chunk.frame.with_columns(absent).select(*RAW_NGSIM.dtypes), where=file.name)
        raw = raw.with_columns(
            pl.col(pl.Float64).round(DECIMALS),
            pl.col("Location").str.to_lowercase(),
            key=pl.col("Global_Time") - 100 * pl.col("Frame_ID").cast(pl.Int64),
        )
        for share, ((key, location), rows) in enumerate(raw.partition_by("key", "Location", as_dict=True).items()):
            recording, _ = name_recording(int(key), None if location is None else str(location))
            counts[recording] += rows.height
            target = folder / recording
            target.mkdir(parents=True, exist_ok=True)
            rows.drop("key").write_parquet(target / f"{number:06d}-{share:06d}.parquet", compression="lz4")
    return Spilled(dict(counts), rows_read, pl.concat(rejects))


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the spilled rows of one recording into its tables.

    Args:
        parts: the shares of every file that holds the recording.
        recording: its name.
    """
    shares = [
        part.rows.collect().with_columns(pl.lit(index, pl.Int64).alias(FILE))
        for index, part in enumerate(parts)
        if part.rows is not None
    ]
    raw = pl.concat(shares)
    location: str | None = raw.select(pl.col("Location").drop_nulls().first()).item()
    # Not every dialect says where it is from; the recording does, so rows that differ only in that are repetitions.
    raw = raw.drop("Location")
    rows, duplicates = split_duplicates(raw, ["Vehicle_ID", "Frame_ID"])
    log, rejects = account("ngsim", recording, parts, [share.height for share in shares], [(duplicates, DUPLICATE)])
    first = rows.row(0, named=True)
    key = first["Global_Time"] - 100 * first["Frame_ID"]
    _, site_name = name_recording(key, location)
    one_direction = rows["Direction"].is_null().all()
    site = SITES.get(site_name) or Site(site_name, one_direction, "unknown", None, (), "")
    first_frame, last_frame = rows.select(first=pl.col("Frame_ID").min(), last=pl.col("Frame_ID").max()).row(0)
    recording_facts: dict[str, Any] = {
        "recording": recording,
        "site": site.name,
        "freeway": site.freeway,
        "frame_rate_hz": FRAME_RATE_HZ,
        "lanes": site.lanes,
        "seconds": (last_frame - first_frame + 1) / FRAME_RATE_HZ,
        "first_frame": first_frame,
        "on_ramp_lanes": list(site.on_ramp_lanes),
        "lane_markings_m": None,
    }
    files = [part.file for part in parts]
    if site.freeway:
        subsets = [_to_subset(rows, recording, None, {**recording_facts, "direction": site.direction}, files)]
    else:
        known = pl.col("Direction").is_in([float(code) for code in DIRECTIONS])
        by_direction = rows.with_columns(pl.when(known).then("Direction").otherwise(0).cast(pl.Int16))
        subsets = []
        for (code,), entries in sorted(by_direction.partition_by("Direction", as_dict=True).items()):
            direction = DIRECTIONS.get(code, "unknown")
            facts = {**recording_facts, "direction": direction}
            oriented_as = code if code in DIRECTIONS else None
            subsets.append(_to_subset(entries, f"{recording}-{direction}", oriented_as, facts, files))
    return Canonical(tuple(subsets), log, rejects, tuple(_remark(subsets)))


def _to_subset(
    rows: pl.DataFrame, name: str, direction: int | None, facts: dict[str, Any], files: Sequence[RawFile]
) -> Subset:
    missing = {column for raw, fed in FED_BY.items() if rows[raw].is_null().all() for column in fed}
    entries = orient_ngsim(rows, direction).select(
        *CONSTANTS,
        "x_m",
        "y_m",
        "speed_mps",
        "accel_mps2",
        source_id="Vehicle_ID",
        frame="Frame_ID",
        lane="Lane_ID",
        leader_source_id="Preceding",
        follower_source_id="Following",
        headway_recorded_m=pl.col("Space_Headway") * FOOT_M,
    )
    identified = identify_vehicles(entries, constants=CONSTANTS)
    has_leader = pl.col("leader_id").is_not_null() if "leader_id" not in missing else pl.col("headway_recorded_m") != 0
    entries = identified.entries.with_columns(headway_recorded_m=pl.when(has_leader).then(pl.col("headway_recorded_m")))
    sizes = entries.group_by("vehicle_id").agg(
        source_vehicle_id=pl.col("source_id").first(),
        entries_announced=pl.col("Total_Frames").first(),
        length_m=pl.col("v_length").first() * FOOT_M,
        width_m=pl.col("v_Width").first() * FOOT_M,
        **{"class": pl.col("v_Class").first().replace_strict(CLASSES, return_dtype=pl.String)},
    )
    return assemble_subset(
        entries.drop(*CONSTANTS, "source_id", "leader_source_id", "follower_source_id"),
        sizes,
        dataset="ngsim",
        name=name,
        facts={**facts, "ids_split": identified.ids_split, "columns_missing": sorted(missing)},
        use_recorded_headway=True,
        files=files,
    )


def _remark(subsets: Sequence[Subset]) -> list[str]:
    notes = []
    for subset in subsets:
        facts = subset.facts.row(0, named=True)
        if facts["ids_split"]:
            notes.append(f"{subset.name}: {facts['ids_split']} ids stood for more than one vehicle and were split")
        if facts["columns_missing"]:
            notes.append(
                f"{subset.name}: the files have no {', '.join(facts['columns_missing'])}; those columns are null"
            )
    return notes


NGSIM = Source(
    name="ngsim",
    title="Next Generation Simulation (NGSIM) vehicle trajectories",
    licence="public domain (U.S. Department of Transportation)",
    citation="U.S. Department of Transportation Federal Highway Administration (2016). Next Generation Simulation "
    "(NGSIM) Vehicle Trajectories and Supporting Data. doi.org/10.21949/1504477",
    looks_like="NGSIM: 18 numbers a line separated by blanks or commas, or a header with Vehicle_ID, Frame_ID, "
    "Global_Time, Local_X, Local_Y, v_Vel",
    version=1,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    spill=spill,
)
