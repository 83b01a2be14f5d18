"""I-24 MOTION, INCEPTION release: 4.2 miles of freeway near Nashville, 25 Hz, a JSON list of trajectories in feet."""

import re
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import polars as pl

from tracklake.pipeline.sources.accounting import FILE, account_rows
from tracklake.pipeline.sources.assembly import assemble_subset
from tracklake.pipeline.sources.csv import BOM, LINE, REJECT_SCHEMA
from tracklake.pipeline.sources.i24_documents import Documents, read_documents
from tracklake.pipeline.sources.ngsim import group
from tracklake.pipeline.sources.source import Canonical, Part, RawFile, Source, Spilled, Subset
from tracklake.pipeline.sources.spill import spill_rows
from tracklake.pipeline.transforms.tracks.headings import find_headings
from tracklake.pipeline.transforms.tracks.leaders import derive_lanes
from tracklake.schemas import COMPLETENESS, references
from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.raw_i24 import MILE_FT, RAW_I24

DIALECT = "i24-json"
RATE_HZ = 25.0
"""Rate of the trajectories, in Hz."""
PERIOD_S = 300
"""Length of a recording in s, so that its tables fit into memory; a day is cut into these, as NGSIM's are published."""
PERIOD_FRAMES = round(PERIOD_S * RATE_HZ)
ON_FRAME = 0.01
"""Farthest from a frame, in frames, at which a position counts as that of the frame."""
LONGEST_STEP = 1.5
"""Longest step in frames over which a position at a frame between is interpolated; frame gaps are longer."""
LEAST_ENTRIES = 2
"""Fewest positions on frames of a trajectory: one has no speed."""
NO_FRAMES = "fewer than two positions on frames"
LANE_FT = 12.0
"""Width of a lane in feet."""
MAIN_LANE_SHARE = 0.05
"""Least share of a direction's entries, in the whole file, of a main lane; the shoulder left of lane 1 has fewer."""
MOST_LANES = 8
"""Highest number of a lane, right of the main lanes: of ramps."""
ORIGIN_FT = {1: 58 * MILE_FT, -1: 64 * MILE_FT}
"""Mile posts from which x_m counts, by direction; the corridor lies between them."""
DIRECTIONS = {1: "east", -1: "west"}
CLASSES = {0: "car", 1: "car", 2: "car", 3: "car", 4: "truck", 5: "truck", 6: "motorcycle"}
"""Classes by coarse_vehicle_class."""
SYNTHETIC_ID = "73796e746865746963"
"""Beginning of _id in generated documents: `synthetic` in hex; those of databases begin with a time."""
_LOCAL = ZoneInfo("America/Chicago")
_BEGIN = re.compile(rb'^\s*\[\s*\{\s*("_id"\s*:\s*(\{[^{}]*\}|"[^"]*")\s*,\s*)?"timestamp"\s*:\s*\[')
REASONS: tuple[tuple[str, pl.Expr], ...] = (
    ("direction is neither 1 nor -1", ~pl.col("direction").is_in([1.0, -1.0])),
    ("fewer than two times", pl.col("timestamp").list.len() < 2),
    (
        "arrays of positions are not as long as that of times",
        (pl.col("x_position").list.len() != pl.col("timestamp").list.len())
        | (pl.col("y_position").list.len() != pl.col("timestamp").list.len()),
    ),
    (
        "a time or position is no number",
        pl.any_horizontal(
            pl.col(name).list.drop_nulls().list.len() != pl.col(name).list.len()
            for name in ("timestamp", "x_position", "y_position")
        ),
    ),
    ("times do not increase", (pl.col("timestamp").list.diff(null_behavior="drop").list.min() <= 0)),
    *(
        (
            f"{name} beyond {low:,.0f} to {high:,.0f}",
            (pl.col(name).list.min() < low) | (pl.col(name).list.max() > high),
        )
        for name, (low, high) in RAW_I24.bounds.items()
        if name in ("timestamp", "x_position", "y_position") and low is not None and high is not None
    ),
)
"""Reasons to reject a document, and what it then is; null is a missing key."""


def detect(head: bytes, _name: str) -> str | None:
    """Recognise a list of trajectories by its beginning; the first array may be longer than the head."""
    head = head.removeprefix(BOM)
    is_list = re.match(rb"\s*\[\s*\{", head) is not None
    return DIALECT if _BEGIN.match(head) or (is_list and b'"x_position"' in head) else None


