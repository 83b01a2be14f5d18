"""Checks of NGSIM rows before anything is written: do times, positions, speeds, lanes and neighbors fit one another?

A file under NGSIM's names may hold other units, or columns in another order. Every figure below is a median or a share
over some thousand rows, and says nothing where too few rows tell it.
"""

from dataclasses import dataclass, field
from itertools import combinations

import polars as pl

from tracklake.pipeline.sources.column_mapping import SPEED_UNITS
from tracklake.pipeline.sources.ngsim_dialects import DAY_MS
from tracklake.schemas.columns import FOOT_M

FEWEST = 30
"""Fewest rows or pairs of rows that a figure is taken from."""
FRAME_MS = 100
"""Time between two frames, in ms."""
FRAMES_PER_S = 1000 / FRAME_MS

SWAPS = (
    *(("Local_X", "Local_Y"), ("v_Vel", "v_Acc"), ("Preceding", "Following")),
    *(("Vehicle_ID", "Frame_ID"), ("v_length", "v_Width")),
)
"""Pairs of columns that files hold in the other order."""

MOVING = 5.0
"""Speed from which a vehicle counts as moving, in the file's unit."""
LANE_WIDTH_FT, LANE_WIDTH_M = (9.0, 16.0), (2.7, 4.9)
"""Plausible distances between the middles of two lanes, in ft and in m."""
MAIN_LANES = 5
"""Highest number of a lane that is neither a ramp nor an auxiliary lane at any site."""
UNEVEN = 1.6
"""Highest ratio of one lane's width to the median of all."""
OTHER_SIDE = 0.3
"""Share of leaders ahead, or of followers behind, below which the columns are not what they are called."""
BACKWARDS = 0.3
"""Share of negative speeds from which v_Vel is no speed."""
LENGTH_FT = (10.0, 33.0)
"""Plausible medians of the vehicles' lengths, in ft."""
LENGTH_M = (3.0, 6.0)
"""Plausible medians of the vehicles' lengths, in m; a motorcycle of 7 ft is none of them."""
TOLERANCE = 0.06
"""Largest relative difference between the ratio of two units and what was found."""
POSITIONS = ("Local_X", "Local_Y", "Space_Headway")
SIZES = ("v_length", "v_Width")

FEET, METRES = "ft", "m"
METRES_TO_FEET = 1 / FOOT_M


@dataclass(frozen=True)
class Figures:
    """The figures of a sample of rows; None where too few rows tell one.

    Args:
        ms_per_frame: median step of Global_Time between consecutive frames of a vehicle, in its unit.
        one_time: the value of Global_Time if all rows have the same one.
        speed_ratio: median speed by positions over v_Vel, of moving vehicles.
        sideways: distance along Local_X over distance along Local_Y.
        leaders_ahead: share of the named leaders that are ahead.
        followers_behind: share of the named followers that are behind.
    """

    ms_per_frame: float | None
    mean_ms_per_frame: float | None
    one_time: int | None
    speed_ratio: float | None
    sideways: float | None
    backwards: float | None
    lane_width: float | None
    length: float | None
    width: float | None
    leaders_ahead: float | None
    followers_behind: float | None


SIDEWAYS = pl.when(pl.col("dy").sum() > 0).then(pl.col("dx").sum() / pl.col("dy").sum())
"""Distance along Local_X over distance along Local_Y."""


