"""Vehicles and their drivers: the eight fixed kinds, and traffic in which no two drivers are alike.

The names of the traffic are what users choose; see docs/sample.md for what it measures.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from xml.sax.saxutils import quoteattr

import numpy as np

from tracklake.schemas.arrays import Floats

UNIFORM = "uniform"
"""Traffic of eight kinds of vehicles that follow IDM, change lanes in 4 s and meet waves every 40 s."""
VARIED = {"varied-idm": "IDM", "varied-krauss": "Krauss"}
"""SUMO's car-following model by the name of the traffic whose drivers differ."""
TRAFFICS = (UNIFORM, *VARIED)
"""Names of the traffic that can be simulated."""
DRAWN_OF_KIND = 25
"""Drivers drawn of each kind of vehicle; each vehicle has one of them."""
SPREAD = 0.25
"""Standard deviation of the logarithm of time gaps, distances and accelerations."""
MOST_SPREAD = 0.4
"""Limit of that logarithm, either way."""
SIZE_SPREAD = 0.03
"""Standard deviation of lengths and widths, as a share of the kind's."""
HURRY = {"IDM": 1.075, "Krauss": 1.005}
"""Desired speeds in varied traffic, as a share of those in uniform traffic, by model: with these the mean speed on free
roads is 28 m/s, as in highD."""
SPEED_SPREAD = 0.05
"""Standard deviation of a kind's desired speeds beside that of its vehicles, as a share of the speed limit."""
LANE_CHANGE_ZEAL = (1.0, 5.0)
"""Range of SUMO's lcSpeedGain."""
SIGMA, SIGMA_S = (0.15, 0.5), 1.0
"""Krauss's imperfection: its range among drivers, and the time for which a driver keeps one error, in s."""
TRUCK_SPEED_MPS = 0.7
"""Standard deviation of the greatest speeds of trucks, in m/s."""
WAVE_LEAST_PAUSE_S, WAVE_PAUSE_S, WAVE_SELDOM_PAUSE_S = 8.0, 25.0, 60.0
"""Least pause between waves, and the mean of what exceeds it where waves are frequent or seldom, in s."""
WAVE_S, WAVE_SHARE = (4.0, 12.0), (0.05, 0.5)
"""Ranges of a wave's duration at the bottleneck, in s, and of the speed in it, as a share of the bottleneck's."""


@dataclass(frozen=True)
class VehicleType:
    """A kind of vehicle.

    Args:
        v_class: NGSIM's class.
        weight: its share of the class.
        speed: desired speeds as shares of the speed limit: mean, standard deviation, least, greatest.
        driver: other attributes of SUMO's vType.
    """

    name: str
    v_class: int
    length_m: float
    width_m: float
    weight: float
    speed: tuple[float, float, float, float]
    driver: Mapping[str, float | str]

    def format_xml(self, probability: float) -> str:
        """Format SUMO's vType, which a vehicle has with this probability."""
        speed = ",".join(f"{value:g}" for value in self.speed)
        attributes = {
            "id": self.name, "length": self.length_m, "width": self.width_m, "probability": probability,
            "speedFactor": f"normc({speed})", **self.driver,
        }  # fmt: skip
        return f"<vType {' '.join(f'{name}={quoteattr(str(value))}' for name, value in attributes.items())}/>"


