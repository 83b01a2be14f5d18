"""Rules about how one vehicle moves: recorded speed and acceleration, and positions from entry to entry."""

import polars as pl

from tracklake.quality_reports.rules.rule import (
    DESIGN,
    PUNZO,
    RAJAMANI,
    RAKHA,
    STUDY,
    Case,
    Limits,
    Rule,
    Threshold,
    recorded,
)
from tracklake.schemas.motion_bounds import BOUNDS

HIGH_ACCELERATION = Rule(
    name="high_acceleration",
    severity="warning",
    unit="m/s2",
    thresholds=(Threshold("high_acceleration_mps2", 3.05, "m/s2"),),
    meaning="the recorded acceleration exceeds the threshold (10 ft/s², rounded up)",
    source=f"{STUDY}; {DESIGN}; implausible accelerations in NGSIM: {PUNZO}",
    breaks=lambda limits: pl.col("accel_mps2") > recorded(limits["high_acceleration_mps2"]),
    value=pl.col("accel_mps2"),
    extreme="max",
    compared="as recorded, in single precision",
    case=Case({"accel_mps2": (3.05, 3.06, None)}, breaks=(1,)),
)

HARD_DECELERATION = Rule(
    name="hard_deceleration",
    severity="warning",
    unit="m/s2",
    thresholds=(Threshold("hard_deceleration_mps2", 8.0, "m/s2"),),
    meaning="the recorded deceleration exceeds the threshold, that of emergency braking on a dry road",
    source=f"{DESIGN}; UN Regulation 13-H demands 6.43 m/s² of a car's brakes; implausible accelerations: {PUNZO}",
    breaks=lambda limits: pl.col("accel_mps2") < -recorded(limits["hard_deceleration_mps2"]),
    value=pl.col("accel_mps2"),
    extreme="min",
    compared="as recorded, in single precision",
    case=Case({"accel_mps2": (-8.0, -8.01, None)}, breaks=(1,)),
)


def _make_acceleration_limits() -> tuple[Threshold, ...]:
    """Make the thresholds of every class."""
    named = (("at_rest_mps2", "m/s2"), ("fall_per_s", "1/s"), ("least_mps2", "m/s2"))
    return tuple(
        Threshold(f"acceleration_bound_{kind}_{name}", value, unit)
        for kind, own in BOUNDS.items()
        for (name, unit), value in zip(
            named, (own.accel_at_rest_mps2, own.accel_fall_per_s, own.least_accel_mps2), strict=True
        )
    )


def _measure_acceleration_excess(limits: Limits) -> pl.Expr:
    """Measure how far the recorded acceleration exceeds the bound at the recorded speed, m/s², to 0.001."""
    speed, bound = pl.col("speed_mps").cast(pl.Float64).clip(lower_bound=0), pl.lit(None, pl.Float64)
    for kind in BOUNDS:
        at_rest, fall, least = (
            limits[f"acceleration_bound_{kind}_{name}"] for name in ("at_rest_mps2", "fall_per_s", "least_mps2")
        )
        own = (at_rest - fall * speed).clip(lower_bound=least)
        bound = pl.when(pl.col("motion_class") == kind).then(own).otherwise(bound)
    return (pl.col("accel_mps2").cast(pl.Float64) - bound).round(3)


ACCELERATION_BOUND = Rule(
    name="acceleration_bound",
    severity="warning",
    unit="m/s2",
    thresholds=_make_acceleration_limits(),
    meaning="the recorded acceleration exceeds what vehicles of the class reach at the recorded speed: a bound at rest "
    "that falls linearly with speed down to a least value. Vehicles of unknown class are taken for cars. The worst "
    "value is by how much",
    source=f"{DESIGN}; accelerations that fall linearly with speed: {RAKHA}",
    breaks=lambda limits: _measure_acceleration_excess(limits) > 0,
    value=_measure_acceleration_excess,
    extreme="max",
    compared="rounded to 1 mm/s²",
    case=Case(
        {
            "speed_mps": (0.0, 20.0, 20.0, 40.0, 20.0),
            "accel_mps2": (5.0, 3.2, 3.21, 2.01, 1.51),
            "class": ("car", "car", "car", None, "truck"),
        },
        breaks=(2, 3, 4),
    ),
)

