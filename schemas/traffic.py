"""Tables for traffic research, derived from tracks: car following, lane changes, safety, detectors, Edie's figures."""

import polars as pl

from tracklake.schemas.columns import PLACE, Table, column

BOUNDARIES = ("view", "lane_change", "cut_in", "leader_left", "renamed")
"""How an episode of car following begins or ends, the first that applies: one of the two tracks begins, ends or has a
gap there, so that the episode may go on unseen; the follower changes its lane; a vehicle cuts in and is the new leader;
the leader leaves the lane, or the view (cut-out); the source names another leader, none, or no lane, without any of
these."""
REGIMES = ("standing", "free_acceleration", "cruising", "accelerating", "following", "decelerating")
"""Driving regimes, of one entry each; docs/DESIGN.md defines them (Treiber and Kesting 2013; Sharma et al. 2018)."""
SAFETY_THRESHOLDS = {"ttc_s": 1.5, "drac_mps2": 3.35, "time_headway_s": 1.0, "pet_s": 1.0}
"""Surrogate measures of safety, and thresholds beyond which they are listed: time to collision, deceleration rate to
avoid a crash (m/s2, critical above), time headway, post-encroachment time (s, critical below)."""
MEASURES = tuple(SAFETY_THRESHOLDS)
"""Names of the surrogate measures of safety."""

CAR_FOLLOWING = Table(
    "car_following",
    "One row per episode: a vehicle behind one and the same leader in one lane, without a gap in either track.",
    key=("vehicle_id", "first_frame"),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "the follower", ge=0),
        "leader_id": column(pl.Int32, "the leader", ge=0),
        "lane": column(pl.Int16, "lane of both", ge=0),
        "first_frame": column(pl.Int32, "first entry of the episode"),
        "last_frame": column(pl.Int32, "last entry of the episode"),
        "entries": column(pl.Int32, "entries in the episode", ge=1),
        "seconds": column(pl.Float64, "from the first to the last entry", unit="s", ge=0),
        "begins_by": column(pl.String, "how the episode begins (docs/DESIGN.md)", isin=BOUNDARIES),
        "ends_by": column(pl.String, "how the episode ends", isin=BOUNDARIES),
        "cut_in": column(pl.Boolean, "it begins or ends by a vehicle that cuts in"),
        "cut_out": column(pl.Boolean, "it ends by the leader's leaving the lane, or begins by that of the one before"),
        **{
            f"{regime}_share": column(
                pl.Float64,
                f"share of the entries in the regime `{regime}`; null without accelerations",
                nullable=True,
                ge=0,
                le=1,
            )
            for regime in REGIMES
        },
        "mean_speed_mps": column(pl.Float64, "mean speed of the follower, to 1e-6", unit="m/s"),
        "mean_gap_m": column(
            pl.Float64, "mean bumper-to-bumper gap; null where the leader's length is unknown", unit="m", nullable=True
        ),
        "least_gap_m": column(pl.Float64, "least bumper-to-bumper gap; negative = overlap", unit="m", nullable=True),
        "least_ttc_s": column(
            pl.Float64, "least time to collision; null where the gap never closes", unit="s", nullable=True, ge=0
        ),
    },
)

LANE_CHANGE_EVENTS = Table(
    "lane_change_events",
    "One row per lane change: when the lateral motion begins and ends, and the vehicles around it.",
    key=("vehicle_id", "crossing_frame"),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "who changes its lane", ge=0),
        "crossing_frame": column(pl.Int32, "first entry in the new lane"),
        "first_frame": column(pl.Int32, "first entry of the lateral motion; the crossing where that is a slow drift"),
        "last_frame": column(pl.Int32, "last entry of the lateral motion; the crossing where that is a slow drift"),
        "seconds": column(pl.Float64, "from the first to the last entry", unit="s", ge=0),
        "begin_seen": column(pl.Boolean, "the lateral motion begins within the track; False for slow drifts"),
        "end_seen": column(pl.Boolean, "the lateral motion ends within the track; False for slow drifts"),
        "from_lane": column(pl.Int16, "lane before", ge=0),
        "to_lane": column(pl.Int16, "lane after", ge=0),
        "direction": column(pl.String, "left or right, as the driver sees it", isin=("left", "right")),
        "lateral_move_m": column(pl.Float64, "change of y_m from the first to the last entry", unit="m"),
        "greatest_lateral_speed_mps": column(pl.Float64, "greatest lateral speed in the motion", unit="m/s", ge=0),
        "speed_mps": column(pl.Float64, "speed at the crossing", unit="m/s"),
        **{
            name: column(pl.Int32, meaning, nullable=True, ge=0)
            for name, meaning in (
                ("old_leader_id", "leader in the old lane, at the last entry in it; null = none"),
                ("old_follower_id", "follower in the old lane, at the last entry in it; null = none"),
                ("new_leader_id", "leader in the new lane, at the crossing; null = none"),
                ("new_follower_id", "follower in the new lane, at the crossing; null = none"),
            )
        },
        "lead_gap_m": column(
            pl.Float64, "gap to the new leader at the crossing; null = no leader", unit="m", nullable=True
        ),
        "lag_gap_m": column(
            pl.Float64, "gap from the new follower at the crossing; null = no follower", unit="m", nullable=True
        ),
    },
)