_DRIVER: dict[str, float | str] = {"carFollowModel": "IDM"}
_CAR = _DRIVER | {
    "vClass": "passenger", "accel": 1.6, "decel": 2.6, "minGap": 2, "lcSpeedGain": 8, "lcKeepRight": 1.5,
    "lcAssertive": 1.3,
}  # fmt: skip
_VAN = _DRIVER | {"vClass": "passenger", "accel": 1.2, "decel": 2.5, "minGap": 2.2, "lcSpeedGain": 5, "tau": 1.3}
_TRUCK = _DRIVER | {"vClass": "truck", "accel": 0.7, "decel": 2.2, "minGap": 2.6, "tau": 1.6, "maxSpeed": 24.6}
VEHICLE_TYPES = (
    VehicleType("hatchback", 2, 4.1, 1.7, 0.3, (0.95, 0.10, 0.7, 1.3), _CAR | {"tau": 1.0}),
    VehicleType("saloon", 2, 4.6, 1.8, 0.4, (1.0, 0.12, 0.7, 1.4), _CAR | {"tau": 1.1}),
    VehicleType("estate", 2, 5.0, 1.9, 0.18, (1.05, 0.12, 0.7, 1.4), _CAR | {"tau": 1.3}),
    VehicleType("van", 2, 6.0, 2.1, 0.1, (0.9, 0.08, 0.7, 1.2), _VAN),
    VehicleType("motorcycle", 1, 2.3, 0.8, 0.02, (1.0, 0.1, 0.7, 1.3), _CAR | {"tau": 1.2}),
    VehicleType("lorry", 3, 9.6, 2.5, 0.4, (0.9, 0.06, 0.7, 1.1), _TRUCK),
    VehicleType("articulated", 3, 16.5, 2.5, 0.5, (0.85, 0.04, 0.7, 1.0), _TRUCK),
    VehicleType("road_train", 3, 18.7, 2.5, 0.1, (0.82, 0.03, 0.7, 0.95), _TRUCK),
)


def draw_types(model: str, random: np.random.Generator) -> tuple[VehicleType, ...]:
    """Draw DRAWN_OF_KIND drivers of each kind of vehicle, who follow their leaders by one of SUMO's models."""
    return tuple(_draw_type(kind, number, model, random) for kind in VEHICLE_TYPES for number in range(DRAWN_OF_KIND))


def _draw_type(kind: VehicleType, number: int, model: str, random: np.random.Generator) -> VehicleType:
    factor = np.exp(np.clip(random.normal(0, SPREAD, 4), -MOST_SPREAD, MOST_SPREAD))
    length, width = np.round((kind.length_m, kind.width_m) * (1 + random.normal(0, SIZE_SPREAD, 2)), 1)
    mean, spread, least, most = kind.speed
    driver = dict(kind.driver) | {
        "carFollowModel": model,
        "lcSpeedGain": round(float(random.uniform(*LANE_CHANGE_ZEAL)), 3),
    }
    driver |= {
        name: round(float(kind.driver[name]) * by, 3)
        for name, by in zip(("tau", "accel", "decel", "minGap"), factor, strict=True)
    }
    if model == "Krauss":
        driver |= {"sigma": round(float(random.uniform(*SIGMA)), 3), "sigmaStep": SIGMA_S}
    if "maxSpeed" in driver:
        driver["maxSpeed"] = round(float(kind.driver["maxSpeed"]) + random.normal(0, TRUCK_SPEED_MPS), 2)
    faster = (HURRY[model] - 1) * mean + float(random.normal(0, SPEED_SPREAD))
    return replace(
        kind,
        name=f"{kind.name}_{number}",
        length_m=float(length),
        width_m=float(width),
        weight=kind.weight / DRAWN_OF_KIND,
        speed=(round(mean + faster, 4), spread, least + faster, most + faster),
        driver=driver,
    )


def draw_waves(seconds: float, pause_s: float, random: np.random.Generator) -> Floats:
    """Draw waves until some second: when each begins and ends, in s, and its speed's share of the usual, (W, 3)."""
    most = int(seconds / (WAVE_LEAST_PAUSE_S + WAVE_S[0])) + 1
    pause = WAVE_LEAST_PAUSE_S + random.exponential(pause_s, most)
    lasts = random.uniform(*WAVE_S, most)
    end = np.cumsum(pause + lasts)
    waves = np.stack([end - lasts, end, random.uniform(*WAVE_SHARE, most)], axis=1)
    return np.round(waves[end - lasts < seconds], 2)