LATERAL_ACCELERATION = Rule(
    name="lateral_acceleration",
    severity="warning",
    unit="m/s2",
    thresholds=(Threshold("lateral_acceleration_mps2", 3.0, "m/s2"),),
    meaning="the lateral speed has changed by more than the threshold times 0.1 s, either way, within the 0.1 s that "
    "end at the entry; at 25 Hz the lateral speed 0.1 s before is the mean of those 2 and 3 frames before. A lane "
    "change of 3.6 m needs as much where it takes 2.7 s",
    source=f"{DESIGN}; UN Regulation 79 allows systems that steer cars 3 m/s²",
    breaks=lambda limits: pl.col("lateral_accel_mps2").abs() > limits["lateral_acceleration_mps2"],
    value=pl.col("lateral_accel_mps2").abs(),
    extreme="max",
    compared="rounded to 1 mm/s²",
    case=Case(
        {"vehicle_id": (1, 1, 2, 2), "frame": (1, 2, 1, 2), "lateral_speed_mps": (0.0, -0.3, 0.0, -0.31)},
        breaks=(3,),
        frame_rate_hz=10.0,
    ),
)

HEADING_MOTION_MISMATCH = Rule(
    name="heading_motion_mismatch",
    severity="warning",
    unit="rad",
    thresholds=(
        Threshold("heading_motion_mismatch_rad", 0.1, "rad"),
        Threshold("heading_motion_speed_mps", 5.0, "m/s"),
    ),
    meaning="the body does not point where the vehicle moves: the heading differs by more than the threshold from the "
    "direction of the recorded speeds along and across the road, where the speed along it is at least the second "
    "threshold. Checked where the source has headings",
    source=f"{DESIGN}; slip angles in normal driving are small: {RAJAMANI}",
    breaks=lambda limits: (
        (pl.col("speed_mps") >= recorded(limits["heading_motion_speed_mps"]))
        & (pl.col("heading_error_rad") > limits["heading_motion_mismatch_rad"])
    ),
    value=pl.col("heading_error_rad"),
    extreme="max",
    compared="rounded to 0.0001",
    case=Case(
        {
            "speed_mps": (20.0, 20.0, 4.9, 20.0),
            "lateral_speed_mps": (2.0, 2.01, 2.01, 2.01),
            "heading_rad": (0.0, 0.0, 0.0, None),
        },
        breaks=(1,),
    ),
)

LOW_CONSTANT_SPEED = Rule(
    name="low_constant_speed",
    severity="warning",
    unit="m/s",
    thresholds=(Threshold("low_constant_speed_mps", 1.524, "m/s"),),
    meaning="the recorded speed is above zero and at most the threshold (5 ft/s exactly) while the recorded "
    "acceleration is exactly zero: a frozen measurement rather than a crawling vehicle",
    source=f"{STUDY}; {DESIGN}",
    breaks=lambda limits: (
        (pl.col("speed_mps") > 0)
        & (pl.col("speed_mps") <= recorded(limits["low_constant_speed_mps"]))
        & (pl.col("accel_mps2") == 0)
    ),
    value=pl.col("speed_mps"),
    extreme="min",
    compared="as recorded, in single precision",
    case=Case({"speed_mps": (0.0, 1.524, 1.525, 1.0), "accel_mps2": (0.0, 0.0, 0.0, 0.01)}, breaks=(1,)),
)

BACKWARD = Rule(
    name="backward",
    severity="error",
    unit="m/s",
    thresholds=(Threshold("backward_mps", 0.0, "m/s", least=None, greatest=0.0),),
    meaning="the recorded speed along the direction of travel is below the threshold: the vehicle reverses",
    source=f"{STUDY}: highD recordings 25, 26 and 36; {DESIGN}",
    breaks=lambda limits: pl.col("speed_mps") < recorded(limits["backward_mps"]),
    value=pl.col("speed_mps"),
    extreme="min",
    compared="as recorded, in single precision",
    case=Case({"speed_mps": (0.0, -0.01)}, breaks=(1,)),
)

POSITION_JUMP = Rule(
    name="position_jump",
    severity="error",
    unit="m",
    thresholds=(Threshold("position_jump_m", 2.0, "m"),),
    meaning="the way driven since the frame before differs by more than the threshold from the mean of the two "
    "recorded speeds times the time between them; the later entry breaks the rule. Entries behind a frame gap are not "
    "compared",
    source=DESIGN,
    breaks=lambda limits: pl.col("jump_m") > limits["position_jump_m"],
    value=pl.col("jump_m"),
    extreme="max",
    compared="rounded to 1 μm",
    case=Case(
        {"vehicle_id": (1, 1, 2, 2), "frame": (1, 2, 1, 2), "x_m": (0.0, 2.8, 0.0, 2.801), "speed_mps": (20.0,) * 4},
        breaks=(3,),  # 0.8 m are driven in a frame
    ),
)

