"""I-24 MOTION, INCEPTION release: 4.2 miles of freeway near Nashville, 25 Hz, a JSON list of trajectories in feet."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import ceil
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import polars as pl

from tracklake.pipeline.sources.accounting import FILE, account_rows
from tracklake.pipeline.sources.assembly import KINEMATICS_S, assemble_slices, assemble_subset
from tracklake.pipeline.sources.csv import BOM, LINE, REJECT_SCHEMA
from tracklake.pipeline.sources.i24_documents import Documents, read_documents
from tracklake.pipeline.sources.i24_frames import (
    LONGEST_STEP,
    PERIOD_FRAMES,
    PERIOD_S,
    RATE_HZ,
    add_headings,
    put_on_frames,
)
from tracklake.pipeline.sources.ngsim import group
from tracklake.pipeline.sources.source import Canonical, Part, RawFile, Source, SourceError, Spilled
from tracklake.pipeline.sources.spill import spill_rows
from tracklake.pipeline.transforms.slices import Slice, cut_frames
from tracklake.pipeline.transforms.tracks.headings import find_headings
from tracklake.pipeline.transforms.tracks.leaders import derive_lanes
from tracklake.schemas import COMPLETENESS, references
from tracklake.schemas.columns import FOOT_M
from tracklake.schemas.raw_i24 import MILE_FT, RAW_I24

DIALECT = "i24-json"
NO_FRAMES = "fewer than two positions on frames"
LANE_FT = 12.0
"""Width of a lane in feet."""
MAIN_LANE_SHARE = 0.05
"""Least share of a direction's entries, in the whole file, of a main lane; the shoulder left of lane 1 has fewer."""
LONGEST_DAYS = 31
"""Longest recording, in days; a wrong time would make one of decades."""
MOST_LANES = 8
"""Highest number of a lane, right of the main lanes: of ramps."""
ORIGIN_FT = {1: 58 * MILE_FT, -1: 64 * MILE_FT}
"""Mile posts from which x_m counts, by direction; the corridor lies between them."""
DIRECTIONS = {1: "east", -1: "west"}
CLASSES = {0: "car", 1: "car", 2: "car", 3: "car", 4: "truck", 5: "truck", 6: "motorcycle"}
"""Classes by coarse_vehicle_class."""
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
    """Read a file document by document into a folder for each period of its time.

    With a name from the user the file is one recording, with a folder of its own in which the periods are.
    """
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
        if file.recording:
            points = add_headings(points).with_columns(frame=pl.col("period") * PERIOD_FRAMES + pl.col("frame"))
        periods = points.partition_by("period", as_dict=True, include_key=False)
        if file.recording:
            shares = ((str(period), rows) for (period,), rows in sorted(periods.items()))
            # Added as a counter, which leaves out a recording without rows: such a file is refused.
            recordings += Counter({file.recording: spill_rows(folder / file.recording, number, shares).total()})
        else:
            shares = ((_name_period(period), rows) for (period,), rows in sorted(periods.items()))
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


def _name_period(period: int) -> str:
    """Name a period by its local date and time."""
    start = datetime.fromtimestamp(period * PERIOD_S, tz=UTC).astimezone(_LOCAL)
    again = "-again" if start.fold else ""  # the hour repeated at the end of summer time
    return f"i-24-{start:%Y%m%d-%H%M}{again}"


