"""Simulation by SUMO: its roads and demand, its runs as subprocesses, and their tracks.

The binaries come with the wheel `eclipse-sumo`. They are run as programs: their libraries clash with Arrow's when
loaded into this process.
"""

import os
import subprocess
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import polars as pl

from tracklake.pipeline.synthetic.drivers import (
    UNIFORM,
    VARIED,
    VEHICLE_TYPES,
    WAVE_PAUSE_S,
    WAVE_SELDOM_PAUSE_S,
    VehicleType,
    draw_types,
    draw_waves,
)
from tracklake.pipeline.synthetic.lane_changes import draw_courses, move_across
from tracklake.pipeline.synthetic.scenarios import RAMP_VISIBLE_M, WEAVE_BEGINS_M, WEAVE_ENDS_M, Road, Traffic
from tracklake.schemas.arrays import Floats
from tracklake.schemas.errors import TracklakeError

APPROACH_M = 500.0
MARGIN_M = 40.0
"""Length recorded before and behind the window, in m, so that its ends are away from junctions."""
BEYOND_M = 160.0
BOTTLENECK_M = 300.0
RAMP_M = 300.0
LANE_CHANGE_S, VARIED_LANE_CHANGE_S = 4.0, 6.0
"""Time for which a lane changer keeps both lanes, in s; in varied traffic not that of the change itself."""
PULSE_EVERY_S, PULSE_S, PULSE_MPS = 40.0, 15.0, 0.2
SUMO_LANE_M = 3.2
"""Width of SUMO's own lanes, in which posLat is measured, whatever the recorded road is given, in m."""
UNCHECKED_XML = ("--xml-validation", "never")
"""Option that keeps SUMO from validating XML files, which are its own or ours: half of its time on a short sample."""
MERGE_M = 80.0
"""Length over which the on-ramp's lane approaches the auxiliary lane, in m."""


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
    "change_begin": pl.Float64(),
    "change_end": pl.Float64(),
    "change_side": pl.Int8(),
}
"""Tracks inside the generator: x_m of the front from the window's entrance along the direction of travel, y_m from
the left edge to the right, m/s and m/s2 along the direction of travel, lane 1 leftmost; sorted by vehicle, frame.
In varied traffic the lane change that the vehicle is in: its frames, which need not be whole ones or of the window,
and its side (-1 left, 1 right); null otherwise."""


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
    _call(home, "netconvert", [*arguments, "--no-internal-links", "--no-turnarounds", *UNCHECKED_XML])


def write_demand(
    folder: Path, road: Road, traffic: Traffic, seconds: float, types: tuple[VehicleType, ...], waves: Floats
) -> None:
    """Write vehicle types and Poisson arrivals to `routes.xml`, the bottleneck's waves (W, 3) to `signs.xml`."""
    shares = (traffic.trucks if kind.v_class == 3 else 1 - traffic.trucks for kind in types)
    listed = [kind.format_xml(share * kind.weight) for kind, share in zip(types, shares, strict=True)]
    flow = 'type="mix" begin="0" end="{end}" departLane="random" departSpeed="{speed}"'.format(
        end=seconds, speed="desired" if traffic.bottleneck_mps is None else "avg"
    )
    flows = [f'<flow id="main" {flow} from="approach" to="bottleneck" period="exp({traffic.arrivals * road.lanes})"/>']
    if road.ramp:
        flows.append(f'<flow id="ramp" {flow} from="ramp" to="bottleneck" period="exp({traffic.ramp_arrivals})"/>')
    text = "\n".join(["<routes>", '<vTypeDistribution id="mix">', *listed, "</vTypeDistribution>", *flows, "</routes>"])
    (folder / "routes.xml").write_text(text + "\n", encoding="utf-8")
    signs = []
    if traffic.bottleneck_mps is not None and len(waves):
        lanes = " ".join(f"bottleneck_{lane}" for lane in range(road.lanes))
        steps = [
            (0.0, 1.0),
            *((time, speed) for begin, end, wave in waves for time, speed in ((begin, wave), (end, 1.0))),
        ]
        signs = [
            f'<variableSpeedSign id="sign" lanes="{lanes}">',
            *(f'<step time="{time:g}" speed="{share * traffic.bottleneck_mps:g}"/>' for time, share in steps),
            "</variableSpeedSign>",
        ]
    text = "\n".join(["<additional>", *signs, "</additional>"])
    (folder / "signs.xml").write_text(text + "\n", encoding="utf-8")