FRAME_GAP = Rule(
    name="frame_gap",
    severity="warning",
    unit="frames",
    thresholds=(Threshold("frame_gap_frames", 0.0, "frames"),),
    meaning="more frames than the threshold are missing between the entry and the one before it in the track; the "
    "entry behind the gap breaks the rule",
    source=DESIGN,
    breaks=lambda limits: pl.col("frames_skipped") > limits["frame_gap_frames"],
    value=pl.col("frames_skipped"),
    extreme="max",
    compared="whole numbers",
    case=Case({"vehicle_id": (1, 1, 1), "frame": (1, 2, 4)}, breaks=(2,)),
)


def differ(first: pl.Expr, second: pl.Expr) -> pl.Expr:
    """Return abs(first - second), rounded to 1e-4.

    What differs by the threshold in the source's decimals must not exceed it by the last bit of a Float32.
    """
    return (first.cast(pl.Float64) - second.cast(pl.Float64)).abs().round(4)


speed_difference = differ(pl.col("speed_mps"), pl.col("speed_10hz_mps"))

SPEED_MISMATCH = Rule(
    name="speed_mismatch",
    severity="warning",
    unit="m/s",
    thresholds=(Threshold("speed_mismatch_mps", 1.0, "m/s"),),
    meaning="the recorded speed differs by more than the threshold from the one recomputed from the positions 0.1 s "
    "before and after. Track ends and entries beside frame gaps have no such positions and are not compared",
    source=f"{DESIGN}; internal consistency: {PUNZO}",
    breaks=lambda limits: speed_difference > limits["speed_mismatch_mps"],
    value=speed_difference,
    extreme="max",
    compared="rounded to 0.1 mm/s",
    case=Case({"speed_mps": (20.01, 20.02, 20.0), "speed_10hz_mps": (19.01, 19.01, None)}, breaks=(1,)),
)

HIGH_JERK = Rule(
    name="high_jerk",
    severity="warning",
    unit="m/s3",
    thresholds=(Threshold("high_jerk_mps3", 15.0, "m/s3"),),
    meaning="the recorded acceleration has changed by more than the threshold times 0.1 s, either way, within the "
    "0.1 s that end at the entry; at 25 Hz the acceleration 0.1 s before is the mean of those 2 and 3 frames before",
    source=f"{DESIGN}; the limit of 15 m/s³: {PUNZO}",
    breaks=lambda limits: pl.col("jerk_mps3").abs() > limits["high_jerk_mps3"],
    value=pl.col("jerk_mps3").abs(),
    extreme="max",
    compared="rounded to 1 mm/s³",
    case=Case(
        {"vehicle_id": (1, 1, 2, 2), "frame": (1, 2, 1, 2), "accel_mps2": (0.0, -1.5, 0.0, -1.51)},
        breaks=(3,),
        frame_rate_hz=10.0,
    ),
)

JERK_FLICKER = Rule(
    name="jerk_flicker",
    severity="info",
    unit="changes",
    thresholds=(Threshold("jerk_flicker_changes", 1.0, "changes"),),
    meaning="of the ten jerks, 0.1 s apart, of the second that ends at the entry, the sign changes more often than the "
    "threshold. A jerk of zero has no sign and is skipped: +, 0, - is one change, +, 0, + none. Behind a track's "
    "beginning or a frame gap the second is as long as there are entries",
    source=f"{DESIGN}; drivers reverse jerk at most once in a second: {PUNZO}",
    breaks=lambda limits: pl.col("jerk_reversals") > limits["jerk_flicker_changes"],
    value=pl.col("jerk_reversals"),
    extreme="max",
    compared="whole numbers; changes of acceleration of less than 0.05 mm/s² are none",
    case=Case(
        {"vehicle_id": (1,) * 5, "frame": (1, 2, 3, 4, 5), "accel_mps2": (0.0, 0.1, 0.1, 0.0, 0.1)},
        breaks=(4,),  # up, level, down, up
        frame_rate_hz=10.0,
    ),
)

MOTION_RULES = (
    HIGH_ACCELERATION,
    HARD_DECELERATION,
    ACCELERATION_BOUND,
    LOW_CONSTANT_SPEED,
    BACKWARD,
    POSITION_JUMP,
    FRAME_GAP,
    SPEED_MISMATCH,
    HIGH_JERK,
    JERK_FLICKER,
    LATERAL_ACCELERATION,
    HEADING_MOTION_MISMATCH,
)
"""Rules about the motion of one vehicle, in the order of the report."""
