"""NGSIM: the US DOT's trajectories of two freeways and two arterials, 10 Hz, in feet."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import DUPLICATE, FILE, account_rows, find_row_order, split_duplicates
from tracklake.pipeline.sources.assembly import assemble_subset
from tracklake.pipeline.sources.column_mapping import NGSIM_RATE_HZ, ColumnMapping, suggest_mapping
from tracklake.pipeline.sources.completeness import Announced, compare_counts
from tracklake.pipeline.sources.csv import DIGITS_LOST, REJECT_SCHEMA, Chunk, map_chunks, read_chunks, read_head
from tracklake.pipeline.sources.derived import IN_FULLER_FILE, split_derived
from tracklake.pipeline.sources.ngsim_dialects import SITES, Site, find_origin, find_site, name_file, name_recording
from tracklake.pipeline.sources.ngsim_heading import CSV_BARE, MAPPED, TEXT, Heading, detect, read_heading, refine
from tracklake.pipeline.sources.ngsim_plausibility import (
    Verdict,
    counts_from_start,
    find_contradictions,
    find_order,
    judge,
    measure,
)
from tracklake.pipeline.sources.source import (
    Canonical,
    ColumnsOfFile,
    Grouping,
    Part,
    RawFile,
    Source,
    SourceError,
    Spilled,
    Subset,
    Unit,
)
from tracklake.pipeline.sources.spill import spill_rows
from tracklake.pipeline.transforms.tracks.identities import identify_vehicles
from tracklake.pipeline.transforms.tracks.orientation import DIRECTIONS, orient_ngsim
from tracklake.schemas import references
from tracklake.schemas.columns import FOOT_M, Dataset
from tracklake.schemas.completeness import PUBLISHED, PUBLISHED_TOTALS, TOTAL_FRAMES
from tracklake.schemas.raw_ngsim import RAW_NGSIM
from tracklake.schemas.subsets import LANE_CENTRES

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
SAMPLE_BYTES = 1 << 20
"""Size of the first part of a file that is judged before the file is read, in bytes."""
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
MIN_CENTRED_ENTRIES = 100
"""Fewest entries of a subset, 10 s of one vehicle, that can show that lateral positions are lane centres."""


def group(files: Sequence[RawFile]) -> Grouping:
    """Make one unit of each file: only its rows tell which recordings it holds."""
    return Grouping(tuple(Unit((file,)) for file in files))


def spill_file(file: RawFile, folder: Path) -> Spilled:
    """Read a file of any NGSIM dialect chunk by chunk into a folder per recording.

    Global_Time - 100 * Frame_ID is constant within a recording and identifies it; a file without usable times is one
    recording. Rows go to `<folder>/<recording>/<chunk>.arrow` with the columns of schemas.RAW_NGSIM without Location.

    Raises:
        SourceError: the columns are not what they are called, or times tell no recordings apart.
    """
    mapping = read_mapping(file)
    found = read_heading(read_head(file), file.name, mapping)
    if found is None:
        raise SourceError(f"{file.name}: no longer the file that was recognised. Run again.")
    heading, verdict = _inspect(file, found, mapping)
    own_name = None if _tells_recordings(heading, mapping) else name_file(file, mapping.site if mapping else None)

    def spill_chunk(number: int, chunk: Chunk) -> tuple[Counter[str], pl.DataFrame, int]:
        raw = RAW_NGSIM.validate(_to_raw(chunk.frame, heading), where=file.name)
        parts = _split_recordings(raw) if own_name is None else [(own_name, raw.drop("Location"))]
        counts = spill_rows(folder, number, parts)
        _require_constant_keys(counts, file)
        return counts, chunk.rejects, chunk.rows_read

    spilled = list(map_chunks(file, heading.to_layout(), spill_chunk, threads=PARSING_THREADS))
    recordings = sum((counts for counts, _, _ in spilled), Counter())
    _require_constant_keys(recordings, file)
    rejects = pl.concat([pl.DataFrame(schema=REJECT_SCHEMA), *(rejects for _, rejects, _ in spilled)])
    rows_read = sum(rows_read for _, _, rows_read in spilled)
    return Spilled(dict(recordings), rows_read, rejects, tuple(f"{file.name}: {note}" for note in verdict.notes))


def read_mapping(file: RawFile) -> ColumnMapping | None:
    """Return the user's description of a file's columns, if there is one."""
    return ColumnMapping.model_validate_json(file.columns) if file.columns else None


def describe_columns(file: RawFile) -> ColumnsOfFile | None:
    """Return the columns of a file, with the units that are not NGSIM's."""
    heading = read_heading(read_head(file), file.name, read_mapping(file))
    return None if heading is None else ColumnsOfFile(heading.to_layout(), RAW_NGSIM, heading.units)