def measure(rows: pl.DataFrame, rate_hz: float) -> Figures:
    """Measure the figures of rows with the columns of schemas.RAW_NGSIM, in feet; missing columns are null."""
    times = _pair_frames(rows, ["Vehicle_ID"])
    step = times.select(
        step=(pl.col("Global_Time") - pl.col("time_before")) / (pl.col("Frame_ID") - pl.col("frame_before"))
    )["step"].cast(pl.Float64)
    usual = step.median() if step.len() >= FEWEST else None
    # Recordings of one file share ids, and differ in their times.
    key = [*(["key"] if usual == FRAME_MS else []), "Vehicle_ID"]
    keyed = rows.with_columns(key=pl.col("Global_Time").cast(pl.Int64) - FRAME_MS * pl.col("Frame_ID").cast(pl.Int64))
    pairs = _pair_frames(keyed, key)
    moves = pairs.select(
        "v_Vel",
        dx=(pl.col("Local_X") - pl.col("x_before")).abs(),
        dy=(pl.col("Local_Y") - pl.col("y_before")).abs(),
        seconds=(pl.col("Frame_ID") - pl.col("frame_before")) / rate_hz,
        speed=(pl.col("v_Vel") + pl.col("v_before")).abs() / 2,
        along=~pl.col("Direction").is_in([1.0, 3.0]).fill_null(value=False),
    )
    advance = (pl.col("dx").pow(2) + pl.col("dy").pow(2)).sqrt() / pl.col("seconds")
    # Either of the two is enough: where v_Vel is no speed, it may say that nothing moves.
    moving = moves.filter((pl.col("speed") > MOVING) | (advance > MOVING))
    roads = moves.filter("along")
    freeway = rows.filter(pl.col("Direction").is_null())
    return Figures(
        ms_per_frame=_as_float(usual),
        mean_ms_per_frame=None if usual is None else _as_float(step.mean()),
        one_time=_find_one_time(rows),
        speed_ratio=_as_float(moving.select(advance / pl.col("speed")).to_series().median())
        if moving.height >= FEWEST
        else None,
        sideways=_as_float(roads.select(SIDEWAYS).item()) if roads.height >= FEWEST else None,
        backwards=_as_float((moves["v_Vel"] < 0).mean()) if moves.height >= FEWEST else None,
        lane_width=_measure_lane_width(freeway),
        length=_measure_size(keyed, "v_length"),
        width=_measure_size(keyed, "v_Width"),
        leaders_ahead=_measure_neighbors(keyed, "Preceding"),
        followers_behind=_measure_neighbors(keyed, "Following", sign=-1),
    )


def counts_from_start(rows: pl.DataFrame) -> bool:
    """Return whether Global_Time advances with the frames from the recording's start instead of from 1970."""
    time = pl.col("Global_Time").cast(pl.Int64)
    start = time - FRAME_MS * pl.col("Frame_ID").cast(pl.Int64)
    return bool(rows.select((start.n_unique() == 1) & time.max().is_between(1, DAY_MS)).item())


