"""Simulation by SUMO: its roads and demand, its runs as subprocesses, and their tracks.

The binaries come with the wheel `eclipse-sumo`. They are run as programs: their libraries clash with Arrow's when
loaded into this process.
"""

import os
import subprocess
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.scenarios import RAMP_VISIBLE_M, WEAVE_BEGINS_M, WEAVE_ENDS_M, Road, Traffic
from tracklake.schemas.errors import TracklakeError

APPROACH_M = 500.0
MARGIN_M = 40.0
"""Length recorded before and behind the window, in m, so that its ends are away from junctions."""
BEYOND_M = 160.0
BOTTLENECK_M = 300.0
RAMP_M = 300.0
LANE_CHANGE_S = 4.0
PULSE_EVERY_S, PULSE_S, PULSE_MPS = 40.0, 15.0, 0.2
SUMO_LANE_M = 3.2
"""Width of SUMO's own lanes, in which posLat is measured, whatever the recorded road is given, in m."""
MERGE_M = 80.0
"""Length over which the on-ramp's lane approaches the auxiliary lane, in m."""


@dataclass(frozen=True)
class VehicleType:
    """A kind of vehicle: NGSIM's class, size, weight among its class, and attributes of SUMO's vType (driver model)."""

    name: str
    v_class: int
    length_m: float
    width_m: float
    weight: float
    model: str


_CAR = 'vClass="passenger" accel="1.6" decel="2.6" minGap="2" lcSpeedGain="8" lcKeepRight="1.5" lcAssertive="1.3"'
_VAN = 'vClass="passenger" accel="1.2" decel="2.5" minGap="2.2" lcSpeedGain="5"'
_TRUCK = 'vClass="truck" accel="0.7" decel="2.2" minGap="2.6" tau="1.6" maxSpeed="24.6"'
VEHICLE_TYPES = (
    VehicleType("hatchback", 2, 4.1, 1.7, 0.3, f'{_CAR} tau="1.0" speedFactor="normc(0.95,0.10,0.7,1.3)"'),
    VehicleType("saloon", 2, 4.6, 1.8, 0.4, f'{_CAR} tau="1.1" speedFactor="normc(1.0,0.12,0.7,1.4)"'),
    VehicleType("estate", 2, 5.0, 1.9, 0.18, f'{_CAR} tau="1.3" speedFactor="normc(1.05,0.12,0.7,1.4)"'),
    VehicleType("van", 2, 6.0, 2.1, 0.1, f'{_VAN} tau="1.3" speedFactor="normc(0.9,0.08,0.7,1.2)"'),
    VehicleType("motorcycle", 1, 2.3, 0.8, 0.02, f'{_CAR} tau="1.2" speedFactor="normc(1.0,0.1,0.7,1.3)"'),
    VehicleType("lorry", 3, 9.6, 2.5, 0.4, f'{_TRUCK} speedFactor="normc(0.9,0.06,0.7,1.1)"'),
    VehicleType("articulated", 3, 16.5, 2.5, 0.5, f'{_TRUCK} speedFactor="normc(0.85,0.04,0.7,1.0)"'),
    VehicleType("road_train", 3, 18.7, 2.5, 0.1, f'{_TRUCK} speedFactor="normc(0.82,0.03,0.7,0.95)"'),
)

TRACK_SCHEMA = {
    "vehicle": pl.Int32(),
    "frame": pl.Int32(),
    "x": pl.Float64(),
    "y": pl.Float64(),
    "speed": pl.Float64(),
    "accel": pl.Float64(),
    "lateral_speed": pl.Float64(),
    "lane": pl.Int16(),
    "v_class": pl.Int8(),
    "length": pl.Float64(),
    "width": pl.Float64(),
}
"""Tracks inside the generator: x_m of the front from the window's entrance along the direction of travel, y_m from
the left edge to the right, m/s and m/s2 along the direction of travel, lane 1 leftmost; sorted by vehicle, frame."""


_RUNNING: set["subprocess.Popen[str]"] = set()
"""SUMO's programs that run now, in threads of this process."""


class SumoError(TracklakeError):
    """SUMO is not installed, or a run of it failed."""