def _tells_recordings(heading: Heading, mapping: ColumnMapping | None) -> bool:
    """Return whether the times of a file tell its recordings apart."""
    return "Global_Time" in heading.names and (mapping is None or mapping.dataset == "ngsim")


def _inspect(file: RawFile, heading: Heading, mapping: ColumnMapping | None) -> tuple[Heading, Verdict]:
    """Judge the first rows of a file before any is written; returns how to read it."""
    tells = _tells_recordings(heading, mapping)
    layout = heading.to_layout()
    layout = replace(layout, required=layout.required - {"Global_Time"})
    chunk = next(read_chunks(file, layout, chunk_bytes=SAMPLE_BYTES), None)
    if chunk is None or not chunk.rows_read:
        return heading, Verdict()
    sample = _to_raw(chunk.frame, heading)
    if heading.dialect in (CSV_BARE, TEXT) and 2 * sample.height < chunk.rows_read:
        reason, rows = chunk.rejects["reason"].value_counts(sort=True).row(0)
        if not reason.startswith(DIGITS_LOST):
            problem = f"{rows:,} of the first {chunk.rows_read:,} rows: {reason}"
            raise SourceError(_explain_problems(file, heading, Verdict(problems=[problem]), sample))
    if sample.is_empty():
        return heading, Verdict()
    timed = sample.filter(pl.col("Global_Time").is_not_null())
    use_time = 2 * timed.height >= sample.height
    verdict = judge(measure(timed if use_time else sample, mapping.rate_hz if mapping else NGSIM_RATE_HZ))
    if not use_time:
        verdict.use_time = False
        verdict.notes.insert(0, "Global_Time is missing, so the frames tell one recording")
    elif tells and counts_from_start(timed):
        verdict.use_time = False
        verdict.notes.insert(0, "Global_Time counts from the recording's start, so the frames tell one recording")
    elif heading.units.get("Global_Time") == "s":
        verdict.notes.insert(0, "Global_Time is in seconds, and is read as such")
    elif not tells and mapping is None:
        verdict.notes.insert(0, "no times tell its recordings apart, so it is read as one")
    if heading.dialect in (CSV_BARE, TEXT) and verdict.use_time:
        verdict.problems += find_contradictions(sample)
    if mapping is not None and verdict.units:
        verdict.problems += verdict.notes  # the user has said what the units are
    if verdict.problems:
        raise SourceError(_explain_problems(file, heading, verdict, sample))
    return refine(heading, verdict.units, use_time=verdict.use_time), verdict


def _explain_problems(file: RawFile, heading: Heading, verdict: Verdict, sample: pl.DataFrame) -> str:
    start = (
        f"{file.name}: its columns are not what they are called: {'; '.join(verdict.problems)}. Expected NGSIM's "
        "columns in feet, ft/s and ms"
    )
    if heading.dialect == MAPPED:
        return f"{start}, or what the mapping says. Correct the mapping."
    if heading.dialect not in (CSV_BARE, TEXT):
        return (
            f"{start}, or units behind the names, as in `Local_X(m)`. Correct the header, or "
            "name the columns with `--columns` (docs/data.md)."
        )
    order = find_order(sample)
    numbers = {name: number for number, name in enumerate(heading.names, start=1) if name in RAW_NGSIM.columns}
    guesses = {name: numbers[order.get(name, name)] for name in numbers} if order else {}
    fitting = "The order below fits; check it" if order else "No order is known that fits; replace each `?`"
    return (
        f"{start}, in the order of the original files, since it has no header. {fitting}, write it to columns.toml, "
        f"and run again with `--columns columns.toml` (docs/data.md).\n\n{suggest_mapping(guesses)}"
    )


def _to_raw(frame: pl.DataFrame, heading: Heading) -> pl.DataFrame:
    """Turn parsed rows into the columns of schemas.RAW_NGSIM: NGSIM's units, and null for missing columns."""
    factors = heading.factors
    converted = [
        (pl.col(name) * factor).round(0 if name == "Global_Time" else DECIMALS).cast(RAW_NGSIM.dtypes[name])
        for name, factor in factors.items()
    ]
    absent = [pl.lit(None, dtype).alias(name) for name, dtype in RAW_NGSIM.dtypes.items() if name not in frame.columns]
    rows = frame.with_columns(*converted, *absent)
    if "Global_Time" not in heading.names:
        rows = rows.with_columns(Global_Time=100 * pl.col("Frame_ID").cast(pl.Int64))
    return rows.select(*RAW_NGSIM.dtypes).with_columns(pl.col(pl.Float64).round(DECIMALS))


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


