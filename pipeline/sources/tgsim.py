"""TGSIM: the US DOT's trajectories among automated vehicles on four freeways, 10 Hz, in metres of a reference image."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.sources.accounting import (
    CONFLICT,
    DUPLICATE,
    FILE,
    account_rows,
    find_row_order,
    split_duplicates,
)
from tracklake.pipeline.sources.assembly import assemble_subset
from tracklake.pipeline.sources.csv import LINE, REJECT_SCHEMA, Chunk, map_chunks, read_head
from tracklake.pipeline.sources.levelx import split_conflicts
from tracklake.pipeline.sources.ngsim_dialects import name_file
from tracklake.pipeline.sources.source import Canonical, Part, RawFile, Source, Spilled, Subset
from tracklake.pipeline.sources.spill import spill_rows
from tracklake.pipeline.sources.tgsim_files import (
    CENTRELINES,
    build_layout,
    describe_columns,
    detect,
    find_run,
    find_site,
    group,
    read_centrelines,
)
from tracklake.pipeline.transforms.tracks.lane_axis import Vector, find_direction, fit_lane_axis
from tracklake.schemas import COMPLETENESS, references
from tracklake.schemas.raw_tgsim import RAW_TGSIM, RAW_TGSIM_CENTRELINES

RATE_HZ = 10.0
"""Frames per second of all sites."""
OFF_GRID_FRAMES = 0.1
"""Farthest that a row's time may lie from a tenth of a second, in frames."""
OFF_GRID = "time is not a whole number of tenths of a second after the others"
LANE_M = 3.6576
"""Width of a lane, 12 ft, in m; the left edge lies half of it to the left of the leftmost lane's middle."""
MAIN_LANE_SHARE = 0.01
"""Least share of a carriageway's entries in a main lane."""
ON_RAMP, OFF_RAMP = 1.0, 2.0
"""Codes of lane centrelines for ramps."""
CLASSES = {
    "small": "car",
    "large": "truck",
    "1": "car",
    "2": "truck",
    "3": "truck",
    "4": "car",
    "motorcycle": "motorcycle",
}
"""Classes by the first word of type_most_common; of I-395's codes, 3 is a bus and 4 an automated vehicle."""
AUTOMATED_TYPE = "4"
SYNTHETIC_S = (42_424.0, 46_024.0)
"""Times of generated files: those of a recorded run begin near 0."""
PARSING_THREADS = 3
"""Chunks of one file parsed at once."""
FILLED_BY = {"lane": "lane", "acceleration_kf": "accel_mps2", "length_m": "gap_m"}
"""Columns of tracks that are null where a column of the entries is."""
UNKNOWN = "unknown"
"""Site of files whose names tell none."""
MOVED_M = 20.0
"""Distance that tells in which direction a vehicle travels, in m, or half of the greatest one where that is less."""


