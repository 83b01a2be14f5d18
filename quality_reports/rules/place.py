"""Rules about where a vehicle is: among the others, in its lane, and how large it is."""

import polars as pl

from tracklake.quality_reports.rules.rule import COIFMAN, DESIGN, STUDY, Case, Limits, Rule, Threshold, recorded

NEGATIVE_HEADWAY = Rule(
    name="negative_headway",
    severity="error",
    unit="m",
    thresholds=(Threshold("negative_headway_m", 0.0, "m", least=None, greatest=0.0),),
    meaning="the bumper-to-bumper gap to the leader, from positions, is below the threshold: two vehicles overlap",
    source=f"{STUDY}; {DESIGN}; found in NGSIM by {COIFMAN}",
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
    thresholds=(Threshold("negative_headway_recorded_m", 0.0, "m", least=None, greatest=0.0),),
    meaning="the recorded headway less the leader's length is below the threshold, whatever the positions say: how the "
    "published counts were made. Headways recorded from bumper to bumper (those that are nearer to gap_m as they "
    "stand, in the subset's median) count without taking the length off again",
    source=f"{STUDY}, whose counts of NGSIM's negative headways it repeats; {DESIGN}",
    breaks=lambda limits: pl.col("recorded_gap_m") < limits["negative_headway_recorded_m"],
    value=pl.col("recorded_gap_m"),
    extreme="min",
    compared="rounded to 1 mm",
    case=Case({"leader_id": (None, 1, 1), "headway_recorded_m": (None, 4.0, 3.999)}, breaks=(2,)),
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
    meaning="the middle of the vehicle's body lies outside the markings of its lane by more than the threshold, to 1 "
    "mm; it is half a length behind the front centre. Checked where the markings are known",
    source=DESIGN,
    breaks=lambda limits: pl.col("out_of_lane_m") > limits["outside_lane_m"],
    value=pl.col("out_of_lane_m"),
    extreme="max",
    compared="rounded to 1 mm",
    case=Case({"y_m": (0.0, 3.75, 3.751)}, breaks=(2,), lane_markings_m=(0.0, 3.75)),
)

PLACE_RULES = (
    NEGATIVE_HEADWAY,
    NEGATIVE_HEADWAY_RECORDED,
    OVERLAP,
    LANE_FLICKER,
    LEADER_MISMATCH,
    HEADWAY_MISMATCH,
    IMPLAUSIBLE_SIZE,
    OUTSIDE_LANE,
)
"""Rules about the position and size of a vehicle, in the order of the report."""