def spill_file(file: RawFile, folder: Path) -> Spilled:
    """Read a file document by document into a folder for each period of its time."""
    recordings: Counter[str] = Counter()
    rejects, read, moved, lost, strips = [pl.DataFrame(schema=REJECT_SCHEMA)], 0, 0, 0, []
    for number, documents in enumerate(read_documents(file)):
        kept, refused = split_unusable(documents)
        points, between, unused = put_on_frames(kept)
        vanished = kept.join(points.select(pl.col("vehicle").cast(pl.Int64).alias(LINE)).unique(), on=LINE, how="anti")
        rejects += [refused, _describe_rejects(vanished.with_columns(reason=pl.lit(NO_FRAMES)))]
        read += documents.read
        moved += between
        lost += unused
        strips.append(count_strips(points))
        periods = points.partition_by("period", as_dict=True, include_key=False)
        shares = ((_name_period(file, period), rows) for (period,), rows in sorted(periods.items()))
        recordings += spill_rows(folder, number, shares)
    notes = [f"{file.name}: positions of {moved:,} trajectories lie between frames and are interpolated"] * bool(moved)
    if lost:
        notes.append(
            f"{file.name}: {lost:,} positions are not used: they lie between frames and more than {LONGEST_STEP:g} "
            f"frames from the others, or another one is nearer to the frame. Expected {RATE_HZ:g} positions a second."
        )
    refused = pl.concat(rejects).sort(LINE)
    if refused.height and refused["line"][-1] == read and refused["reason"][-1] == "cut short":
        notes.append(f"{file.name}: ends within document {read:,}: probably TRUNCATED. Download the file again.")
    return Spilled(dict(recordings), read, refused, tuple(notes), _add_strips(strips))


