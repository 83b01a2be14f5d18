"""Rules about what a tracker loses, doubles or confuses: track ends, cross sections, identities, sizes."""

import polars as pl

from tracklake.quality_reports.rules.cross_sections import BORDER_M, RUNNING_S, SPACING_M, USUAL_SHARE
from tracklake.quality_reports.rules.rule import COIFMAN, DAGANZO, DESIGN, STUDY, Case, Rule, Threshold, recorded
from tracklake.quality_reports.rules.within_frames import SAME_PLACE_SHARE

WHILE_RUNNING = (
    f"Tracks that begin or end within {RUNNING_S:g} s of the recording's beginning or end, and those that do so in "
    "other lanes than main ones (ramps), are not judged; nor are recordings of arterials"
)

TRACK_FRAGMENT = Rule(
    name="track_fragment",
    severity="warning",
    unit="m",
    thresholds=(Threshold("track_fragment_m", 20.0, "m"),),
    meaning="the track begins or ends in the recorded section, farther than the threshold from its end; the track's "
    f"first or last entry breaks the rule. The section begins where {USUAL_SHARE:.0%} of the tracks have begun and "
    f"ends where {USUAL_SHARE:.0%} have yet to end. {WHILE_RUNNING}",
    source=f"{DESIGN}; late starts of highD: {STUDY}; broken tracks in NGSIM: {COIFMAN}",
    breaks=lambda limits: pl.col("fragment_m") > limits["track_fragment_m"],
    value=pl.col("fragment_m"),
    extreme="max",
    compared="rounded to 1 mm",
    case=Case(
        {
            "vehicle_id": (1, 1, 2, 2, 3, 3, 4, 4, 5, 5),
            "frame": (2, 3) * 5,
            "x_m": (0.0, 100.0, 0.0, 100.0, 20.0, 100.0, 20.001, 100.0, 0.0, 79.999),
        },
        breaks=(6, 9),
        frame_rate_hz=1.0,
        lanes=1,
        last_frame=4,
    ),
)

CROSS_SECTION_FLOW = Rule(
    name="cross_section_flow",
    severity="warning",
    unit="m",
    thresholds=(Threshold("cross_section_flow_m", 0.0, "m"),),
    meaning="vehicles are not conserved: the track crosses a cross section and ends more than the threshold before the "
    "next one, or begins more than the threshold behind a cross section and crosses the next one; its last or first "
    f"entry breaks the rule. Cross sections lie {SPACING_M:g} m apart, the first {BORDER_M:g} m behind the beginning "
    f"of the section, the last at least as far before its end. {WHILE_RUNNING}. `subset_scores.cross_sections` has the "
    "balance",
    source=f"{DESIGN}; conservation of vehicles between two observers: {DAGANZO}",
    breaks=lambda limits: pl.col("missed_section_m") > limits["cross_section_flow_m"],
    value=pl.col("missed_section_m"),
    extreme="max",
    compared="rounded to 1 mm",
    case=Case(
        {
            "vehicle_id": (1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6),
            "frame": (2, 3) * 6,
            # At 20, 120, 220 and 320 m; the fourth track crosses none.
            "x_m": (0.0, 400.0, 0.0, 400.0, 0.0, 219.0, 130.0, 219.0, 130.0, 400.0, 0.0, 400.0),
        },
        breaks=(5, 8),
        frame_rate_hz=1.0,
        lanes=1,
        last_frame=4,
    ),
)

DUPLICATE_TRACK = Rule(
    name="duplicate_track",
    severity="error",
    unit="s",
    thresholds=(Threshold("duplicate_track_s", 0.5, "s"),),
    meaning=f"the vehicle shares its place with another one ({SAME_PLACE_SHARE:.0%} of the smaller box lie in the "
    "other), and the two do so for at least the threshold, all such frames together: one vehicle has two tracks. The "
    "entries of both break the rule where they share their place. Vehicles of unknown size are not compared",
    source=f"{DESIGN}; vehicles that stand in NGSIM twice: {COIFMAN}",
    breaks=lambda limits: (pl.col("double_track_s") > 0) & (pl.col("double_track_s") >= limits["duplicate_track_s"]),
    value=pl.col("double_track_s"),
    extreme="max",
    compared="as it is",
    case=Case({"x_m": (10.0, 11.1, 110.0, 111.3)}, breaks=(0, 1), frame_rate_hz=2.0),
)

size_change = pl.max_horizontal("length_range_m", "width_range_m")

SIZE_CHANGE = Rule(
    name="size_change",
    severity="warning",
    unit="m",
    thresholds=(Threshold("size_change_m", 0.1, "m"),),
    meaning="the recorded length or width of the vehicle varies by more than the threshold within its track; all its "
    "entries break the rule. Checked where the source has a size in every row of a track (highD); in NGSIM another "
    "size is another vehicle (`subsets.ids_split`)",
    source=f"{DESIGN}; vehicles are rigid, and sizes that differ within a track are known of exiD",
    breaks=lambda limits: size_change > recorded(limits["size_change_m"]),
    value=size_change,
    extreme="max",
    compared="as ingested, to 1 mm in single precision",
    case=Case({"length_range_m": (0.0, 0.1, 0.101, 0.0), "width_range_m": (0.0, 0.0, 0.0, 0.11)}, breaks=(2, 3)),
)

TRACKING_RULES = (TRACK_FRAGMENT, CROSS_SECTION_FLOW, DUPLICATE_TRACK, SIZE_CHANGE)
"""Rules about tracks as a whole and their identity, in the order of the report."""
