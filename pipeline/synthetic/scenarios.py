"""Scenarios of the sample as data: roads, traffic and the number of defects of each kind."""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from tracklake.pipeline.synthetic.drivers import UNIFORM

DRIVES = "drives"
"""Format of instrumented vehicles: a folder of logs each."""
TGSIM = "tgsim"
"""Format of TGSIM's freeway sites."""
I24 = "i24"
"""Format of I-24 MOTION."""
LEVELX = ("exid", "ind", "round")
"""Formats of levelXdata's recordings on roads that are not straight."""
FORMATS = ("highd", "ngsim-text", "ngsim-csv", "socrata", DRIVES, *LEVELX, TGSIM, I24)
"""Raw formats that the generator writes."""
DEFAULT_FORMATS = ("highd", "ngsim-text", "socrata", DRIVES)
"""Formats of a sample, unless set."""
LEAST_MINUTES = 0.1
MOST_MINUTES = 15.0
"""Longest unit of the recordings' length, in minutes; the NGSIM-like recordings begin 15 minutes apart."""


@dataclass(frozen=True)
class Road:
    """A straight carriageway; x runs in the direction of travel from the recorded window's entrance.

    Args:
        rate_hz: frames per second, which is also the simulation's clock.
        ramp: an on-ramp joins: its lane (main lanes + 2) ends in an auxiliary lane (main lanes + 1).
    """

    lanes: int
    lane_width_m: float
    window_m: float
    rate_hz: float
    limit_mps: float
    ramp: bool = False


@dataclass(frozen=True)
class Plan:
    """The number of vehicles of a subset with each defect; fewer if the recording is too short.

    Args:
        late_starts: vehicles that lose the first part of their track.
        overlaps: vehicles shifted into their leader for a while.
        backward_share: greatest share of the vehicles that drive backwards for a while.
        spikes: vehicles with some recorded accelerations beyond 3.05 m/s2.
        frozen: vehicles with some recorded slow speeds of exactly no acceleration.
        gaps: vehicles that lose frames in the middle of their track.
        jumps: vehicles located too far ahead for some frames.
        wrong_leaders: vehicles whose leader's leader is recorded as theirs for a while.
        wrong_headways: vehicles whose recorded headway is wrong for a while.
        lane_flickers: vehicles recorded in the lane beside theirs for less than two seconds.
        hard_brakings: vehicles with some recorded decelerations beyond 8 m/s2.
        sideways_speeds: vehicles that seem to slide for one frame; NGSIM's formats have no lateral speeds.
        size_changes: vehicles recorded longer for a while; in NGSIM's formats they would be two vehicles.
        early_ends: vehicles that lose the last part of their track.
        second_tracks: vehicles whose first seconds stand in the file a second time under another id.
        lost_leader: one overlap is with a leader that misses frames, in formats that record its headway.
    """

    late_starts: int = 3
    overlaps: int = 2
    backward_share: float = 0.0
    spikes: int = 3
    frozen: int = 2
    gaps: int = 2
    jumps: int = 0
    wrong_leaders: int = 0
    wrong_headways: int = 0
    lane_flickers: int = 0
    hard_brakings: int = 0
    sideways_speeds: int = 0
    size_changes: int = 0
    early_ends: int = 0
    second_tracks: int = 0
    lost_leader: bool = True


class Dose(NamedTuple):
    """The one defect of a sample, a name from DOSED, and the share of each subset's vehicles that are to have it."""

    defect: str
    share: float


DOSED = {
    "late_start": "late_starts", "overlap": "overlaps", "backward": "backward_share", "acceleration_spike": "spikes",
    "frozen_slow_speed": "frozen", "frame_gap": "gaps", "position_jump": "jumps", "wrong_leader": "wrong_leaders",
    "wrong_headway": "wrong_headways", "lane_flicker": "lane_flickers", "hard_braking": "hard_brakings",
    "sideways_speed": "sideways_speeds", "size_change": "size_changes", "early_end": "early_ends",
    "second_track": "second_tracks",
}  # fmt: skip
"""Field of a plan by the name of the defect, as the truth has it."""
HIGHD_ONLY = ("sideways_speed", "size_change")
"""Defects that NGSIM's formats cannot record: they have no lateral speeds, and another size is another vehicle."""
CLEAN = Plan(late_starts=0, overlaps=0, spikes=0, frozen=0, gaps=0, lost_leader=False)
"""No defects at all."""


def plan_dose(dose: Dose, vehicles: int) -> Plan:
    """Plan a dose among so many vehicles; a larger dose is planned for the same vehicles and more."""
    wanted = round(dose.share * vehicles)
    if dose.defect == "backward":
        # `inject_defects` rounds this share of the vehicles down.
        return replace(CLEAN, backward_share=(wanted + 0.5) / max(1, vehicles))
    counts: dict[str, Any] = {DOSED[dose.defect]: wanted}
    return replace(CLEAN, **counts)