def spill_file(file: RawFile, folder: Path) -> Spilled:
    """Read a trajectory file chunk by chunk into a folder for each of its runs."""
    base = file.recording or find_site(file) or name_file(file)
    layout = build_layout(read_head(file))
    absent = [pl.lit(None, dtype).alias(name) for name, dtype in RAW_TGSIM.dtypes.items() if name not in layout.dtypes]

    def spill_chunk(number: int, chunk: Chunk) -> tuple[Counter[str], pl.DataFrame, int]:
        rows = chunk.frame.with_columns(column for column in absent if column.meta.output_name() != LINE)
        raw = RAW_TGSIM.validate(rows.select(*RAW_TGSIM.dtypes), where=file.name)
        runs = raw.partition_by("run_index", as_dict=True)
        shares = ((base if run is None else f"{base}-run-{run}", rows) for (run,), rows in runs.items())
        return spill_rows(folder, number, shares), chunk.rejects, chunk.rows_read

    spilled = list(map_chunks(file, layout, spill_chunk, threads=PARSING_THREADS))
    recordings = sum((counts for counts, _, _ in spilled), Counter())
    rejects = pl.concat([pl.DataFrame(schema=REJECT_SCHEMA), *(rejects for _, rejects, _ in spilled)])
    return Spilled(dict(recordings), sum(rows_read for _, _, rows_read in spilled), rejects)


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the spilled rows of one run, a part per file that holds some of it, into its tables."""
    logged = [part for part in parts if part.rows is not None]
    shares = [
        part.rows.collect().with_columns(pl.lit(index, pl.Int64).alias(FILE))
        for index, part in enumerate(logged)
        if part.rows is not None
    ]
    rows = pl.concat(shares)
    entries, off_grid = _split_off_grid(rows)
    row_order = find_row_order(entries, "id", "frame")
    key = ["id", "frame"]
    entries, duplicates = split_duplicates(entries, key)
    entries, conflicts = split_conflicts(entries, key)
    run = rows["run_index"][0]
    centrelines, described = _read_centrelines([part.file for part in parts if part.rows is None], run)
    dropped = [(off_grid, OFF_GRID), (duplicates, DUPLICATE), (conflicts, CONFLICT)]
    counts = [*(share.height for share in shares), *(lines.frame.height for _, lines in described)]
    logged += [Part(file, rejects=lines.rejects) for file, lines in described]
    log, rejects = account_rows("tgsim", recording, logged, counts, dropped)
    notes = [f"{recording}: the road's axis follows the lane centrelines of {file.name}" for file, _ in described]
    facts: dict[str, Any] = {
        "recording": recording,
        "site": find_site(parts[0].file) or UNKNOWN,
        "origin": "synthetic" if entries.select(pl.col("time").is_between(*SYNTHETIC_S).all()).item() else "recorded",
        "freeway": True,
        "frame_rate_hz": RATE_HZ,
        "first_frame": entries["frame"].min(),
        "seconds": entries.select((pl.col("frame").max() - pl.col("frame").min() + 1) / RATE_HZ).item(),
        "lane_markings_m": None,
        "ids_split": 0,
    }
    files = [part.file for part in logged]
    subsets = []
    for direction, vector, own in _split_directions(entries):
        subset, said = _to_subset(own, centrelines, vector, {**facts, "direction": direction}, files)
        subsets.append(subset)
        notes += said
    return Canonical(tuple(subsets), log, rejects, COMPLETENESS.empty(), tuple(notes), row_order)


def _split_off_grid(rows: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Number the frames of rows, tenths of a second, and split off rows between two frames.

    Most rows' times lie on the grid, which may begin at any fraction of a tenth.
    """
    tenths = pl.col("time") * RATE_HZ
    shift = rows.select((tenths.round(2) % 1).round(1).mode().min()).item()
    frame = (tenths - shift).round()
    rows = rows.with_columns(frame.cast(pl.Int32).alias("frame"))
    on_grid = (tenths - shift - frame).abs() <= OFF_GRID_FRAMES
    return rows.filter(on_grid), rows.filter(~on_grid)


def _read_centrelines(files: Sequence[RawFile], run: int | None) -> tuple[pl.DataFrame, list[tuple[RawFile, Chunk]]]:
    """Read the lane centrelines of a run (of all runs where the file's name tells none), and count their lines."""
    read = [(file, *read_centrelines(file)) for file in files if find_run(file) in (None, run)]
    points = pl.concat([RAW_TGSIM_CENTRELINES.empty(), *(points for _, points, _ in read)])
    return points, [(file, lines) for file, _, lines in read]