def split_unusable(documents: Documents) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split documents that are trajectories from the others, which are added to the rejects."""
    reason = pl.coalesce(
        *(pl.when(broken.fill_null(value=True)).then(pl.lit(reason)) for reason, broken in REASONS), pl.lit(None)
    )
    judged = documents.frame.with_columns(reason=reason)
    refused = _describe_rejects(judged.filter(pl.col("reason").is_not_null()))
    return judged.filter(pl.col("reason").is_null()), pl.concat([documents.rejects, refused]).sort(LINE)


def _describe_rejects(documents: pl.DataFrame) -> pl.DataFrame:
    """Describe parsed documents, which have a reason, as rejects."""
    text = pl.format("document {} {}", pl.col(LINE), pl.col("_id").struct.field("$oid").fill_null("without _id"))
    return documents.select(LINE, "reason", text=text)


def put_on_frames(documents: pl.DataFrame) -> tuple[pl.DataFrame, int, int]:
    """Put trajectories on the common frames, 25 a second since 1970.

    A position within 0.01 frames of one is taken for it; between two, at most 1.5 frames apart, it is interpolated.

    Returns the number of trajectories that are interpolated, the number of positions that no frame is made of, and
    period (number of the PERIOD_S since 1970), vehicle (the document's number), frame (within the period),
    x_ft, y_ft, their rates of change (central differences), direction, length_ft, width_ft, class, synthetic.
    Trajectories of fewer than two positions on frames are left out, of the numbers as well.
    """
    constants = documents.select(
        vehicle=pl.col(LINE).cast(pl.Int32),
        direction=pl.col("direction").cast(pl.Int8),
        length_ft=pl.col("length").list.median(),
        width_ft=pl.col("width").list.median(),
        **{"class": pl.col("coarse_vehicle_class").cast(pl.Int16, strict=False)},
        synthetic=pl.col("_id").struct.field("$oid").str.starts_with(SYNTHETIC_ID).fill_null(value=False),
    )
    points = documents.select(pl.col(LINE).cast(pl.Int32).alias("vehicle"), "timestamp", "x_position", "y_position")
    points = _find_frames(points.explode("timestamp", "x_position", "y_position"))
    points = points.filter((pl.col("end") - pl.col("first")).sum().over("vehicle") >= LEAST_ENTRIES)
    unused = points.filter("is_unused").height
    points = points.filter(pl.col("end") > pl.col("first")).with_columns(frame=pl.int_ranges("first", "end"))
    points = points.explode("frame").with_columns(is_between=pl.col("frame") - pl.col("at") > ON_FRAME)
    share = (pl.col("frame") - pl.col("at")) / (pl.col("ahead") - pl.col("at"))
    share = pl.when("is_between").then(share).otherwise(0.0)
    points = points.with_columns(
        x_ft=pl.col("x_position") + share * (pl.col("x_ahead") - pl.col("x_position")).fill_null(0.0),
        y_ft=pl.col("y_position") + share * (pl.col("y_ahead") - pl.col("y_position")).fill_null(0.0),
    )
    between = points.filter("is_between")["vehicle"].n_unique()
    points = points.select(
        *("vehicle", "x_ft", "y_ft"),
        speed_ftps=_derive_rate("x_ft"),
        lateral_ftps=_derive_rate("y_ft"),
        period=pl.col("frame") // PERIOD_FRAMES,
        frame=(pl.col("frame") % PERIOD_FRAMES).cast(pl.Int32),
    )
    return points.join(constants, on="vehicle", how="left", maintain_order="left"), between, unused


def _find_frames(points: pl.DataFrame) -> pl.DataFrame:
    """Find each position's `first` frame and that before which it `end`s: the two are the same where it has none."""
    at, is_same = pl.col("at"), pl.col("vehicle") == pl.col("vehicle").shift(-1)
    points = points.with_columns(at=pl.col("timestamp") * RATE_HZ)
    points = points.with_columns(
        first=(at - ON_FRAME).ceil().cast(pl.Int64),
        ahead=pl.when(is_same).then(at.shift(-1)),
        x_ahead=pl.when(is_same).then(pl.col("x_position").shift(-1)),
        y_ahead=pl.when(is_same).then(pl.col("y_position").shift(-1)),
    )
    first, ahead = pl.col("first"), pl.col("ahead")
    after_own = first + (first - at <= ON_FRAME).cast(pl.Int64)
    after = (ahead - ON_FRAME).ceil().cast(pl.Int64)
    points = points.with_columns(end=pl.when(ahead - at <= LONGEST_STEP).then(after).otherwise(after_own))
    ends_interpolation = (pl.col("end") > after_own).shift(1, fill_value=False)
    return points.with_columns(is_unused=(pl.col("end") == first) & ~ends_interpolation)


def _name_period(file: RawFile, period: int) -> str:
    """Name a period by the user's name of the file, or the local date, and its local time."""
    start = datetime.fromtimestamp(period * PERIOD_S, tz=UTC).astimezone(_LOCAL)
    again = "-again" if start.fold else ""  # the hour repeated at the end of summer time
    return f"{file.recording or f'i-24-{start:%Y%m%d}'}-{start:%H%M}{again}"


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the spilled positions of one period, a part per file that holds some of it, into its tables."""
    shares = [
        part.rows.collect().with_columns(pl.lit(index, pl.Int64).alias(FILE))
        for index, part in enumerate(parts)
        if part.rows is not None
    ]
    points = _number_vehicles(pl.concat(shares))
    # What was rejected are documents, and these are rows of no period.
    log, rejects = account_rows("i24", recording, parts, [share.height for share in shares], [])
    first_frame, last_frame = points.select(a=pl.col("frame").min(), b=pl.col("frame").max()).row(0)
    facts: dict[str, Any] = {
        "recording": recording,
        "site": "i-24",
        "origin": "synthetic" if points["synthetic"].all() else "recorded",
        "freeway": True,
        "frame_rate_hz": RATE_HZ,
        "first_frame": first_frame,
        "seconds": (last_frame - first_frame + 1) / RATE_HZ,
        "on_ramp_lanes": [],
        "ids_split": 0,
    }
    files = [part.file for part in parts]
    strips = _add_strips([part.totals for part in parts if part.totals is not None])
    subsets = tuple(
        _to_subset(points.filter(pl.col("direction") == sign), sign, strips, {**facts, "direction": name}, files)
        for sign, name in DIRECTIONS.items()
        if (points["direction"] == sign).any()
    )
    return Canonical(subsets, log, rejects, COMPLETENESS.empty(), (), "vehicle")


def _number_vehicles(points: pl.DataFrame) -> pl.DataFrame:
    """Number vehicles by their documents; where several files hold the period, documents of later files count on."""
    last = points.group_by(FILE).agg(pl.col("vehicle").max()).sort(FILE)
    before = last.with_columns(before=pl.col("vehicle").cum_sum().shift(1, fill_value=0)).select(FILE, "before")
    return (
        points.join(before, on=FILE, how="left", maintain_order="left")
        .with_columns(vehicle_id=(pl.col("vehicle") + pl.col("before")).cast(pl.Int32))
        .sort("vehicle_id", "frame")
    )


def _to_subset(
    points: pl.DataFrame, sign: int, strips: pl.DataFrame, facts: dict[str, Any], files: Sequence[RawFile]
) -> Subset:
    """Build the tables of one carriageway: fronts in metres, lanes by strips of 12 ft, speeds from positions."""
    sizes = points.group_by("vehicle_id", maintain_order=True).agg(
        source_vehicle_id=pl.col("vehicle").first(),
        length_m=pl.col("length_ft").first() * FOOT_M,
        width_m=pl.col("width_ft").first() * FOOT_M,
        entries_announced=pl.lit(None, pl.Int32),
        **{"class": pl.col("class").first().replace_strict(CLASSES, default=None, return_dtype=pl.String)},
    )
    side, left_ft, lanes = find_lanes(strips.filter(pl.col("direction") == sign))
    back = points.select(
        "vehicle_id",
        "frame",
        length_m=pl.col("length_ft").fill_null(0.0) * FOOT_M,
        x_m=sign * (pl.col("x_ft") - ORIGIN_FT[sign]) * FOOT_M,
        y_m=(side * pl.col("y_ft") - left_ft) * FOOT_M,
        speed_mps=sign * pl.col("speed_ftps") * FOOT_M,
        lateral_speed_mps=side * pl.col("lateral_ftps") * FOOT_M,
    )
    names = ("vehicle_id", "frame", "speed_mps", "lateral_speed_mps")
    vehicle, frame, forward_mps, right_mps = (back[name].to_numpy() for name in names)
    headings = find_headings(vehicle, frame, forward_mps, right_mps, RATE_HZ)
    cosine, sine = (pl.lit(pl.Series(values)) for values in headings)
    half = pl.col("length_m") / 2
    entries = back.with_columns(
        lane=derive_lanes(pl.col("y_m") + half * sine, LANE_FT * FOOT_M, MOST_LANES),  # by the body's middle
        x_m=(pl.col("x_m") + 2 * half * cosine).round(3),
        y_m=(pl.col("y_m") + 2 * half * sine).round(3),
        heading_rad=sine.arcsin().round(4),
        accel_mps2=pl.lit(None),
    )
    return assemble_subset(
        entries,
        sizes,
        dataset="i24",
        name=f"{facts['recording']}-{facts['direction']}",
        facts={
            **facts,
            "lanes": lanes,
            "lane_markings_m": [round(number * LANE_FT * FOOT_M, 4) for number in range(lanes + 1)],
            "columns_missing": ["accel_mps2", "headway_recorded_m"],
        },
        use_recorded_headway=False,
        files=files,
    )


def count_strips(points: pl.DataFrame) -> pl.DataFrame:
    """Count the entries of each direction by strips of 12 ft, from y = 0."""
    strip = (pl.col("y_ft") / LANE_FT).floor().cast(pl.Int32)
    return points.group_by("direction", strip=strip).agg(entries=pl.len().cast(pl.Int64))


def _add_strips(counts: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Add up the counts of strips of blocks or files."""
    return pl.concat(counts).group_by("direction", "strip").agg(pl.col("entries").sum()).sort("direction", "strip")


def find_lanes(strips: pl.DataFrame) -> tuple[int, float, int]:
    """Find the sign of y to the driver's right, the left edge of the leftmost main lane in feet, and their number.

    A lane is a strip of 12 ft, from y = 0. The main lanes begin with the first strip that has a twentieth of the
    entries: whether lane 1 or the shoulder lies between 0 and 12 ft is for the data to say. They are counted over whole
    files, so that all recordings of a file have the same lanes.
    """
    # The driver's right has greater y, where y is not negative on the whole carriageway.
    entries = pl.col("entries")
    is_negative = entries.filter(pl.col("strip") < 0).sum() * 2 > entries.sum()
    side = -1 if strips.select(is_negative).item() else 1
    strip = pl.col("strip") if side == 1 else -1 - pl.col("strip")
    fewest = pl.min_horizontal(MAIN_LANE_SHARE * entries.sum(), entries.max())
    main = strips.filter(entries >= fewest).select(strip).to_series().sort()
    first = main[0]
    return side, first * LANE_FT, int((main - first == pl.Series(range(main.len()))).sum())


def _derive_rate(column: str) -> pl.Expr:
    """Differentiate a position over the neighbouring frames: on one side at ends of tracks, over a gap where needed."""
    value, frame, vehicle = pl.col(column), pl.col("frame"), pl.col("vehicle")
    slopes = [
        pl.when(vehicle.shift(step) == vehicle).then((value.shift(step) - value) / (frame.shift(step) - frame))
        for step in (-1, 1)
    ]
    near = [
        pl.when((frame.shift(step) - frame).abs() == 1).then(slope) for step, slope in zip((-1, 1), slopes, strict=True)
    ]
    return pl.coalesce(pl.mean_horizontal(near), *slopes) * RATE_HZ


I24 = Source(
    name="i24",
    title="I-24 MOTION trajectories, INCEPTION release",
    licence="that of the I-24 MOTION project (i24motion.org): free, with citation, no re-identification",
    citation=references.GLOUDEMANS.full,
    signature="I-24 MOTION: a JSON list of trajectories",
    version=2,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    spill=spill_file,
)