@dataclass(frozen=True)
class Traffic:
    """The traffic of a carriageway.

    Args:
        arrivals: vehicles per main lane and second.
        bottleneck_mps: speed in the zone behind the window that holds the traffic up; None = free flow.
        pulsing: for 15 of every 40 s that zone admits hardly any vehicles, which causes waves of standing traffic.
        ramp_arrivals: vehicles per second on the on-ramp, where there is one.
        drivers: one of TRAFFICS; in varied traffic every bottleneck causes waves, at random times.
    """

    arrivals: float
    trucks: float = 0.15
    bottleneck_mps: float | None = None
    pulsing: bool = False
    ramp_arrivals: float = 0.0
    plan: Plan = field(default_factory=Plan)
    drivers: str = UNIFORM

    @property
    def warm_up_s(self) -> float:
        """Simulated before frame 1: long enough for the queue to reach the window, or the first vehicles its end."""
        return 60.0 if self.bottleneck_mps is None else 200.0


@dataclass(frozen=True)
class HighdScenario:
    """One recording over two carriageways.

    Args:
        exponent: write the duration as a careless printf would (`5.400000e+01`), as some published files do.
        damaged: insert duplicates and malformed lines into the tracks file.
    """

    recording: str
    location_id: int
    road: Road
    share: float
    month: str
    start_time: str
    upper: Traffic
    lower: Traffic
    exponent: bool = False
    damaged: bool = False


@dataclass(frozen=True)
class NgsimScenario:
    """One recording of the freeway from `start_time` (`HH:MM`) on 2005-06-15, which lasts `share` * minutes."""

    start_time: str
    first_vehicle_id: int
    share: float
    traffic: Traffic


@dataclass(frozen=True)
class Job:
    """One subset: its file, and the carriageway to simulate; `index` is part of its random seed."""

    dataset: str
    recording: str
    subset: str
    file: str
    index: int
    road: Road
    traffic: Traffic
    frames: int


TWO_LANES = Road(lanes=2, lane_width_m=3.75, window_m=420.0, rate_hz=25.0, limit_mps=34.0)
THREE_LANES = Road(lanes=3, lane_width_m=3.75, window_m=420.0, rate_hz=25.0, limit_mps=34.0)
FREEWAY = Road(lanes=5, lane_width_m=3.6576, window_m=640.0, rate_hz=10.0, limit_mps=27.0, ramp=True)

RAMP_VISIBLE_M = 60.0
WEAVE_BEGINS_M = 180.0
WEAVE_ENDS_M = 430.0
"""Positions at which the on-ramp comes into view, becomes the auxiliary lane, and ends, in m."""
_MISREAD = Plan(jumps=1, wrong_leaders=1, wrong_headways=2, lane_flickers=2)
_MISTRACKED = Plan(hard_brakings=1, sideways_speeds=2, size_changes=1, early_ends=2, second_tracks=1)

HIGHD = (
    HighdScenario(
        "01", 1, TWO_LANES, 1.9, "09.2017", "08:38",
        Traffic(0.25, plan=_MISREAD), Traffic(0.36, trucks=0.2, plan=_MISREAD),
    ),
    HighdScenario(
        "02", 2, THREE_LANES, 1.1, "10.2017", "11:10",
        Traffic(0.30, plan=_MISTRACKED),
        Traffic(0.42, trucks=0.12, bottleneck_mps=11.0, plan=Plan(backward_share=0.01)),
        exponent=True, damaged=True,
    ),
    HighdScenario(
        "03", 1, TWO_LANES, 0.5, "09.2017", "16:52",
        Traffic(0.40, bottleneck_mps=2.5, pulsing=True, plan=Plan(backward_share=0.12)),
        Traffic(0.30),
    ),
    HighdScenario("04", 2, THREE_LANES, 0.35, "11.2017", "15:25", Traffic(0.22), Traffic(0.32), damaged=True),
)  # fmt: skip

_NGSIM_PLAN = Plan(
    late_starts=4, overlaps=3, backward_share=0.01, spikes=5, frozen=4, gaps=4, jumps=2, wrong_leaders=2,
    wrong_headways=2, lane_flickers=2, hard_brakings=1, early_ends=2, second_tracks=1,
)  # fmt: skip
_MORNING = Traffic(0.30, trucks=0.1, bottleneck_mps=9.0, ramp_arrivals=0.12, plan=_NGSIM_PLAN)
_QUEUE = Traffic(0.32, trucks=0.12, bottleneck_mps=5.0, pulsing=True, ramp_arrivals=0.10, plan=_NGSIM_PLAN)
_LATER = Traffic(0.30, trucks=0.1, ramp_arrivals=0.15, plan=_NGSIM_PLAN)

NGSIM_TEXT = (NgsimScenario("09:30", 1, 1.0, _MORNING),)
NGSIM_SOCRATA = (NgsimScenario("09:45", 1, 0.8, _QUEUE), NgsimScenario("10:00", 951, 0.52, _LATER))
NGSIM_CSV = (NgsimScenario("10:15", 1, 0.6, _LATER),)
"""Recordings by format; the published ones of that day begin at 07:50, 08:05 and 08:20."""