def to_canonical(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the spilled positions of one recording, a part per file that holds some of it, into its tables."""
    if parts[0].file.recording == recording:
        return _to_long(parts, recording)
    shares = [
        part.rows.collect().with_columns(pl.lit(index, pl.Int64).alias(FILE))
        for index, part in enumerate(parts)
        if part.rows is not None
    ]
    points = _number_vehicles(pl.concat(shares))
    # What was rejected are documents, and these are rows of no period.
    log, rejects = account_rows("i24", recording, parts, [share.height for share in shares], [])
    bounds = points.select(first=pl.col("frame").min(), last=pl.col("frame").max()).row(0)
    facts = _describe_recording(recording, *bounds, is_synthetic=points["synthetic"].all())
    files = [part.file for part in parts]
    strips = _add_strips([part.totals for part in parts if part.totals is not None])
    subsets = []
    for sign, name in DIRECTIONS.items():
        own = points.filter(pl.col("direction") == sign)
        if own.height:
            road = Road(sign, *find_lanes(strips.filter(pl.col("direction") == sign)))
            subsets.append(
                assemble_subset(
                    _orient(own, road),
                    _find_sizes(own.lazy()).collect(),
                    dataset="i24",
                    name=f"{recording}-{name}",
                    facts={**facts, "direction": name, **road.facts},
                    use_recorded_headway=False,
                    files=files,
                )
            )
    return Canonical(tuple(subsets), log, rejects, COMPLETENESS.empty(), (), "vehicle")


@dataclass(frozen=True)
class Road:
    """One carriageway: its direction, and its lanes as `find_lanes` returns them."""

    sign: int
    side: int
    left_ft: float
    lanes: int

    @property
    def facts(self) -> dict[str, Any]:
        """Columns of SUBSETS that it gives."""
        return {
            "lanes": self.lanes,
            "lane_markings_m": [round(number * LANE_FT * FOOT_M, 4) for number in range(self.lanes + 1)],
            "columns_missing": ["accel_mps2", "headway_recorded_m"],
        }


def _describe_recording(recording: str, first_frame: int, last_frame: int, *, is_synthetic: bool) -> dict[str, Any]:
    """Return the columns of SUBSETS that both carriageways share."""
    return {
        "recording": recording,
        "site": "i-24",
        "origin": "synthetic" if is_synthetic else "recorded",
        "freeway": True,
        "frame_rate_hz": RATE_HZ,
        "first_frame": first_frame,
        "seconds": (last_frame - first_frame + 1) / RATE_HZ,
        "on_ramp_lanes": [],
        "ids_split": 0,
    }


def _to_long(parts: Sequence[Part], recording: str) -> Canonical:
    """Turn the spilled positions of whole files into the tables of one recording, slice by slice.

    Frames count from the beginning of the first period.
    """
    rows, offsets = _number_long([_scan(part.folder) for part in parts if part.folder is not None])
    counts = rows.group_by(FILE, "direction", "frame").agg(rows=pl.len().cast(pl.Int64)).collect(engine="streaming")
    of_files = counts.group_by(FILE).agg(pl.col("rows").sum()).sort(FILE)["rows"].to_list()
    log, rejects = account_rows("i24", recording, parts, of_files, [])
    first, last = counts.select(first=pl.col("frame").min(), last=pl.col("frame").max()).row(0)
    if last - first > LONGEST_DAYS * 86_400 * RATE_HZ:
        begin, end = (datetime.fromtimestamp(frame / RATE_HZ, tz=UTC).date() for frame in (first, last))
        raise SourceError(
            f"recording {recording}: its trajectories are from {begin} to {end}; expected those of at most "
            f"{LONGEST_DAYS} days. Give the files of one day, and repair wrong times, or leave out --recording."
        )
    zero = first // PERIOD_FRAMES * PERIOD_FRAMES
    is_synthetic = rows.select(pl.col("synthetic").all()).collect(engine="streaming").item()
    facts = _describe_recording(recording, first - zero, last - zero, is_synthetic=is_synthetic)
    strips = _add_strips([part.totals for part in parts if part.totals is not None])
    subsets = []
    for sign, name in DIRECTIONS.items():
        own = counts.filter(pl.col("direction") == sign).group_by("frame").agg(pl.col("rows").sum()).sort("frame")
        if own.height:
            road = Road(sign, *find_lanes(strips.filter(pl.col("direction") == sign)))
            context = ceil(KINEMATICS_S * RATE_HZ)
            cuts = cut_frames(own["frame"].to_numpy() - zero, own["rows"].to_numpy(), parts[0].slice_entries, context)
            subsets.append(
                assemble_slices(
                    _orient_slices(parts, offsets, zero, road, cuts),
                    _find_sizes(rows.filter(pl.col("direction") == sign)).collect(engine="streaming"),
                    dataset="i24",
                    name=f"{recording}-{name}",
                    facts={**facts, "direction": name, **road.facts},
                    files=[part.file for part in parts],
                )
            )
    return Canonical(tuple(subsets), log, rejects, COMPLETENESS.empty(), (), "vehicle")


def _number_long(shares: Sequence[pl.LazyFrame]) -> tuple[pl.LazyFrame, list[int]]:
    """Add FILE and vehicle_id to the rows of several files; also return what that adds to each file's numbers."""
    numbered, offsets = [], [0]
    for index, rows in enumerate(shares):
        numbered.append(
            rows.with_columns(pl.lit(index, pl.Int64).alias(FILE), vehicle_id=pl.col("vehicle") + offsets[-1])
        )
        last = rows.select(pl.col("vehicle").max()).collect(engine="streaming").item()
        offsets.append(offsets[-1] + last)
    return pl.concat(numbered), offsets[:-1]


def _scan(folder: Path) -> pl.LazyFrame:
    """Return the spilled rows below a folder."""
    return pl.scan_ipc(sorted(folder.rglob("*.arrow")), glob=False)


def _orient_slices(
    parts: Sequence[Part], offsets: Sequence[int], zero: int, road: Road, slices: Iterable[Slice]
) -> Iterator[tuple[Slice, pl.DataFrame]]:
    """Yield the slices of one carriageway with their entries and those of their context."""
    for each in slices:
        first, end = zero + each.first_frame - each.context, zero + each.end_frame + each.context
        shares = [
            _scan(folder).with_columns(vehicle_id=pl.col("vehicle") + offset)
            for part, offset in zip(parts, offsets, strict=True)
            for period in range(first // PERIOD_FRAMES, (end - 1) // PERIOD_FRAMES + 1)
            if part.folder is not None and (folder := part.folder / str(period)).is_dir()
        ]
        rows = pl.concat(shares).filter(pl.col("direction") == road.sign, pl.col("frame").is_between(first, end - 1))
        points = rows.with_columns((pl.col("frame") - zero).cast(pl.Int32)).collect().sort("vehicle_id", "frame")
        yield each, _orient(points, road)


def _number_vehicles(points: pl.DataFrame) -> pl.DataFrame:
    """Number vehicles by their documents; where several files hold the period, documents of later files count on."""
    last = points.group_by(FILE).agg(pl.col("vehicle").max()).sort(FILE)
    before = last.with_columns(before=pl.col("vehicle").cum_sum().shift(1, fill_value=0)).select(FILE, "before")
    return (
        points.join(before, on=FILE, how="left", maintain_order="left")
        .with_columns(vehicle_id=(pl.col("vehicle") + pl.col("before")).cast(pl.Int32))
        .sort("vehicle_id", "frame")
    )


def _find_sizes(points: pl.LazyFrame) -> pl.LazyFrame:
    """Find the sizes and classes of vehicles, which are the same in all rows of each, and their documents' numbers."""
    return (
        points.group_by("vehicle_id")
        .agg(
            source_vehicle_id=pl.col("vehicle").first(),
            length_m=pl.col("length_ft").first() * FOOT_M,
            width_m=pl.col("width_ft").first() * FOOT_M,
            entries_announced=pl.lit(None, pl.Int32),
            **{"class": pl.col("class").first().replace_strict(CLASSES, default=None, return_dtype=pl.String)},
        )
        .sort("vehicle_id")
    )


def _orient(points: pl.DataFrame, road: Road) -> pl.DataFrame:
    """Return the entries of one carriageway: fronts in metres, lanes by strips of 12 ft, speeds from positions."""
    sign, side = road.sign, road.side
    back = points.select(
        "vehicle_id",
        "frame",
        length_m=pl.col("length_ft").fill_null(0.0) * FOOT_M,
        x_m=sign * (pl.col("x_ft") - ORIGIN_FT[sign]) * FOOT_M,
        y_m=(side * pl.col("y_ft") - road.left_ft) * FOOT_M,
        speed_mps=sign * pl.col("speed_ftps") * FOOT_M,
        lateral_speed_mps=side * pl.col("lateral_ftps") * FOOT_M,
    )
    if "sine" in points.columns:
        cosine, sine = (pl.lit(points[name]) for name in ("cosine", "sine"))
        sine = sine * side
    else:
        names = ("vehicle_id", "frame", "speed_mps", "lateral_speed_mps")
        vehicle, frame, forward_mps, right_mps = (back[name].to_numpy() for name in names)
        headings = find_headings(vehicle, frame, forward_mps, right_mps, RATE_HZ)
        cosine, sine = (pl.lit(pl.Series(values)) for values in headings)
    half = pl.col("length_m") / 2
    return back.with_columns(
        lane=derive_lanes(pl.col("y_m") + half * sine, LANE_FT * FOOT_M, MOST_LANES),  # by the body's middle
        x_m=(pl.col("x_m") + 2 * half * cosine).round(3),
        y_m=(pl.col("y_m") + 2 * half * sine).round(3),
        heading_rad=sine.arcsin().round(4),
        accel_mps2=pl.lit(None),
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


I24 = Source(
    name="i24",
    title="I-24 MOTION trajectories, INCEPTION release",
    licence="that of the I-24 MOTION project (i24motion.org): free, with citation, no re-identification",
    citation=references.GLOUDEMANS.full,
    signature="I-24 MOTION: a JSON list of trajectories",
    version=3,
    detect=detect,
    group=group,
    to_canonical=to_canonical,
    spill=spill_file,
)