def to_canonical(parts: Sequence[Part], recording: str, dataset: Dataset = "ngsim") -> Canonical:
    """Turn the spilled rows of one recording, a part per file that holds some of it, into its tables."""
    mapping = read_mapping(parts[0].file)
    rate_hz = mapping.rate_hz if mapping else NGSIM_RATE_HZ
    shares = [
        part.rows.collect().with_columns(pl.lit(index, pl.Int64).alias(FILE))
        for index, part in enumerate(parts)
        if part.rows is not None
    ]
    raw = pl.concat(shares)
    raw, derived = split_derived(raw, shares, ["Vehicle_ID", "Frame_ID", "Local_X", "Local_Y"])
    row_order = find_row_order(raw, "Vehicle_ID", "Frame_ID")
    rows, duplicates = split_duplicates(raw, ["Vehicle_ID", "Frame_ID"])
    dropped = [(derived, IN_FULLER_FILE), (duplicates, DUPLICATE)]
    log, rejects = account_rows(dataset, recording, parts, [share.height for share in shares], dropped)
    site_name = find_site(recording) if dataset == "ngsim" or mapping is None else mapping.site or recording
    one_direction = rows["Direction"].is_null().all()
    site = SITES.get(site_name) or Site(site_name, one_direction, "unknown", mapping.lanes if mapping else None, (), "")
    first_frame, last_frame = rows.select(first=pl.col("Frame_ID").min(), last=pl.col("Frame_ID").max()).row(0)
    recording_facts: dict[str, Any] = {
        "dataset": dataset,
        "recording": recording,
        "site": site.name,
        "origin": find_origin(rows.select(KEY.unique()).to_series().to_list()),
        "freeway": site.freeway,
        "frame_rate_hz": rate_hz,
        "lanes": site.lanes,
        "seconds": (last_frame - first_frame + 1) / rate_hz,
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
    completeness, missing = compare_counts(dataset, recording, subsets, announced, log)
    notes = (*_describe_subsets(subsets), *missing)
    return Canonical(tuple(subsets), log, rejects, completeness, notes, row_order)


def _to_subset(
    rows: pl.DataFrame, name: str, direction: int | None, facts: dict[str, Any], files: Sequence[RawFile]
) -> Subset:
    missing = {column for raw, filled in FILLED_BY.items() if rows[raw].is_null().all() for column in filled}
    if _has_lane_centres(rows):
        missing |= {*LANE_CENTRES}
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
        frame_rate_hz=facts["frame_rate_hz"],
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
        dataset=facts["dataset"],
        name=name,
        facts={**facts, "ids_split": identified.ids_split, "columns_missing": sorted(missing)},
        use_recorded_headway=True,
        files=files,
    )


def _has_lane_centres(rows: pl.DataFrame) -> bool:
    """Return whether each lane has one lateral position, although vehicles change lanes."""
    if rows.height < MIN_CENTRED_ENTRIES:
        return False
    lanes = rows.group_by("Lane_ID").agg(least=pl.col("Local_X").min(), most=pl.col("Local_X").max())
    if lanes.height < 2 or not lanes.select((pl.col("least") == pl.col("most")).all(ignore_nulls=False)).item():
        return False
    return bool(rows.group_by("Vehicle_ID").agg(changes=pl.col("Lane_ID").n_unique() > 1)["changes"].any())


def _describe_subsets(subsets: Sequence[Subset]) -> list[str]:
    """Describe split ids and missing columns, a note each."""
    notes = []
    for subset in subsets:
        facts = subset.facts.row(0, named=True)
        if facts["ids_split"]:
            notes.append(f"{subset.name}: {facts['ids_split']} ids stood for more than one vehicle and were split")
        if "y_m" in facts["columns_missing"]:
            notes.append(
                f"{subset.name}: lateral positions are lane centres (as where {references.COIFMAN.name} tracked I-80 "
                "again): no rules on them, and no scores across the road"
            )
        missing = [name for name in facts["columns_missing"] if name not in LANE_CENTRES]
        if missing:
            # Samples, and with them splits and tensors, need lanes.
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
    version=4,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    spill=spill_file,
    describe_columns=describe_columns,
)