def simulate(home: Path, folder: Path, road: Road, traffic: Traffic, *, frames: int, seed: int) -> pl.DataFrame:
    """Simulate frames of one carriageway, with SUMO's files in an empty folder; return the tracks in its window.

    Returns TRACK_SCHEMA; vehicles count from 1 in order of (first frame, foremost first).
    """
    random = np.random.default_rng(seed)
    seconds = traffic.warm_up_s + frames / road.rate_hz
    types = VEHICLE_TYPES if traffic.drivers == UNIFORM else draw_types(VARIED[traffic.drivers], random)
    keeps_s = LANE_CHANGE_S if traffic.drivers == UNIFORM else VARIED_LANE_CHANGE_S
    write_network(home, folder, road, traffic)
    write_demand(folder, road, traffic, seconds, types, _plan_waves(traffic, seconds, random))
    recorded = ["before", "weave", "after", "ramp"] if road.ramp else ["window"]
    (folder / "recorded.txt").write_text("".join(f"edge:{name}\n" for name in recorded), encoding="utf-8")
    _call(
        home,
        "sumo",
        [
            *("-n", str(folder / "net.xml"), "-r", str(folder / "routes.xml"), "-a", str(folder / "signs.xml")),
            *("--seed", str(seed), *UNCHECKED_XML, "--xml-validation.net", "never", "--xml-validation.routes", "never"),
            *("--step-length", str(1 / road.rate_hz), "--end", str(seconds), "--precision", "5"),
            *("--lanechange.duration", str(keeps_s), "--time-to-teleport", "-1", "--no-step-log"),
            *("--fcd-output", str(folder / "fcd.csv"), "--device.fcd.begin", str(traffic.warm_up_s)),
            *("--fcd-output.filter-edges.input-file", str(folder / "recorded.txt"), "--fcd-output.acceleration"),
            *("--fcd-output.attributes", "id,type,lane,pos,posLat,speed,speedLat,acceleration"),
            *("--lanechange-output", str(folder / "changes.csv")),
        ],
    )
    placed = read_places(folder / "fcd.csv", road, traffic)
    if traffic.drivers == UNIFORM:
        placed = bend_lane_changes(placed)
    else:
        changes = read_changes(folder / "changes.csv", road, traffic)
        placed = move_across(placed, draw_courses(changes, random), road, random)
    return build_tracks(placed, road, traffic, types)


def _plan_waves(traffic: Traffic, seconds: float, random: np.random.Generator) -> Floats:
    """Plan the bottleneck's waves, as `draw_waves` returns them: every PULSE_EVERY_S, or at random."""
    if traffic.bottleneck_mps is None:
        return np.empty((0, 3))
    if traffic.drivers != UNIFORM:
        return draw_waves(seconds, WAVE_PAUSE_S if traffic.pulsing else WAVE_SELDOM_PAUSE_S, random)
    ends = PULSE_EVERY_S + np.arange(0, seconds if traffic.pulsing else 0, PULSE_EVERY_S)
    return np.stack([ends - PULSE_S, ends, np.full_like(ends, PULSE_MPS / traffic.bottleneck_mps)], axis=1)


def _number_lanes(road: Road, traffic: Traffic, name: str) -> pl.Expr:
    """Compute the number of SUMO's lane `name`: 1 is the leftmost; the on-ramp has that of the auxiliary lane."""
    outermost = {edge: lanes for edge, _, _, lanes, _ in _edges(road, traffic)} | {"ramp": road.lanes + 1}
    edge, index = (pl.col(name).str.extract(pattern) for pattern in (r"^(.*)_\d+$", r"_(\d+)$"))
    return edge.replace_strict(outermost, return_dtype=pl.Int16) - index.cast(pl.Int16)


