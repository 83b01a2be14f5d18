"""NGSIM: the US DOT's trajectories of two freeways and two arterials, 10 Hz, in feet."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import DUPLICATE, FILE, account, split_duplicates
from tracklake.pipeline.sources.assemble import assemble_subset
from tracklake.pipeline.sources.completeness import Announced, compare
from tracklake.pipeline.sources.csv.lines import REJECT_SCHEMA, Chunk, map_chunks
from tracklake.pipeline.sources.csv.raw_files import LINE, read_head
from tracklake.pipeline.sources.derived import IN_FULLER_FILE, split_derived
from tracklake.pipeline.sources.ngsim_dialects import SITES, Site, detect, layout_of, name_recording, site_of
from tracklake.pipeline.sources.source import (
    Canonical,
    Grouping,
    Part,
    RawFile,
    Source,
    SourceError,
    Spilled,
    Subset,
    Unit,
)
from tracklake.pipeline.transforms.tracks.identities import identify_vehicles
from tracklake.pipeline.transforms.tracks.orientation import DIRECTIONS, orient_ngsim
from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.completeness import PUBLISHED, PUBLISHED_TOTALS, TOTAL_FRAMES
from tracklake.schemas.raw_ngsim import RAW_NGSIM

FRAME_RATE_HZ = 10.0
CLASSES = {1: "motorcycle", 2: "car", 3: "truck"}
DECIMALS = 6
"""To which measurements are rounded. The originals have three; files that passed through a program's binary numbers say
27.125999999999998 for 27.126, and are to give the same tables and to be recognised as repetitions."""

CONSTANTS = ("Total_Frames", "v_length", "v_Width", "v_Class")
"""The same in all rows of one vehicle, so that they tell apart vehicles that share an id."""

PARSING_THREADS = 3
"""Chunks of one file worked on at once: more help little, as the parser has threads of its own, and cost memory."""

MOST_RECORDINGS = 200
"""If these do not hold half of a file's rows, Global_Time and Frame_ID tell no recordings apart. (Known are nine.)"""

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
        folder: receives `<recording>/<chunk>.arrow` with the columns of schemas.RAW_NGSIM, less Location.
    """
    layout = layout_of(read_head(file), file.dialect, where=file.name)
    absent = [
        pl.lit(None, dtype).alias(name)
        for name, dtype in RAW_NGSIM.dtypes.items()
        if name not in (LINE, *layout.dtypes)
    ]

    def spill_chunk(number: int, chunk: Chunk) -> tuple[Counter[str], pl.DataFrame, int]:
        counts: Counter[str] = Counter()
        raw = RAW_NGSIM.validate(chunk.frame.with_columns(absent).select(*RAW_NGSIM.dtypes), where=file.name)
        for share, (recording, rows) in enumerate(
            _part_recordings(raw.with_columns(pl.col(pl.Float64).round(DECIMALS)))
        ):
            counts[recording] += rows.height
            target = folder / recording
            target.mkdir(parents=True, exist_ok=True)
            # Plain Arrow costs a quarter of the time of compressed Parquet, and lives no longer than the run.
            rows.write_ipc(target / f"{number:06d}-{share:06d}.arrow", compression="uncompressed")
        _require_constant_keys(counts, file)
        return counts, chunk.rejects, chunk.rows_read

    spilled = list(map_chunks(file, layout, spill_chunk, threads=PARSING_THREADS))
    recordings = sum((counts for counts, _, _ in spilled), Counter())
    _require_constant_keys(recordings, file)
    rejects = pl.concat([pl.DataFrame(schema=REJECT_SCHEMA), *(rejects for _, rejects, _ in spilled)])
    return Spilled(dict(recordings), sum(rows_read for _, _, rows_read in spilled), rejects)


def _require_constant_keys(counts: Counter[str], file: RawFile) -> None:
    """Refuse a file in which nearly every row has a key of its own, for its times or frames are not what they say.

    Single rows with a damaged time make recordings of their own; that many rows of a file have one is what a rounded
    Global_Time or swapped columns do.
    """
    if 2 * sum(rows for _, rows in counts.most_common(MOST_RECORDINGS)) < counts.total():
        raise SourceError(
            f"{file.name}: {len(counts):,} recordings by Global_Time - 100 * Frame_ID in {counts.total():,} rows. "
            f"Expected the same number in all rows of a recording, and no more than {MOST_RECORDINGS} recordings in a "
            "file. Global_Time was rounded or columns are swapped; restore the original file."
        )


def _part_recordings(rows: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """(recording, its rows); once more for another spelling of the site.

    Not every dialect says the site; the recording's name does, so that rows which differ only in that are repetitions.
    """
    rows = rows.with_columns(key=pl.col("Global_Time") - 100 * pl.col("Frame_ID").cast(pl.Int64))
    for part in rows.partition_by("key", "Location"):
        key, location = part.head(1).select("key", pl.col("Location").str.to_lowercase()).row(0)
        yield name_recording(key, location), part.drop("key", "Location")


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
    raw, derived = split_derived(raw, shares, ["Vehicle_ID", "Frame_ID", "Local_X", "Local_Y"])
    rows, duplicates = split_duplicates(raw, ["Vehicle_ID", "Frame_ID"])
    dropped = [(derived, IN_FULLER_FILE), (duplicates, DUPLICATE)]
    log, rejects = account("ngsim", recording, parts, [share.height for share in shares], dropped)
    site_name = site_of(recording)
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
    totals = PUBLISHED_TOTALS.get(recording, {})
    announced = Announced(totals, totals_by=PUBLISHED, vehicles=None, vehicles_by=TOTAL_FRAMES)
    whole = compare("ngsim", recording, subsets, announced, log)
    return Canonical(tuple(subsets), log, rejects, whole.table, (*_remark(subsets), *whole.notes))


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
    identified = identify_vehicles(
        entries,
        constants=CONSTANTS,
        frame_rate_hz=FRAME_RATE_HZ,
        announced="Total_Frames",
        one_way=facts["freeway"],
    )
    has_leader = pl.col("leader_id").is_not_null() if "leader_id" not in missing else pl.col("headway_recorded_m") != 0
    entries = identified.entries.with_columns(headway_recorded_m=pl.when(has_leader).then(pl.col("headway_recorded_m")))
    sizes = entries.group_by("vehicle_id").agg(
        source_vehicle_id=pl.col("source_id").first(),
        entries_announced=pl.col("Total_Frames").first(ignore_nulls=True),
        length_m=pl.col("v_length").first(ignore_nulls=True) * FOOT_M,
        width_m=pl.col("v_Width").first(ignore_nulls=True) * FOOT_M,
        **{"class": pl.col("v_Class").first(ignore_nulls=True).replace_strict(CLASSES, return_dtype=pl.String)},
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
            # Lanes are what samples, and with them splits and tensors, cannot be made without.
            missing = facts["columns_missing"]
            stages = "; no samples, split or tensors without lane" if "lane" in missing else ""
            notes.append(f"{subset.name}: the files have no {', '.join(missing)}; those columns are null{stages}")
    return notes


NGSIM = Source(
    name="ngsim",
    title="Next Generation Simulation (NGSIM) vehicle trajectories",
    licence="public domain (U.S. Department of Transportation)",
    citation="U.S. Department of Transportation Federal Highway Administration (2016). Next Generation Simulation "
    "(NGSIM) Vehicle Trajectories and Supporting Data. doi.org/10.21949/1504477",
    looks_like="NGSIM: 18 numbers a line separated by blanks or commas, or a header with Vehicle_ID, Frame_ID, "
    "Global_Time, Local_X, Local_Y, v_Vel",
    version=2,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    spill=spill,
)
