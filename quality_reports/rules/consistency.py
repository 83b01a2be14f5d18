"""Rules about recorded values that disagree with each other, with positions, lanes or the vehicle's class."""

import polars as pl

from tracklake.quality_reports.rules.rule import DESIGN, PUNZO, Case, Limits, Rule, Threshold, recorded


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
    "threshold. A jerk of zero has no sign and is passed over: +, 0, - is one change, +, 0, + none. Behind a track's "
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

LANE_FLICKER = Rule(
    name="lane_flicker",
    severity="info",
    unit="s",
    thresholds=(Threshold("lane_flicker_s", 2.0, "s"),),
    meaning="the vehicle has entered the lane from another one and goes back to the same one after no longer than the "
    "threshold (entries of the stay / frame rate); all entries of the stay break the rule. A frame gap ends a stay "
    "without a return",
    source=DESIGN,
    breaks=lambda limits: pl.col("lane_stay_s") <= limits["lane_flicker_s"],
    value=pl.col("lane_stay_s"),
    extreme="min",
    compared="as it is",
    case=Case(
        {
            "vehicle_id": (1, 1, 1, 1, 2, 2, 2, 2, 2),
            "frame": (1, 2, 3, 4, 1, 2, 3, 4, 5),
            "lane": (1, 2, 2, 1, 1, 2, 2, 2, 1),
        },
        breaks=(1, 2),
        frame_rate_hz=1.0,
    ),
)

leader, nearest = pl.col("leader_ahead_m"), pl.col("nearest_ahead_m")

LEADER_MISMATCH = Rule(
    name="leader_mismatch",
    severity="warning",
    unit="m",
    thresholds=(Threshold("leader_mismatch_m", 100.0, "m"),),
    meaning="the recorded leader is in another lane, behind, or farther ahead than the nearest vehicle ahead in the "
    "lane; or none is recorded although a vehicle is ahead in the lane within the threshold. Vehicles abreast of each "
    "other (to 0.1 mm) may lead in either order. A recorded leader without an entry in the frame cannot be judged. The "
    "worst value is how far the recorded leader's front is from that of the nearest; where there is but one of them, "
    "from the vehicle's own",
    source=DESIGN,
    breaks=lambda limits: (
        pl.when(pl.col("leader_id").is_null())
        .then(nearest <= limits["leader_mismatch_m"])
        .otherwise((pl.col("leader_in_lane") == 0) | (leader < 0) | (leader > nearest))
    ),
    value=(leader.fill_null(0.0) - nearest.fill_null(0.0)).abs(),
    extreme="max",
    compared="rounded to 0.1 mm",
    case=Case(
        {
            "x_m": (0.0, 20.0, 50.0, 150.1, 0.0),
            "lane": (1, 1, 1, 1, 2),
            "leader_id": (2, None, None, None, 1),
        },
        breaks=(1, 4),
    ),
)

headway_difference = (pl.col("recorded_gap_m") - pl.col("gap_m")).abs().round(3)

HEADWAY_MISMATCH = Rule(
    name="headway_mismatch",
    severity="info",
    unit="m",
    thresholds=(Threshold("headway_mismatch_m", 1.0, "m"),),
    meaning="the recorded headway and the one from positions differ by more than the threshold; where the leader has "
    "no entry in the frame there is nothing to compare. Whether a source counts from front to front or from bumper to "
    "bumper is taken from the positions, as in negative_headway_recorded",
    source=DESIGN,
    breaks=lambda limits: headway_difference > limits["headway_mismatch_m"],
    value=headway_difference,
    extreme="max",
    compared="rounded to 1 mm",
    case=Case(
        {"leader_id": (None, 1, 1), "headway_recorded_m": (None, 15.0, 15.01), "gap_m": (None, 10.0, 10.0)},
        breaks=(2,),
    ),
)

SIZES_M: dict[str, dict[str, tuple[float, float]]] = {
    "car": {"length": (2.4, 8.0), "width": (1.2, 2.7)},
    "truck": {"length": (4.0, 26.0), "width": (1.4, 3.2)},
    "motorcycle": {"length": (1.0, 3.2), "width": (0.3, 1.6)},
}
"""Least and greatest length and width by class. Cars: from the smallest two-seaters (2.5 m x 1.5 m) to long vans and
pick-ups; trucks: from vans to the longest combinations on European roads (25.25 m) and 2.6 m of width with mirrors and
tracking error; motorcycles with theirs."""


def _make_size_limits() -> tuple[Threshold, ...]:
    """Make the thresholds of SIZES_M."""
    return tuple(
        Threshold(f"{name}_{side}_{end}_m", bound, "m")
        for name, sides in SIZES_M.items()
        for side, bounds in sides.items()
        for end, bound in zip(("min", "max"), bounds, strict=True)
    )


def _measure_excess(limits: Limits) -> pl.Expr:
    """Measure how far length or width lies outside the bounds of the class, m; null without a class or a size."""
    excess = pl.lit(None, pl.Float32)
    for name, sides in SIZES_M.items():
        distances = [
            distance
            for side in sides
            for distance in (
                recorded(limits[f"{name}_{side}_min_m"]) - pl.col(f"{side}_m"),
                pl.col(f"{side}_m") - recorded(limits[f"{name}_{side}_max_m"]),
            )
        ]
        excess = pl.when(pl.col("class") == name).then(pl.max_horizontal(distances)).otherwise(excess)
    return excess


IMPLAUSIBLE_SIZE = Rule(
    name="implausible_size",
    severity="warning",
    unit="m",
    thresholds=_make_size_limits(),
    meaning="the vehicle's length or width lies outside the generous bounds of its class; all its entries break the "
    "rule. The worst value is by how much",
    source=f"{DESIGN}; lengths and widths of road vehicles: Directive 96/53/EC (trucks 18.75 m and 2.55 m; 25.25 m for "
    "modular combinations), 23 CFR 658 (width 2.6 m)",
    breaks=lambda limits: _measure_excess(limits) > 0,
    value=_measure_excess,
    extreme="max",
    compared="as recorded, in single precision",
    case=Case({"class": ("car", "car", "truck"), "length_m": (8.0, 8.01, 8.01)}, breaks=(1,)),
)

OUTSIDE_LANE = Rule(
    name="outside_lane",
    severity="info",
    unit="m",
    thresholds=(Threshold("outside_lane_m", 0.0, "m"),),
    meaning="the vehicle's front centre lies outside the markings of its lane by more than the threshold, to 1 mm; "
    "checked where the markings are known",
    source=DESIGN,
    breaks=lambda limits: pl.col("out_of_lane_m") > limits["outside_lane_m"],
    value=pl.col("out_of_lane_m"),
    extreme="max",
    compared="rounded to 1 mm",
    case=Case({"y_m": (0.0, 3.75, 3.751)}, breaks=(2,), lane_markings_m=(0.0, 3.75)),
)

CONSISTENCY_RULES = (
    SPEED_MISMATCH,
    HIGH_JERK,
    JERK_FLICKER,
    LANE_FLICKER,
    LEADER_MISMATCH,
    HEADWAY_MISMATCH,
    IMPLAUSIBLE_SIZE,
    OUTSIDE_LANE,
)
"""Rules of this module, in the order of the report."""
