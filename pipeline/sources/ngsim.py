"""NGSIM: the US DOT's trajectories of two freeways and two arterials, 10 Hz, in feet."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import DUPLICATE, FILE, account_rows, split_duplicates
from tracklake.pipeline.sources.assembly import assemble_subset
from tracklake.pipeline.sources.completeness import Announced, compare_counts
from tracklake.pipeline.sources.csv import LINE, REJECT_SCHEMA, Chunk, map_chunks, read_head
from tracklake.pipeline.sources.derived import IN_FULLER_FILE, split_derived
from tracklake.pipeline.sources.ngsim_dialects import (
    SITES,
    Site,
    build_layout,
    detect,
    find_origin,
    find_site,
    name_recording,
)
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
from tracklake.schemas import references
from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.completeness import PUBLISHED, PUBLISHED_TOTALS, TOTAL_FRAMES
from tracklake.schemas.raw_ngsim import RAW_NGSIM

FRAME_RATE_HZ = 10.0
CLASSES = {1: "motorcycle", 2: "car", 3: "truck"}
DECIMALS = 6
"""Decimals that measurements are rounded to. The originals have three; files rewritten by other programs hold
27.125999999999998 for 27.126, and must give the same tables and be recognised as repetitions."""

CONSTANTS = ("Total_Frames", "v_length", "v_Width", "v_Class")
"""Columns that are equal in all rows of one vehicle, so they distinguish vehicles that share an id."""

KEY = pl.col("Global_Time") - 100 * pl.col("Frame_ID").cast(pl.Int64)
"""Time of frame 0, ms: constant within a recording, which it identifies."""

PARSING_THREADS = 3
"""Chunks of one file parsed at once; more threads cost memory and help little, since the parser is threaded too."""

MAX_RECORDINGS = 200
"""Most recordings a file may hold: if the largest ones do not have half of its rows, times or frames are wrong."""

FILLED_BY = {
    "Lane_ID": ("lane",),
    "v_Acc": ("accel_mps2",),
    "v_length": ("gap_m",),
    "Preceding": ("leader_id", "gap_m"),
    "Following": ("follower_id",),
    "Space_Headway": ("headway_recorded_m",),
}
"""Columns of tracks that are null if a raw column is missing."""


def group(files: Sequence[RawFile]) -> Grouping:
    """Make one unit of each file: only its rows tell which recordings it holds."""
    return Grouping(tuple(Unit((file,)) for file in files))


def spill_file(file: RawFile, folder: Path) -> Spilled:
    """Read a file of any NGSIM dialect chunk by chunk into a folder per recording.

    Global_Time - 100 * Frame_ID is constant within a recording and identifies it. Rows go to
    `<folder>/<recording>/<chunk>.arrow` with the columns of schemas.RAW_NGSIM without Location.
    """
    layout = build_layout(read_head(file), file.dialect, where=file.name)
    absent = [
        pl.lit(None, dtype).alias(name)
        for name, dtype in RAW_NGSIM.dtypes.items()
        if name not in (LINE, *layout.dtypes)
    ]

    def spill_chunk(number: int, chunk: Chunk) -> tuple[Counter[str], pl.DataFrame, int]:
        counts: Counter[str] = Counter()
        raw = RAW_NGSIM.validate(chunk.frame.with_columns(absent).select(*RAW_NGSIM.dtypes), where=file.name)
        for share, (recording, rows) in enumerate(
            _split_recordings(raw.with_columns(pl.col(pl.Float64).round(DECIMALS)))
        ):
            counts[recording] += rows.height
            target = folder / recording
            target.mkdir(parents=True, exist_ok=True)
            # Plain Arrow takes a quarter of the time of compressed Parquet; the files are deleted after the run.
            rows.write_ipc(target / f"{number:06d}-{share:06d}.arrow", compression="uncompressed")
        _require_constant_keys(counts, file)
        return counts, chunk.rejects, chunk.rows_read

    spilled = list(map_chunks(file, layout, spill_chunk, threads=PARSING_THREADS))
    recordings = sum((counts for counts, _, _ in spilled), Counter())
    _require_constant_keys(recordings, file)
    rejects = pl.concat([pl.DataFrame(schema=REJECT_SCHEMA), *(rejects for _, rejects, _ in spilled)])
    return Spilled(dict(recordings), sum(rows_read for _, _, rows_read in spilled), rejects)


def _require_constant_keys(counts: Counter[str], file: RawFile) -> None:
    """Refuse a file in which nearly every row has a key of its own, since its times or frames are wrong.

    A row with a damaged time is a recording of its own; many such rows mean a rounded Global_Time or swapped columns.
    """
    if 2 * sum(rows for _, rows in counts.most_common(MAX_RECORDINGS)) < counts.total():
        raise SourceError(
            f"{file.name}: {len(counts):,} recordings by Global_Time - 100 * Frame_ID in {counts.total():,} rows. "
            f"Expected the same number in all rows of a recording, and no more than {MAX_RECORDINGS} recordings in a "
            "file. Global_Time was rounded or columns are swapped; restore the original file."
        )


def _split_recordings(rows: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield (recording, its rows), again for each spelling of the site.

    Only some dialects have the site, so the column is dropped: rows that differ only in it are repetitions.
    """
    rows = rows.with_columns(key=KEY)
    for part in rows.partition_by("key", "Location"):
        key, location = part.head(1).select("key", pl.col("Location").str.to_lowercase()).row(0)
        yield name_recording(key, location), part.drop("key", "Location")


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the spilled rows of one recording, a part per file that holds some of it, into its tables."""
    shares = [
        part.rows.collect().with_columns(pl.lit(index, pl.Int64).alias(FILE))
        for index, part in enumerate(parts)
        if part.rows is not None
    ]
    raw = pl.concat(shares)
    raw, derived = split_derived(raw, shares, ["Vehicle_ID", "Frame_ID", "Local_X", "Local_Y"])
    rows, duplicates = split_duplicates(raw, ["Vehicle_ID", "Frame_ID"])
    dropped = [(derived, IN_FULLER_FILE), (duplicates, DUPLICATE)]
    log, rejects = account_rows("ngsim", recording, parts, [share.height for share in shares], dropped)
    site_name = find_site(recording)
    one_direction = rows["Direction"].is_null().all()
    site = SITES.get(site_name) or Site(site_name, one_direction, "unknown", None, (), "")
    first_frame, last_frame = rows.select(first=pl.col("Frame_ID").min(), last=pl.col("Frame_ID").max()).row(0)
    recording_facts: dict[str, Any] = {
        "recording": recording,
        "site": site.name,
        "origin": find_origin(rows.select(KEY.unique()).to_series().to_list()),
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
    completeness = compare_counts("ngsim", recording, subsets, announced, log)
    notes = (*_describe_subsets(subsets), *completeness.notes)
    return Canonical(tuple(subsets), log, rejects, completeness.table, notes)


def _to_subset(
    rows: pl.DataFrame, name: str, direction: int | None, facts: dict[str, Any], files: Sequence[RawFile]
) -> Subset:
    missing = {column for raw, filled in FILLED_BY.items() if rows[raw].is_null().all() for column in filled}
    entries = orient_ngsim(rows, direction).select(
        *(*CONSTANTS, "x_m", "y_m", "speed_mps", "accel_mps2"),
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
    vehicle_class = pl.col("v_Class").first(ignore_nulls=True)
    sizes = entries.group_by("vehicle_id").agg(
        source_vehicle_id=pl.col("source_id").first(),
        entries_announced=pl.col("Total_Frames").first(ignore_nulls=True),
        length_m=pl.col("v_length").first(ignore_nulls=True) * FOOT_M,
        width_m=pl.col("v_Width").first(ignore_nulls=True) * FOOT_M,
        **{"class": vehicle_class.replace_strict(CLASSES, default=None, return_dtype=pl.String)},
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


def _describe_subsets(subsets: Sequence[Subset]) -> list[str]:
    """Describe split ids and missing columns, a note each."""
    notes = []
    for subset in subsets:
        facts = subset.facts.row(0, named=True)
        if facts["ids_split"]:
            notes.append(f"{subset.name}: {facts['ids_split']} ids stood for more than one vehicle and were split")
        if facts["columns_missing"]:
            # Samples, and with them splits and tensors, need lanes.
            missing = facts["columns_missing"]
            stages = "; no samples, split or tensors without lane" if "lane" in missing else ""
            notes.append(f"{subset.name}: the files have no {', '.join(missing)}; those columns are null{stages}")
    return notes


NGSIM = Source(
    name="ngsim",
    title="Next Generation Simulation (NGSIM) vehicle trajectories",
    licence="public domain (U.S. Department of Transportation)",
    citation=references.NGSIM.full,
    signature="NGSIM: 18 numbers a line separated by blanks or commas, or a header with Vehicle_ID, Frame_ID, "
    "Global_Time, Local_X, Local_Y, v_Vel",
    version=3,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    spill=spill_file,
)