def read_places(path: Path, road: Road, traffic: Traffic) -> pl.DataFrame:
    """Read SUMO's floating car data of the window, sorted by time, with places and lanes in the window's own frame."""
    begins = {name: begin for name, begin, _, _, _ in _edges(road, traffic)} | {"ramp": WEAVE_BEGINS_M - RAMP_M}
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
    return raw.with_columns(
        time=pl.col("timestep_time"),
        frame=_count_frames(pl.col("timestep_time"), road, traffic).round().cast(pl.Int32),
        x=edge.replace_strict(begins, return_dtype=pl.Float64) + pl.col("pos"),
        number=_number_lanes(road, traffic, "lane"),
        on_ramp=edge == "ramp",
    ).filter(pl.col("x").is_between(0, road.window_m, closed="left"))


def read_changes(path: Path, road: Road, traffic: Traffic) -> pl.DataFrame:
    """Read when vehicles cross a marking, anywhere on the road, as `draw_courses` takes it."""
    raw = pl.read_csv(path, separator=";", columns=["change_id", "change_time", "change_from", "change_to"])
    return raw.select(
        id="change_id",
        time=pl.col("change_time").cast(pl.Float64),
        start=_number_lanes(road, traffic, "change_from"),
        target=_number_lanes(road, traffic, "change_to"),
    )


def bend_lane_changes(placed: pl.DataFrame) -> pl.DataFrame:
    """Add the columns of `move_across` to SUMO's places, and the rate of change of `across`, `across_speed` in 1/s.

    SUMO moves a lane changer sideways at constant speed; the way from centre line to centre line is bent into an
    S (3 p^2 - 2 p^3), which crosses the marking at the same moment.
    """
    across = placed["number"].to_numpy() - 1 - placed["posLat"].to_numpy() / SUMO_LANE_M
    lower = np.floor(across)
    part = across - lower
    return placed.with_columns(
        pl.Series("across", lower + part**2 * (3 - 2 * part)),
        pl.Series("across_speed", -placed["speedLat"].to_numpy() / SUMO_LANE_M * 6 * part * (1 - part)),
        *(pl.lit(None, pl.Float64).alias(name) for name in ("change_begin", "change_end", "change_side")),
    )


def build_tracks(placed: pl.DataFrame, road: Road, traffic: Traffic, types: tuple[VehicleType, ...]) -> pl.DataFrame:
    """Build tracks, TRACK_SCHEMA, from places with the columns of `move_across`."""
    kinds = pl.DataFrame(
        [(kind.name, kind.v_class, kind.length_m, kind.width_m) for kind in types],
        schema={"type": pl.String, "v_class": pl.Int8, "length": pl.Float64, "width": pl.Float64},
        orient="row",
    )
    closing = np.clip((WEAVE_BEGINS_M - placed["x"].to_numpy()) / MERGE_M, 0, 1)
    across = placed["across"].to_numpy()
    on_ramp = placed["on_ramp"].to_numpy()
    across = np.where(on_ramp, across + closing**2 * (3 - 2 * closing), across)
    moved = placed.with_columns(pl.Series("y", (across + 0.5) * road.lane_width_m))
    if "across_speed" in placed.columns:
        lateral_speed = pl.col("across_speed") * road.lane_width_m
    else:
        lateral_speed = (pl.col("y").diff().backward_fill().over("id") * road.rate_hz).fill_null(0.0)
    visible = ~pl.col("on_ramp") | (pl.col("x") >= RAMP_VISIBLE_M)
    tracks = (
        moved.with_columns(
            _count_frames(pl.col("change_begin", "change_end"), road, traffic), lateral_speed=lateral_speed
        )
        .join(kinds, on="type", how="left", maintain_order="left")
        .filter(visible)
        .with_columns(lane=compute_lanes(road))
    )
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


def _count_frames(time_s: pl.Expr, road: Road, traffic: Traffic) -> pl.Expr:
    """Convert SUMO's time to a number of frames, of which 1 is the first."""
    return (time_s - traffic.warm_up_s) * road.rate_hz + 1


def compute_lanes(road: Road) -> pl.Expr:
    """Compute the lane that contains `y`; the on-ramp (`on_ramp`) is the outermost."""
    outermost = road.lanes + road.ramp
    inside = ((pl.col("y") / road.lane_width_m).floor().cast(pl.Int16) + 1).clip(1, outermost)
    return pl.when("on_ramp").then(pl.lit(road.lanes + 2)).otherwise(inside).cast(pl.Int16)
