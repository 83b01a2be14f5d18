"""`tracklake instrument`: drives of virtual instrumented vehicles, from the overhead recordings of a lake."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import polars as pl
import typer

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.console import Terminal, find_command
from tracklake.pipeline.cli.options import JsonOption, LakeOption, QuietOption
from tracklake.pipeline.lake.lake import Lake, open_lake
from tracklake.pipeline.synthetic.onboard.camera import Camera
from tracklake.pipeline.synthetic.onboard.instrument import (
    DEFAULT_FORMATS,
    DriveSummary,
    instrument_drive,
    require_usable,
)
from tracklake.pipeline.synthetic.onboard.lidar import Lidar
from tracklake.pipeline.synthetic.onboard.motion import LEAST_TICKS, find_drives
from tracklake.pipeline.synthetic.onboard.radio import Radio
from tracklake.pipeline.synthetic.onboard.sensing import InstrumentConfig
from tracklake.schemas.errors import UsageError
from tracklake.schemas.text import quote_shell, suggest_name


def instrument(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the drives, one folder each.")],
    ego: Annotated[
        list[str] | None,
        typer.Option("--ego", metavar="SUBSET:VEHICLE", help="Vehicle to instrument, as 02-lower:21; repeatable."),
    ] = None,
    share: Annotated[
        float | None, typer.Option("--share", help="Instrument this share of all vehicles, drawn by the seed.")
    ] = None,
    lake: LakeOption = None,
    penetration: Annotated[float, typer.Option("--penetration", help="Share of other vehicles that send.")] = 0.6,
    gnss: Annotated[str, typer.Option("--gnss", help="Positioning of all vehicles: plain or dgps.")] = "plain",
    heading_error: Annotated[
        float, typer.Option("--heading-error", help="Constant heading error of each vehicle, in degrees.")
    ] = 1.0,
    no_lidar: Annotated[bool, typer.Option("--no-lidar", help="Leave the LiDAR out.")] = False,
    no_camera: Annotated[bool, typer.Option("--no-camera", help="Leave the camera out.")] = False,
    id_change_s: Annotated[
        float, typer.Option("--id-change-s", help="Time after which a vehicle changes its temporary id.", min=1)
    ] = 300.0,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            help="Messages: wyoming, tampa, hex or bsmp1; sensors: rosbag1 or rosbag2; repeatable; default: wyoming "
            "and rosbag2.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of all noise: same seed, same bytes.")] = 1,
    quiet: QuietOption = False,
    json: JsonOption = False,
) -> None:
    """Write what a car of a recording would have logged: V2V messages, LiDAR, camera, and the truth."""
    with command(quiet=quiet, json=json) as terminal:
        if (ego is None) == (share is None):
            raise typer.BadParameter("give either --ego SUBSET:VEHICLE or --share, a share of all vehicles")
        if share is not None and not 0 < share <= 1:
            raise typer.BadParameter(f"--share: expected a share above 0, at most 1; got {share:g}")
        config = InstrumentConfig(
            seed=seed,
            penetration=penetration,
            receiver=gnss,
            heading_error_deg=heading_error,
            lidar=None if no_lidar else Lidar(),
            camera=None if no_camera else Camera(),
            channel=Radio(id_change_s=id_change_s),
        )
        with open_lake(read_settings(lake=lake).lake) as opened:
            known = opened.subsets().select("dataset", "subset")
            if known.is_empty():
                raise UsageError(f"{opened.path}: holds no overhead recordings, from which drives are derived")
            egos = _draw_egos(opened, known, share, seed) if share is not None else _find_egos(known, ego or [])
            drives = list(_write_drives(terminal, opened, egos, config, out, tuple(formats or DEFAULT_FORMATS)))
        terminal.print_line(f"Try next:\n  {find_command()} run {quote_shell(out)} --lake {quote_shell(opened.path)}")
        terminal.print_json({"drives": [asdict(drive) for drive in drives]})


Egos = dict[tuple[str, str], list[int]]
"""Vehicles to instrument by dataset and subset."""


def _find_egos(known: pl.DataFrame, named: Sequence[str]) -> Egos:
    """Find the subsets that `--ego` names, as `02-lower:21` or `highd/02-lower:21`."""
    egos: Egos = {}
    for each in named:
        place, colon, vehicle = each.rpartition(":")
        if not colon or not vehicle.isdecimal():
            raise typer.BadParameter(f"--ego: expected SUBSET:VEHICLE, for instance 02-lower:21; got {each!r}")
        full = pl.format("{}/{}", "dataset", "subset")
        found = known.filter((pl.col("subset") == place) | (full == place)).rows()
        if not found:
            raise UsageError(f"--ego {each}: no subset {place!r}; {suggest_name(place, known['subset'])}")
        if len(found) > 1:
            names = " or ".join(f"{dataset}/{subset}:{vehicle}" for dataset, subset in found)
            raise UsageError(f"--ego {each}: {len(found)} datasets have this subset. Write {names}.")
        ids = egos.setdefault(found[0], [])
        if int(vehicle) not in ids:
            ids.append(int(vehicle))
    return egos


def _draw_egos(lake: Lake, known: pl.DataFrame, share: float, seed: int) -> Egos:
    """Draw a share of the vehicles that were recorded long enough, at least one."""
    candidates = []
    for place in known.sort(pl.all()).rows():
        drives = find_drives(_read(lake, "tracks", place, ("vehicle_id", "frame", "time_s")))
        able = drives.filter(pl.col("last_tick") - pl.col("first_tick") >= LEAST_TICKS)
        candidates += [(place, vehicle) for vehicle in able["vehicle_id"].to_list()]
    if not candidates:
        raise UsageError(f"{lake.path}: no vehicle was recorded for {LEAST_TICKS / 10:g} s without a gap")
    count = max(1, round(share * len(candidates)))
    egos: Egos = {}
    for chosen in sorted(np.random.default_rng(seed).permutation(len(candidates))[:count].tolist()):
        place, vehicle = candidates[chosen]
        egos.setdefault(place, []).append(vehicle)
    return egos


def _read(lake: Lake, table: str, place: tuple[str, str], columns: Sequence[str]) -> pl.DataFrame:
    """Read columns of one subset."""
    dataset, subset = place
    chosen = (pl.col("dataset") == dataset) & (pl.col("subset") == subset)
    return lake.table(table).filter(chosen).select(columns).collect()


def _write_drives(
    terminal: Terminal, lake: Lake, egos: Egos, config: InstrumentConfig, out: Path, formats: tuple[str, ...]
) -> Iterator[DriveSummary]:
    """Write each drive into a folder `SUBSET-VEHICLE` and print what it holds."""
    for (_, subset), vehicle in ((place, vehicle) for place, ids in egos.items() for vehicle in ids):
        require_usable(out / f"{subset}-{vehicle}", formats)  # before the first one is written
    columns = ("vehicle_id", "frame", "time_s", "x_m", "y_m", "lane", "speed_mps", "accel_mps2")
    for place, ids in egos.items():
        facts = dict(zip(("dataset", "subset"), place, strict=True))
        tracks = _read(lake, "tracks", place, columns)
        vehicles = _read(lake, "vehicles", place, ("vehicle_id", "class", "length_m", "width_m"))
        findings = _read(lake, "findings", place, ("vehicle_id", "rule", "severity", "first_frame", "last_frame"))
        usual = 0
        for vehicle in ids:
            folder = out / f"{place[1]}-{vehicle}"
            drive = instrument_drive(tracks, vehicles, facts, vehicle, config, folder, formats)
            usual = max(usual, drive.usual_sizes)
            terminal.print_line(
                f"{folder.name}: {drive.seconds:.1f} s, {drive.messages:,} messages, {drive.heard} of {drive.vehicles} "
                f"vehicles heard, {drive.scans} LiDAR scans, {drive.images} images"
            )
            doubtful = _describe_doubtful(tracks, findings, vehicle)
            if doubtful:
                terminal.print_problem(f"{folder.name}: {doubtful}", label="note")
            yield drive
        if usual:
            terminal.print_line(
                f"{place[1]}: states no length or width of {usual} vehicles; usual ones of their class are taken",
                style="dim",
            )


def _describe_doubtful(tracks: pl.DataFrame, findings: pl.DataFrame, ego: int) -> str:
    """Return which vehicles have errors, or speeds that contradict positions, while the ego drives; empty if none."""
    frames = tracks.filter(pl.col("vehicle_id") == ego)["frame"]
    meanwhile = (pl.col("last_frame") >= frames.min()) & (pl.col("first_frame") <= frames.max())
    wrong = (pl.col("severity") == "error") | (pl.col("rule") == "speed_mismatch")
    found = findings.filter(meanwhile, wrong)
    if found.is_empty():
        return ""
    ids = found["vehicle_id"].unique()
    rules = ", ".join(found["rule"].unique().sort())
    who = "the ego has" if ego in ids else ""
    others = len(ids) - (1 if who else 0)
    if others:
        who = f"{'the ego and ' if who else ''}{others} other vehicle{'s' if others > 1 else ''} "
        who += "have" if len(ids) > 1 else "has"
    return f"{who} findings in the recording meanwhile ({rules}): their truth may be wrong, and so errors against it"