def _as_float(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _find_one_time(rows: pl.DataFrame) -> int | None:
    """Return the time of all rows, if it is the same in several frames, or 0."""
    times = rows["Global_Time"].unique().to_list()
    return times[0] if len(times) == 1 and (rows["Frame_ID"].n_unique() > 1 or not times[0]) else None


def _pair_frames(rows: pl.DataFrame, key: list[str]) -> pl.DataFrame:
    """Pair each row with the row of the same vehicle one frame before."""
    names = {"Frame_ID": "frame_before", "Global_Time": "time_before", "Local_X": "x_before", "Local_Y": "y_before"}
    before = [pl.col(name).shift(1).over(key).alias(alias) for name, alias in (names | {"v_Vel": "v_before"}).items()]
    ordered = rows.sort(*key, "Frame_ID").with_columns(before)
    return ordered.filter(pl.col("Frame_ID") - pl.col("frame_before") == 1)


def _measure_lane_width(rows: pl.DataFrame) -> float | None:
    """Median distance between the middles of neighboring main lanes, if all of them are about as wide."""
    middles = (
        rows.filter(pl.col("Lane_ID").is_between(1, MAIN_LANES))
        .group_by("Lane_ID")
        .agg(pl.len(), pl.col("Local_X").median())
        .filter(pl.col("len") >= FEWEST)
        .sort("Lane_ID")
    )
    apart = middles.select(width=pl.col("Local_X").diff() / pl.col("Lane_ID").diff())["width"].drop_nulls()
    width = _as_float(apart.median())
    if width is None or not apart.is_between(width / UNEVEN, width * UNEVEN).all():
        return None
    return width


def _measure_size(rows: pl.DataFrame, name: str) -> float | None:
    sizes = rows.group_by("key", "Vehicle_ID").agg(pl.col(name).first(ignore_nulls=True))[name].drop_nulls()
    sizes = sizes.filter(sizes > 0)
    return _as_float(sizes.median()) if sizes.len() >= 5 else None


def _measure_neighbors(rows: pl.DataFrame, role: str, *, sign: int = 1) -> float | None:
    """Share of named neighbors on a freeway that are on their side."""
    named = rows.filter(pl.col(role) > 0, pl.col("Direction").is_null()).select(
        "key", "Frame_ID", "Local_Y", pl.col(role)
    )
    others = rows.select("key", "Frame_ID", pl.col("Vehicle_ID").alias(role), other="Local_Y")
    found = named.join(others, on=["key", "Frame_ID", role])
    ahead = sign * (found["other"] - found["Local_Y"]) > 0
    return _as_float(ahead.mean()) if found.height >= FEWEST else None


@dataclass
class Verdict:
    """What the figures of a file mean for reading it.

    `units` are those that the file has and its header does not say, by column; `use_time` says whether Global_Time
    tells recordings apart; notes are for the user.
    """

    problems: list[str] = field(default_factory=list)
    units: dict[str, str] = field(default_factory=dict)
    use_time: bool = True
    notes: list[str] = field(default_factory=list)


def judge(found: Figures) -> Verdict:
    """Judge the figures of a file that is read in NGSIM's units."""
    verdict = Verdict()
    _judge_times(found, verdict)
    if found.backwards is not None and found.backwards > BACKWARDS:
        verdict.problems.append(f"{found.backwards:.0%} of v_Vel are negative")
    if found.sideways is not None and found.sideways > 1:
        verdict.problems.append(f"vehicles move {found.sideways:.1f} times as far along Local_X as along Local_Y")
    if found.length is not None and found.width is not None and found.width > found.length:
        verdict.problems.append(f"v_Width of {found.width:g} is larger than v_length of {found.length:g}")
    sides = (("Preceding", "ahead", found.leaders_ahead), ("Following", "behind", found.followers_behind))
    verdict.problems += [
        f"only {share:.0%} of the vehicles in {name} are {side}"
        for name, side, share in sides
        if share is not None and share < OTHER_SIDE
    ]
    if not verdict.problems:
        _judge_units(found, verdict)
    return verdict


def find_order(rows: pl.DataFrame) -> dict[str, str] | None:
    """Find columns to swap so that rows without header fit; returns the column that holds each swapped one's values."""
    if rows.height < 10 * FEWEST:
        return None
    for count in range(1, len(SWAPS) + 1):
        for chosen in combinations(SWAPS, count):
            order = {name: other for pair in chosen for name, other in (pair, pair[::-1])}
            swapped = rows.with_columns(
                pl.col(other).cast(rows.schema[name], strict=False).alias(name) for name, other in order.items()
            )
            if not judge(measure(swapped, FRAMES_PER_S)).problems and not find_contradictions(swapped):
                return order
    return None


CONSTANT = ("Total_Frames", "v_length", "v_Width", "v_Class")
"""Columns with one value for each vehicle."""
CHANGES = 0.05
"""Share of pairs of frames in which a constant of the vehicle may change, since two vehicles can share an id."""
LANE_CHANGES, LANES = 0.2, 20
"""Share of pairs of frames with a lane change, and number of a lane, above which Lane_ID is no lane."""
HIGHEST_ACCEL = 30.0
"""Plausible median of the size of v_Acc, in ft/s2."""
HEADWAY_ERROR = 0.25
"""Relative difference between a headway and what it is computed from, above which the column is none."""


def find_contradictions(rows: pl.DataFrame) -> list[str]:
    """List what contradicts the order of the original files in rows without header; nothing if there are few rows."""
    keyed = rows.with_columns(key=pl.col("Global_Time").cast(pl.Int64) - FRAME_MS * pl.col("Frame_ID").cast(pl.Int64))
    before = [
        pl.col(name).shift(1).over("key", "Vehicle_ID").alias(f"{name} before") for name in (*CONSTANT, "Lane_ID")
    ]
    pairs = keyed.sort("key", "Vehicle_ID", "Frame_ID").with_columns(before)
    pairs = pairs.filter(pl.col("Frame_ID").diff().over("key", "Vehicle_ID") == 1)
    if pairs.height < FEWEST:
        return ["no vehicle is in consecutive frames at times that agree"] if rows.height >= 10 * FEWEST else []
    allowed = dict.fromkeys(CONSTANT, CHANGES) | {"Lane_ID": LANE_CHANGES}
    share = {name: _as_float((pairs[name] != pairs[f"{name} before"]).mean()) or 0 for name in allowed}
    moving = pairs.filter(pl.col("v_Vel") > MOVING, pl.col("Space_Headway") > 0)
    ahead = keyed.select("key", "Frame_ID", Preceding="Vehicle_ID", y="Local_Y")
    led = keyed.join(ahead, on=["key", "Frame_ID", "Preceding"])
    headways = [
        (led["y"] - led["Local_Y"]) / led["Space_Headway"],
        moving["Space_Headway"] / moving["v_Vel"] / moving["Time_Headway"],
    ]
    found = [f"{name} changes in {share[name]:.0%} of the frames" for name in allowed if share[name] > allowed[name]]
    errors = [abs((_as_float(ratio.median()) or 0) - 1) for ratio in headways if ratio.len() >= FEWEST]
    # One that fits the other is no other column, even if a script has changed the headways.
    found += ["headways are not what positions and speeds say"] if errors and min(errors) > HEADWAY_ERROR else []
    accel, lane = (
        _as_float(value) or 0.0
        for value in pairs.select(pl.col("v_Acc").abs().median(), pl.col("Lane_ID").max()).row(0)
    )
    found += [f"v_Acc is about {accel:g}"] if accel > HIGHEST_ACCEL else []
    return found + ([f"Lane_ID is up to {lane:g}"] if lane > LANES else [])


def _judge_times(found: Figures, verdict: Verdict) -> None:
    if found.one_time is not None:
        verdict.use_time = False
        verdict.notes.append(f"Global_Time is {found.one_time} in every row, so the frames tell one recording")
    elif found.ms_per_frame is not None and found.mean_ms_per_frame is not None and found.ms_per_frame != FRAME_MS:
        if abs(found.mean_ms_per_frame * FRAMES_PER_S - 1) < 0.2:
            verdict.use_time = False
            verdict.notes.append("Global_Time is in whole seconds, so the frames tell one recording")
        else:
            verdict.problems.append(
                f"Global_Time advances by {found.ms_per_frame:g} ms between two frames of a vehicle, not by {FRAME_MS}"
            )


def _judge_units(found: Figures, verdict: Verdict) -> None:
    """Tell feet from metres by the lanes' and the vehicles' sizes, and the unit of speed by the positions."""
    lanes = _choose_unit(found.lane_width, LANE_WIDTH_FT, LANE_WIDTH_M)
    sizes = _choose_unit(found.length, LENGTH_FT, LENGTH_M)
    if lanes is None and sizes == METRES:
        verdict.problems.append(
            f"v_length of {found.length:.1f} looks like metres, and nothing tells the positions' unit"
        )
        return
    positions = METRES if lanes == METRES else FEET
    if positions == METRES:
        verdict.units |= dict.fromkeys(POSITIONS, METRES)
        verdict.notes.append(f"lanes are {found.lane_width:.2f} apart: positions are in metres, and are read as such")
    if sizes == METRES:
        verdict.units |= dict.fromkeys(SIZES, METRES)
        verdict.notes.append(f"vehicles are {found.length:.1f} long: their sizes are in metres, and are read as such")
    if found.speed_ratio is None:
        if positions == METRES:
            verdict.problems.append("the positions are in metres, and nothing tells the unit of v_Vel")
        return
    speed = found.speed_ratio * (METRES_TO_FEET if positions == METRES else 1)
    unit = next((unit for unit, factor in SPEED_UNITS.items() if abs(speed / factor - 1) < TOLERANCE), None)
    if unit == "m/s":
        verdict.units |= {"v_Vel": "m/s", "v_Acc": "m/s2"}
        verdict.notes.append("positions advance by v_Vel in m/s: speeds and accelerations are read as such")
    elif unit != "ft/s":
        fitting = f"as if v_Vel were in {unit}" if unit else "which fits no unit of speed"
        verdict.problems.append(f"positions advance by {found.speed_ratio:.3f} times v_Vel, {fitting}")


def _choose_unit(value: float | None, feet: tuple[float, float], metres: tuple[float, float]) -> str | None:
    if value is None:
        return None
    return FEET if feet[0] <= value <= feet[1] else METRES if metres[0] <= value <= metres[1] else None