SAFETY = Table(
    "safety",
    "One row per follower, leader, measure and run of consecutive frames beyond the measure's threshold.",
    key=("vehicle_id", "leader_id", "measure", "first_frame"),
    columns={
        **PLACE,
        "vehicle_id": column(pl.Int32, "the follower, or who comes second", ge=0),
        "leader_id": column(pl.Int32, "the leader, or who was there first", ge=0),
        "measure": column(pl.String, "the surrogate measure's name, with its unit", isin=MEASURES),
        "threshold": column(pl.Float64, "beyond which an entry counts, in the measure's unit"),
        "first_frame": column(pl.Int32, "first entry of the run"),
        "last_frame": column(pl.Int32, "last entry of the run"),
        "entries": column(pl.Int32, "entries in the run", ge=1),
        "seconds": column(pl.Float64, "exposure: entries / frame rate", unit="s", ge=0),
        "worst": column(pl.Float64, "the most critical value in the run, in the measure's unit"),
    },
)

VIRTUAL_DETECTORS = Table(
    "virtual_detectors",
    "One row per cross section, lane and interval of time: what a loop detector would have counted there.",
    key=("detector_m", "lane", "interval_s"),
    columns={
        **PLACE,
        "detector_m": column(pl.Float64, "x_m of the cross section", unit="m"),
        "lane": column(pl.Int16, "lane", ge=0),
        "interval_s": column(pl.Float64, "beginning of the interval, since the recording's first frame", unit="s"),
        "seconds": column(pl.Float64, "recorded length of the interval", unit="s", gt=0),
        "vehicles": column(pl.Int32, "fronts that crossed", ge=0),
        "flow_vph": column(pl.Float64, "vehicles / seconds", unit="veh/h", ge=0),
        "time_mean_speed_mps": column(
            pl.Float64,
            "arithmetic mean of the crossing speeds; null where no vehicle crossed",
            unit="m/s",
            nullable=True,
        ),
        "space_mean_speed_mps": column(
            pl.Float64, "harmonic mean of the crossing speeds; null where no vehicle crossed", unit="m/s", nullable=True
        ),
        "occupancy": column(
            pl.Float64,
            "share of the time for which a vehicle is above the cross section; null where lengths are unknown",
            nullable=True,
            ge=0,
            le=1,
        ),
    },
)

EDIE = Table(
    "edie",
    "One row per cell of road and time, and lane: flow, density and speed by Edie's definition (1963).",
    key=("from_m", "lane", "from_s"),
    columns={
        **PLACE,
        "from_m": column(pl.Float64, "beginning of the cell along the road", unit="m"),
        "lane": column(pl.Int16, "lane", ge=0),
        "from_s": column(pl.Float64, "beginning of the cell in time", unit="s"),
        "length_m": column(pl.Float64, "length of the cell along the road, as far as it was recorded", unit="m", gt=0),
        "seconds": column(pl.Float64, "length of the cell in time, as far as it was recorded", unit="s", gt=0),
        "vehicles": column(pl.Int32, "vehicles with any time in the cell", ge=0),
        "distance_m": column(pl.Float64, "distance driven in the cell", unit="m"),
        "time_s": column(pl.Float64, "time spent in the cell", unit="s", ge=0),
        "flow_vph": column(pl.Float64, "distance / (length * seconds)", unit="veh/h"),
        "density_vpkm": column(pl.Float64, "time / (length * seconds)", unit="veh/km", ge=0),
        "speed_mps": column(pl.Float64, "distance / time; null where no time was spent", unit="m/s", nullable=True),
    },
)

SKIPPED = {
    "arterial": "entries of arterials, which these tables leave out",
    "one_entry": "vehicles with one entry, which have no motion",
    "frame_gap": "pairs of successive entries of a vehicle with frames missing between them",
    "no_lane": "entries without a lane",
    "no_leader_known": "entries of a source that names no leaders",
    "leader_absent": "entries whose leader has no entry at that frame",
    "leader_in_other_lane": "entries whose leader, as recorded, is in another lane",
    "no_gap": "entries whose leader's length is unknown",
    "short_episode": "episodes shorter than the setting `car_following_min_s`",
    "lane_flicker": "stays of at most 2 s in a lane between two in the same other lane",
    "lane_change_in_gap": "pairs of successive entries in different lanes with frames missing between them",
    "no_extent": "entries of a subset whose section or recording has no length",
}
"""Reasons why something has no row in a derived table, and what is counted then."""
DERIVED_TABLES = (CAR_FOLLOWING, LANE_CHANGE_EVENTS, SAFETY, VIRTUAL_DETECTORS, EDIE)

TRAFFIC_SKIPS = Table(
    "traffic_skips",
    "One row per derived table and reason: what has no row in the table.",
    key=("derived_table", "reason"),
    columns={
        **PLACE,
        "derived_table": column(
            pl.String, "the table that lacks it", isin=tuple(table.name for table in DERIVED_TABLES)
        ),
        "reason": column(pl.String, "why", isin=tuple(SKIPPED)),
        "counted": column(pl.String, "what is counted", isin=tuple(SKIPPED.values())),
        "number": column(pl.Int64, "how many", ge=1),
    },
)