def _split_directions(entries: pl.DataFrame) -> list[tuple[str, Vector, pl.DataFrame]]:
    """Split entries by the vehicles' direction of travel: its name in the image, and a vector, roughly.

    Vehicles that hardly move belong to the direction in which most entries of their lanes travel.
    """
    ways = entries.group_by("id", maintain_order=True).agg(
        dx=pl.col("xloc_kf").last() - pl.col("xloc_kf").first(), dy=pl.col("yloc_kf").last() - pl.col("yloc_kf").first()
    )
    x, y = find_direction(ways["dx"].to_numpy(), ways["dy"].to_numpy())
    ahead = pl.col("dx") * x + pl.col("dy") * y
    moves = (ahead.abs() >= pl.min_horizontal(MOVED_M, ahead.abs().max() / 2)) & (ahead != 0)
    ways = ways.select("id", side=pl.when(moves).then(ahead.sign().cast(pl.Int8)))
    sides = entries.join(ways, on="id", how="left", maintain_order="left")
    sides = sides.with_columns(lanes=pl.col("side").sum().over("lane_kf").sign())
    of_lanes, most = pl.col("lanes").sum().over("id").sign(), pl.col("side").drop_nulls().mode().min()
    side = pl.coalesce("side", pl.when(of_lanes != 0).then(of_lanes), most, 1)
    sides = sides.with_columns(side=side).drop("lanes")
    found = []
    for sign in (1, -1):
        vector = (sign * x, sign * y)
        name = ("right" if vector[0] > 0 else "left") if abs(x) >= abs(y) else "down" if vector[1] > 0 else "up"
        own = sides.filter(pl.col("side") == sign).drop("side")
        if not own.is_empty():
            found.append((f"{name}ward", vector, own))
    return found


def _to_subset(
    entries: pl.DataFrame, centrelines: pl.DataFrame, vector: Vector, facts: dict[str, Any], files: Sequence[RawFile]
) -> tuple[Subset, list[str]]:
    """Build the tables of one direction of travel, and what there is to say about it."""
    name = f"{facts['recording']}-{facts['direction']}"
    sizes = entries.group_by(vehicle_id="id", maintain_order=True).agg(
        source_vehicle_id=pl.col("id").first(),
        length_m=pl.col("length_smoothed").median(),
        width_m=pl.col("width_smoothed").median(),
        length_range_m=_find_range("length_smoothed"),
        width_range_m=_find_range("width_smoothed"),
        automated=_find_automated(),
        entries_announced=pl.lit(None, pl.Int32),
        **{"class": _find_class()},
    )
    lane = pl.when(pl.col("lane_kf") != 0).then(pl.col("lane_kf"))
    entries = entries.with_columns(vehicle_id="id", x="xloc_kf", y="yloc_kf", lane=lane)
    own_lines = centrelines.filter(pl.col("lane").is_in(entries["lane"].unique().to_list()))
    axis = fit_lane_axis(_raise(entries if own_lines.is_empty() else own_lines), (vector[0], -vector[1]))
    places = axis.project(entries["x"].to_numpy(), -entries["y"].to_numpy())
    entries = entries.join(sizes.select("vehicle_id", "length_m"), on="vehicle_id", how="left", maintain_order="left")
    entries = entries.with_columns(
        pl.Series("across", places.right_m),
        front=pl.lit(pl.Series(places.along_m)) + pl.col("length_m").fill_null(0) / 2,
    )
    lanes = _number_lanes(entries, own_lines)
    notes = _describe_lanes(name, lanes)
    sign = -1 if entries.select(pl.col("speed_kf").median() < 0).item() else 1
    if sign < 0:
        notes.append(f"{name}: most speeds are negative, so the signs of speeds and accelerations are turned")
    leftmost = lanes.filter(lane=1)["across"]
    left_m = leftmost.item() - LANE_M / 2 if leftmost.len() else entries["across"].min()
    entries = entries.join(lanes.select(lane="source", number="lane"), on="lane", how="left", maintain_order="left")
    missing = [made for raw, made in FILLED_BY.items() if entries[raw].is_null().all()]
    tracks = entries.select(
        "vehicle_id",
        "frame",
        x_m=(pl.col("front") - pl.col("front").min()).round(3),
        y_m=(pl.col("across") - left_m).round(3),
        lane="number",
        speed_mps=sign * pl.col("speed_kf"),
        accel_mps2=sign * pl.col("acceleration_kf"),
    )
    main = lanes.filter(pl.col("is_main"))
    own_facts = {
        **facts,
        "lanes": main.height or None,
        "on_ramp_lanes": lanes.filter(pl.col("ramp") == ON_RAMP)["lane"].drop_nulls().to_list(),
        "columns_missing": sorted({*missing, "headway_recorded_m"}),
    }
    made = assemble_subset(
        tracks, sizes, dataset="tgsim", name=name, facts=own_facts, use_recorded_headway=False, files=files
    )
    return made, notes


