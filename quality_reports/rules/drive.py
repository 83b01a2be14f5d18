"""Rules for drives: the messages of each station, and the vehicles around the ego at each tick."""

import polars as pl

from tracklake.quality_reports.rules.along_messages import (
    BASELINE_S,
    LOSS_WINDOW_S,
    MAX_ACCEL_MPS2,
    MAX_AGE_S,
)
from tracklake.quality_reports.rules.rule import Case, Rule, Threshold
from tracklake.schemas.references import CHOI

J2735 = "SAE J2735: ten basic safety messages per second"
OURS = "the limit is ours"

MESSAGE_LOSS = Rule(
    name="message_loss",
    severity="warning",
    unit="of 1",
    thresholds=(Threshold("message_loss_share", 0.3, "of 1", greatest=1.0),),
    meaning=f"of the messages that its sender sent in the {LOSS_WINDOW_S:g} s that end with it, a larger share than "
    "the threshold is lost: `lost_before` of these messages / (the same + their number)",
    source=f"{J2735}; {OURS}",
    breaks=lambda limits: pl.col("loss_share") > limits["message_loss_share"],
    value=pl.col("loss_share"),
    extreme="max",
    compared="in double precision",
    case=Case(
        # Of 7, 8, 9 and 10 sent messages 3 are lost, of 12 then 4; the window of the last message holds it alone.
        {"time_s": (0.0, 0.1, 0.2, 0.6, 0.7, 0.8, 0.9, 1.1, 11.1), "lost_before": (0, 0, 0, 3, 0, 0, 0, 1, 0)},
        breaks=(3, 4, 5, 7),
    ),
    over="messages",
)

MESSAGE_LATENCY = Rule(
    name="message_latency",
    severity="warning",
    unit="s",
    thresholds=(Threshold("message_latency_s", 0.1, "s"),),
    meaning="it was received later than the threshold after it was generated: at 10 Hz the next one is due by then. "
    "Messages without the moment of reception are not checked",
    source=f"{J2735}; {CHOI.name}: data at 10 Hz; {OURS}",
    breaks=lambda limits: pl.col("latency_s") > limits["message_latency_s"],
    value=pl.col("latency_s"),
    extreme="max",
    compared="rounded to 1 μs",
    case=Case({"time_s": (1.0, 1.1, 1.2), "received_s": (1.1, 1.201, None)}, breaks=(1,)),
    over="messages",
)

STALE_CLOCK = Rule(
    name="stale_clock",
    severity="error",
    unit="s",
    thresholds=(Threshold("stale_clock_s", 0.5, "s"),),
    meaning="the sender's clock jumped by more than the threshold before it, or it was received more than the "
    "threshold before the moment at which the sender says it was generated",
    source=OURS,
    breaks=lambda limits: pl.col("clock_error_s") > limits["stale_clock_s"],
    value=pl.col("clock_error_s"),
    extreme="max",
    compared="rounded to 1 μs",
    case=Case(
        {
            "time_s": (1.0, 1.1, 1.2, 2.0, 2.1),
            "received_s": (1.05, 1.15, 1.25, 1.5, 1.5),
            "clock_step_s": (None, 0.5, -0.75, None, None),
        },
        breaks=(2, 4),  # a step of -0.75 s; then received 0.6 s before it was generated
    ),
    over="messages",
)

MESSAGE_JUMP = Rule(
    name="message_jump",
    severity="error",
    unit="m",
    thresholds=(Threshold("message_jump_m", 10.0, "m"),),
    meaning="the way since the sender's message before differs by more than the threshold from what is possible: the "
    f"mean of the two speeds times the time between them, give or take {MAX_ACCEL_MPS2:g} m/s² times the time squared "
    "/ 4, which is what changes of speed between the two can add",
    source=f"{OURS}: more than the noise of a plain GNSS receiver",
    breaks=lambda limits: pl.col("jump_excess_m") > limits["message_jump_m"],
    value=pl.col("jump_excess_m"),
    extreme="max",
    compared="rounded to 1 mm",
    case=Case(
        # Eastwards on the equator, where 0.001 degrees are 111.319 m: expected 100 m in 5 s, give or take 50 m.
        {
            "vehicle_id": (1, 1, 2, 2),
            "time_s": (0.0, 5.0, 0.0, 5.0),
            "lon_deg": (0.0, 0.001437, 0.0, 0.001438),  # 159.97 m and 160.08 m
            "speed_mps": (20.0,) * 4,
        },
        breaks=(3,),
    ),
    over="messages",
)

HEADING_MISMATCH = Rule(
    name="heading_mismatch",
    severity="warning",
    unit="deg",
    thresholds=(
        Threshold("heading_mismatch_deg", 15.0, "deg", greatest=180.0),
        Threshold("heading_mismatch_mps", 5.0, "m/s"),
    ),
    meaning="its heading and the direction in which the sender moved differ by more than the first threshold while it "
    f"moved faster than the second one. The direction is that from the sender's last position at least {BASELINE_S:g} "
    "s before; it is compared with the mean of the headings at both ends, which on a bend it equals",
    source=f"{CHOI.name}: relative positions need the heading; {OURS}",
    breaks=lambda limits: (
        (pl.col("heading_error_deg") > limits["heading_mismatch_deg"])
        & (pl.col("motion_mps") > limits["heading_mismatch_mps"])
    ),
    value=pl.col("heading_error_deg"),
    extreme="max",
    compared="rounded to 0.001 degrees",
    case=Case(
        # All go east on the equator: vehicle 3 is slow, 4 turns from 60 to 120 degrees, 5 has moved for 1 s only.
        {
            "vehicle_id": (1, 1, 2, 2, 3, 3, 4, 4, 5, 5),
            "time_s": (0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0, 2.0, 0.0, 1.0),
            "lon_deg": (0.0, 0.001, 0.0, 0.001, 0.0, 0.00008, 0.0, 0.001, 0.0, 0.001),
            "heading_deg": (105.0, 105.0, 106.0, 106.0, 180.0, 180.0, 60.0, 120.0, 180.0, 180.0),
        },
        breaks=(3,),
    ),
    over="messages",
)

BOX_MISMATCH = Rule(
    name="box_mismatch",
    severity="warning",
    unit="m",
    thresholds=(Threshold("box_mismatch_m", 5.0, "m"),),
    meaning="the centre of the vehicle's box, which LiDAR saw at the tick, lies farther than the threshold from where "
    "its last message alone puts it. A message is carried forward with its speed and heading, for at most "
    f"{MAX_AGE_S:g} s; vehicles without messages and ticks without LiDAR are not checked",
    source=f"{OURS}: the length of a car",
    breaks=lambda limits: pl.col("box_distance_m") > limits["box_mismatch_m"],
    value=pl.col("box_distance_m"),
    extreme="max",
    compared="rounded to 1 mm",
    case=Case(
        {
            "box_x_m": (23.0, 23.0, 23.0, 23.0),
            "box_y_m": (0.0, 0.0, 0.0, 0.0),
            "message_x_m": (20.0, 20.0, 20.0, None),
            "message_y_m": (4.0, -4.1, -4.1, None),
            "from_lidar": (True, True, False, True),
        },
        breaks=(1,),  # 3 m ahead and 4 m across are 5 m
    ),
    over="ticks",
)

DRIVE_RULES = (MESSAGE_LOSS, MESSAGE_LATENCY, STALE_CLOCK, MESSAGE_JUMP, HEADING_MISMATCH, BOX_MISMATCH)
"""Rules for drives, in the order of the report."""