def find_sumo() -> Path:
    """Find the folder that holds SUMO's binaries; without one a SumoError says what to install."""
    spec = find_spec("sumo")
    for place in (spec.submodule_search_locations or []) if spec else []:
        if (Path(place) / "bin" / "sumo").exists() or (Path(place) / "bin" / "sumo.exe").exists():
            return Path(place)
    raise SumoError('the sample generator drives SUMO, which is not installed: pip install "tracklake[sample]"')


def _call(home: Path, program: str, arguments: list[str]) -> None:
    environment = {**os.environ, "SUMO_HOME": str(home)}
    call = [str(home / "bin" / program), *arguments]
    with subprocess.Popen(
        call, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        _RUNNING.add(process)
        try:
            _, errors = process.communicate()
        finally:
            _RUNNING.discard(process)
    if process.returncode:
        tail = "\n".join(errors.strip().splitlines()[-5:])
        end = f"with exit code {process.returncode}" if process.returncode > 0 else f"by signal {-process.returncode}"
        raise SumoError(f"{program} ended {end}; its last lines: {tail or 'none'}")


def stop_programs() -> None:
    """Kill the programs that run now; their calls raise SumoError."""
    for process in tuple(_RUNNING):
        process.kill()


def _edges(road: Road, traffic: Traffic) -> list[tuple[str, float, float, int, float]]:
    """List the stretches of road: name, from x, to x, lanes, speed limit."""
    slow = road.limit_mps if traffic.bottleneck_mps is None else traffic.bottleneck_mps
    end = road.window_m + MARGIN_M
    if road.ramp:
        inner = [
            ("before", -MARGIN_M, WEAVE_BEGINS_M, road.lanes),
            ("weave", WEAVE_BEGINS_M, WEAVE_ENDS_M, road.lanes + 1),
            ("after", WEAVE_ENDS_M, end, road.lanes),
        ]
    else:
        inner = [("window", -MARGIN_M, end, road.lanes)]
    return [
        ("approach", -APPROACH_M, -MARGIN_M, road.lanes, road.limit_mps),
        *((name, begin, stop, lanes, road.limit_mps) for name, begin, stop, lanes in inner),
        ("beyond", end, end + BEYOND_M, road.lanes, road.limit_mps),
        ("bottleneck", end + BEYOND_M, end + BEYOND_M + BOTTLENECK_M, road.lanes, slow),
    ]


def write_network(home: Path, folder: Path, road: Road, traffic: Traffic) -> None:
    """Write nodes and edges as plain XML and have netconvert join them to `net.xml`."""
    edges = _edges(road, traffic)
    nodes = [f'<node id="n{i}" x="{begin}" y="0"/>' for i, (_, begin, _, _, _) in enumerate(edges)]
    nodes.append(f'<node id="n{len(edges)}" x="{edges[-1][2]}" y="0"/>')
    lines = [
        f'<edge id="{name}" from="n{i}" to="n{i + 1}" numLanes="{lanes}" speed="{limit}" length="{stop - begin}"/>'
        for i, (name, begin, stop, lanes, limit) in enumerate(edges)
    ]
    connections = []
    if road.ramp:
        nodes.append(f'<node id="ramp_top" x="{WEAVE_BEGINS_M - RAMP_M}" y="-60"/>')
        joint = next(i for i, edge in enumerate(edges) if edge[0] == "weave")
        lines.append(
            f'<edge id="ramp" from="ramp_top" to="n{joint}" numLanes="1" speed="{road.limit_mps * 0.8}" '
            f'length="{RAMP_M}"/>'
        )
        connections = ['<connection from="ramp" to="weave" fromLane="0" toLane="0"/>']
        for lane in range(road.lanes):
            connections.append(f'<connection from="before" to="weave" fromLane="{lane}" toLane="{lane + 1}"/>')
            connections.append(f'<connection from="weave" to="after" fromLane="{lane + 1}" toLane="{lane}"/>')
    for tag, content in (("nodes", nodes), ("edges", lines), ("connections", connections)):
        (folder / f"{tag}.xml").write_text(f"<{tag}>\n" + "\n".join(content) + f"\n</{tag}>\n", encoding="utf-8")
    arguments = ["-n", str(folder / "nodes.xml"), "-e", str(folder / "edges.xml"), "-o", str(folder / "net.xml")]
    if connections:
        arguments += ["-x", str(folder / "connections.xml")]
    _call(home, "netconvert", [*arguments, "--no-internal-links", "--no-turnarounds"])


def write_demand(folder: Path, road: Road, traffic: Traffic, seconds: float) -> None:
    """Write vehicle types and Poisson arrivals to `routes.xml`, the bottleneck's pulses to `signs.xml`."""
    types = []
    for kind in VEHICLE_TYPES:
        of_class = traffic.trucks if kind.v_class == 3 else 1 - traffic.trucks
        types.append(
            f'<vType id={quoteattr(kind.name)} carFollowModel="IDM" length="{kind.length_m}" width="{kind.width_m}" '
            f'probability="{of_class * kind.weight}" {kind.model}/>'
        )
    flow = 'type="mix" begin="0" end="{end}" departLane="random" departSpeed="{speed}"'.format(
        end=seconds, speed="desired" if traffic.bottleneck_mps is None else "avg"
    )
    flows = [f'<flow id="main" {flow} from="approach" to="bottleneck" period="exp({traffic.arrivals * road.lanes})"/>']
    if road.ramp:
        flows.append(f'<flow id="ramp" {flow} from="ramp" to="bottleneck" period="exp({traffic.ramp_arrivals})"/>')
    text = "\n".join(["<routes>", '<vTypeDistribution id="mix">', *types, "</vTypeDistribution>", *flows, "</routes>"])
    (folder / "routes.xml").write_text(text + "\n", encoding="utf-8")
    signs = []
    if traffic.pulsing and traffic.bottleneck_mps is not None:
        lanes = " ".join(f"bottleneck_{lane}" for lane in range(road.lanes))
        starts = np.arange(0, seconds, PULSE_EVERY_S)
        signs = [
            f'<variableSpeedSign id="sign" lanes="{lanes}">',
            *(
                f'<step time="{start + wait}" speed="{speed}"/>'
                for start in starts
                for wait, speed in ((0, traffic.bottleneck_mps), (PULSE_EVERY_S - PULSE_S, PULSE_MPS))
            ),
            "</variableSpeedSign>",
        ]
    text = "\n".join(["<additional>", *signs, "</additional>"])
    (folder / "signs.xml").write_text(text + "\n", encoding="utf-8")


def simulate(home: Path, folder: Path, road: Road, traffic: Traffic, *, frames: int, seed: int) -> pl.DataFrame:
    """Simulate frames of one carriageway, with SUMO's files in an empty folder; return the tracks in its window.

    Returns TRACK_SCHEMA; vehicles count from 1 in order of (first frame, foremost first).
    """
    write_network(home, folder, road, traffic)
    seconds = traffic.warm_up_s + frames / road.rate_hz
    write_demand(folder, road, traffic, seconds)
    recorded = ["before", "weave", "after", "ramp"] if road.ramp else ["window"]
    (folder / "recorded.txt").write_text("".join(f"edge:{name}\n" for name in recorded), encoding="utf-8")
    _call(
        home,
        "sumo",
        [
            *("-n", str(folder / "net.xml"), "-r", str(folder / "routes.xml"), "-a", str(folder / "signs.xml")),
            *("--seed", str(seed)),
            *("--step-length", str(1 / road.rate_hz), "--end", str(seconds), "--precision", "5"),
            *("--lanechange.duration", str(LANE_CHANGE_S), "--time-to-teleport", "-1", "--no-step-log"),
            *("--fcd-output", str(folder / "fcd.csv"), "--device.fcd.begin", str(traffic.warm_up_s)),
            *("--fcd-output.filter-edges.input-file", str(folder / "recorded.txt"), "--fcd-output.acceleration"),
            *("--fcd-output.attributes", "id,type,lane,pos,posLat,speed,speedLat,acceleration"),
        ],
    )
    return read_tracks(folder / "fcd.csv", road, traffic)


def read_tracks(path: Path, road: Road, traffic: Traffic) -> pl.DataFrame:
    """Turn SUMO's floating car data (lane names and positions on them) into tracks in the window's own frame.

    SUMO moves a lane changer sideways at constant speed; the way from centre line to centre line is bent into an
    S (3 p^2 - 2 p^3), which crosses the marking at the same moment.
    """
    begins = {name: begin for name, begin, _, _, _ in _edges(road, traffic)} | {"ramp": WEAVE_BEGINS_M - RAMP_M}
    outermost = {name: lanes for name, _, _, lanes, _ in _edges(road, traffic)} | {"ramp": road.lanes + 2}
    kinds = pl.DataFrame(
        [(kind.name, kind.v_class, kind.length_m, kind.width_m) for kind in VEHICLE_TYPES],
        schema={"type": pl.String, "v_class": pl.Int8, "length": pl.Float64, "width": pl.Float64},
        orient="row",
    )
    raw = pl.read_csv(
        path,
        separator=";",
        columns=[
            "timestep_time", "vehicle_id", "vehicle_type", "vehicle_lane", "vehicle_pos", "vehicle_posLat",
            "vehicle_speed", "vehicle_speedLat", "vehicle_acceleration",
        ],
        schema_overrides={"timestep_time": pl.Float64, "vehicle_id": pl.String, "vehicle_type": pl.String},
    ).rename(lambda name: name.removeprefix("vehicle_"))  # fmt: skip
    edge = pl.col("lane").str.extract(r"^(.*)_\d+$")
    index = pl.col("lane").str.extract(r"_(\d+)$").cast(pl.Int16)
    placed = raw.with_columns(
        edge=edge,
        frame=((pl.col("timestep_time") - traffic.warm_up_s) * road.rate_hz).round().cast(pl.Int32) + 1,
        x=edge.replace_strict(begins, return_dtype=pl.Float64) + pl.col("pos"),
        number=edge.replace_strict(outermost, return_dtype=pl.Int16) - index,
    ).filter(pl.col("x").is_between(0, road.window_m, closed="left"))
    on_ramp = placed["edge"].to_numpy() == "ramp"
    x = placed["x"].to_numpy()
    # Lane centres stand at whole numbers: 0 is the leftmost lane's.
    across = placed["number"].to_numpy() - 1 - placed["posLat"].to_numpy() / SUMO_LANE_M
    lower = np.floor(across)
    part = across - lower
    across = lower + part**2 * (3 - 2 * part)
    lateral_speed = -placed["speedLat"].to_numpy() / SUMO_LANE_M * 6 * part * (1 - part)
    closing = np.clip((WEAVE_BEGINS_M - x) / MERGE_M, 0, 1)
    across = np.where(on_ramp, road.lanes + closing**2 * (3 - 2 * closing), across)
    tracks = placed.with_columns(
        pl.Series("y", (across + 0.5) * road.lane_width_m),
        pl.Series("lateral_speed", lateral_speed * road.lane_width_m),
        pl.Series("on_ramp", on_ramp),
    ).join(kinds, on="type", how="left", maintain_order="left")
    visible = ~pl.col("on_ramp") | (pl.col("x") >= RAMP_VISIBLE_M)
    tracks = tracks.filter(visible).with_columns(lane=compute_lanes(road))
    order = (
        tracks.group_by("id")
        .agg(pl.col("frame").min().alias("first"), pl.col("x").sort_by("frame").first().alias("from"))
        .sort("first", "from", "id", descending=[False, True, False])
        .with_columns(vehicle=pl.int_range(1, pl.len() + 1, dtype=pl.Int32))
    )
    return (
        tracks.join(order.select("id", "vehicle"), on="id")
        .rename({"acceleration": "accel"})
        .select(pl.col(name).cast(dtype) for name, dtype in TRACK_SCHEMA.items())
        .sort("vehicle", "frame")
    )


def compute_lanes(road: Road) -> pl.Expr:
    """Compute the lane that contains `y`; the on-ramp (`on_ramp`) is the outermost."""
    outermost = road.lanes + road.ramp
    inside = ((pl.col("y") / road.lane_width_m).floor().cast(pl.Int16) + 1).clip(1, outermost)
    return pl.when("on_ramp").then(pl.lit(road.lanes + 2)).otherwise(inside).cast(pl.Int16)