def _raise(points: pl.DataFrame) -> pl.DataFrame:
    """Turn the plane of an image over, whose y points down."""
    return points.with_columns(y=-pl.col("y"))


def _number_lanes(entries: pl.DataFrame, centrelines: pl.DataFrame) -> pl.DataFrame:
    """Number the lanes from the leftmost main one by their vehicles' places across the road, by which they are sorted.

    Returns source (the file's number), lane (null of others left of a main lane), across (the median), ramp (the
    commonest code of its centreline; null where there is none), is_main.
    """
    is_left_of_main = pl.col("is_main").reverse().cum_sum().reverse() > 0
    has_number = pl.col("is_main") | ~is_left_of_main
    codes = centrelines.group_by(source="lane").agg(ramp=pl.col("ramp").drop_nulls().mode().min())
    return (
        entries.drop_nulls("lane")
        .group_by(source="lane")
        .agg(pl.col("across").median(), share=pl.len() / entries.height)
        .sort("across", "source")
        .join(codes, on="source", how="left", maintain_order="left")
        .with_columns(
            is_main=(pl.col("share") >= MAIN_LANE_SHARE)
            & ~pl.col("ramp").is_in([ON_RAMP, OFF_RAMP]).fill_null(value=False),
        )
        .with_columns(lane=pl.when(has_number).then(has_number.cum_sum().cast(pl.Int16)))
    )


def _describe_lanes(name: str, lanes: pl.DataFrame) -> list[str]:
    """Say which lanes of the file got other numbers, and which got none."""
    notes, numbered = [], lanes.drop_nulls("lane")
    if numbered["source"].to_list() != numbered["lane"].to_list():
        sources = ", ".join(map(str, numbered["source"]))
        notes.append(f"{name}: lanes {sources} of the file are numbered 1, 2, ... from the left")
    return notes + [
        f"{name}: lane {source} of the file, left of a main lane, is no main lane itself and gets no number"
        for source in lanes.filter(pl.col("lane").is_null())["source"]
    ]


def _find_range(column: str) -> pl.Expr:
    """Return the greatest less the least value of a column, to 1 mm."""
    return (pl.col(column).max() - pl.col(column).min()).round(3)


def _find_class() -> pl.Expr:
    """Return a vehicle's class, by the first word of the type that most of its rows have."""
    word = _find_type().str.to_lowercase().str.extract(r"^([a-z]+|\d+)")
    return word.replace_strict(CLASSES, default=None, return_dtype=pl.String)


def _find_type() -> pl.Expr:
    return pl.col("type_most_common").drop_nulls().mode().min()


def _find_automated() -> pl.Expr:
    """Return whether a vehicle is automated: where one row says yes; without such a column, by I-395's type."""
    flag = pl.col("automated").str.to_lowercase().str.starts_with("y")
    coded = _find_type().str.extract(r"^(\d+)")
    return pl.when(flag.is_not_null().any()).then(flag.any()).otherwise(coded == AUTOMATED_TYPE)


TGSIM = Source(
    name="tgsim",
    title="Third Generation Simulation (TGSIM) trajectories among automated vehicles",
    licence="public domain (U.S. Department of Transportation)",
    citation=references.TGSIM.full,
    signature="TGSIM: a header with id, time, xloc_kf (or xloc-kf)",
    version=1,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    spill=spill_file,
    beside=(CENTRELINES,),
    describe_columns=describe_columns,
)
