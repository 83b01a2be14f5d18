"""Rules about what traffic cannot or hardly can do: headways, accelerations, jumps, gaps, overlaps."""

import polars as pl

from tracklake.quality_reports.rules.rule import COIFMAN, DESIGN, PUNZO, Case, Rule, Threshold, recorded

NEGATIVE_HEADWAY = Rule(
    name="negative_headway",
    severity="error",
    unit="m",
    thresholds=(Threshold("negative_headway_m", 0.0, "m"),),
    meaning="the bumper-to-bumper gap to the leader, from positions, is below the threshold: two vehicles overlap",
    source=f"{DESIGN}; found in NGSIM by {COIFMAN}",
    breaks=lambda limits: pl.col("gap_m") < limits["negative_headway_m"],
    value=pl.col("gap_m"),
    extreme="min",
    compared="to 1 mm, as ingestion rounds it",
    case=Case({"gap_m": (0.0, -0.001, None)}, breaks=(1,)),
)

NEGATIVE_HEADWAY_RECORDED = Rule(
    name="negative_headway_recorded",
    severity="error",
    unit="m",
    thresholds=(Threshold("negative_headway_recorded_m", 0.0, "m"),),
    meaning="the recorded headway less the leader's length is below the threshold, whatever the positions say: how the "
    "published counts were made. Headways recorded from bumper to bumper (those that are nearer to gap_m as they "
    "stand, in the subset's median) count without taking the length off again",
    source=f"{DESIGN}; the published counts of NGSIM's negative headways",
    breaks=lambda limits: pl.col("recorded_gap_m") < limits["negative_headway_recorded_m"],
    value=pl.col("recorded_gap_m"),
    extreme="min",
    compared="rounded to 1 mm",
    case=Case({"leader_id": (None, 1, 1), "headway_recorded_m": (None, 4.0, 3.999)}, breaks=(2,)),
)

HIGH_ACCELERATION = Rule(
    name="high_acceleration",
    severity="warning",
    unit="m/s2",
    thresholds=(Threshold("high_acceleration_mps2", 3.05, "m/s2"),),
    meaning="the recorded acceleration exceeds the threshold (10 ft/s²)",
    source=f"{DESIGN}; implausible accelerations in NGSIM: {PUNZO}",
    breaks=lambda limits: pl.col("accel_mps2") > recorded(limits["high_acceleration_mps2"]),
    value=pl.col("accel_mps2"),
    extreme="max",
    compared="as recorded, in single precision",
    case=Case({"accel_mps2": (3.05, 3.06, None)}, breaks=(1,)),
)

LOW_CONSTANT_SPEED = Rule(
    name="low_constant_speed",
    severity="warning",
    unit="m/s",
    thresholds=(Threshold("low_constant_speed_mps", 1.52, "m/s"),),
    meaning="the recorded speed is above zero and at most the threshold (5 ft/s) while the recorded acceleration "
    "is exactly zero: a frozen measurement rather than a crawling vehicle",
    source=DESIGN,
    breaks=lambda limits: (
        (pl.col("speed_mps") > 0)
        & (pl.col("speed_mps") <= recorded(limits["low_constant_speed_mps"]))
        & (pl.col("accel_mps2") == 0)
    ),
    value=pl.col("speed_mps"),
    extreme="min",
    compared="as recorded, in single precision",
    case=Case({"speed_mps": (0.0, 1.52, 1.53, 1.0), "accel_mps2": (0.0, 0.0, 0.0, 0.01)}, breaks=(1,)),
)

BACKWARD = Rule(
    name="backward",
    severity="error",
    unit="m/s",
    thresholds=(Threshold("backward_mps", 0.0, "m/s"),),
    meaning="the recorded speed along the direction of travel is below the threshold: the vehicle reverses",
    source=f"{DESIGN}; known of highD recordings 25, 26 and 36",
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

OVERLAP = Rule(
    name="overlap",
    severity="error",
    unit="m",
    thresholds=(Threshold("overlap_m", 0.0, "m"),),
    meaning="the vehicle's box lies deeper than the threshold in that of any other of the subset in the same frame, in "
    "whatever lane; the entries of both break the rule. Depth is the least distance that one of them would have to "
    "move, along or across the road, to be clear of the other, to 1 mm; touching is not overlapping. Vehicles of "
    "unknown size are not compared",
    source=f"{DESIGN}; overlapping vehicles in NGSIM: {COIFMAN}",
    breaks=lambda limits: pl.col("overlap_m") > limits["overlap_m"],
    value=pl.col("overlap_m"),
    extreme="max",
    compared="rounded to 1 mm",
    case=Case({"x_m": (10.0, 14.0, 110.0, 113.999)}, breaks=(2, 3)),
)

PLAUSIBILITY_RULES = (
    NEGATIVE_HEADWAY,
    NEGATIVE_HEADWAY_RECORDED,
    HIGH_ACCELERATION,
    LOW_CONSTANT_SPEED,
    BACKWARD,
    POSITION_JUMP,
    FRAME_GAP,
    OVERLAP,
)
"""Rules of this module, in the order of the report."""
