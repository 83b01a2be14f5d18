"""One subset for SUMO: floating-car data, road, types of vehicles, and a configuration that replays the tracks."""

from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.export.folder import ExportError, refuse_taken, write_files
from tracklake.pipeline.export.provenance import describe_licences, describe_provenance, list_licences, read_facts
from tracklake.pipeline.export.sumo.floating_cars import (
    add_ends,
    find_half_step,
    list_types,
    place_vehicles,
    write_fcd,
    write_types,
)
from tracklake.pipeline.export.sumo.road import Road, find_road, write_network
from tracklake.pipeline.lake import Manifest, load, scan
from tracklake.pipeline.orchestration.progress import reporter
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import open_reader
from tracklake.schemas import SUBSETS, VEHICLES
from tracklake.schemas.origin import describe_synthetic
from tracklake.schemas.text import suggest_name

FCD, REPLAY, NETWORK, TYPES, CONFIG = "fcd.xml", "replay.xml", "road.net.xml", "types.add.xml", "replay.sumocfg"
"""Names of the files: tracks, the same for the replay, road, types of vehicles, configuration."""
CARD = "README.md"
"""Name of the card's file."""
NAMES = (FCD, REPLAY, NETWORK, TYPES, CONFIG, CARD)
"""Names of all files."""
TRACK_COLUMNS = ("vehicle_id", "frame", "x_m", "y_m", "lane", "heading_rad", "speed_mps")
"""Columns of tracks that the export reads."""


@dataclass(frozen=True)
class SumoExport:
    """The result of an export: numbers of vehicles, entries and lanes, and what a user should know of them."""

    out: Path
    dataset: str
    subset: str
    tracks_from: str
    vehicles: int
    entries: int
    lanes: int
    notes: tuple[str, ...]
    licences: tuple[str, ...]
    synthetic: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain values."""
        return asdict(self) | {"out": str(self.out)}


def export_sumo_fcd(settings: Settings, out: Path, subset: str | None = None, *, force: bool = False) -> SumoExport:
    """Write one freeway subset's tracks, as `tracks_from` says, with a road and a replay; all files or none.

    Raises:
        LakeMissingError: the lake does not exist.
        ExportError: `out` cannot be written to, there is no such subset, or SUMO cannot show it.
        StageError: `tracks_from` needs a stage that has not run.
    """
    manifest = load(settings.lake)
    refuse_taken(out, NAMES, force=force)
    facts = _choose_subset(settings.lake, manifest, subset)
    half_ms = find_half_step(facts["frame_rate_hz"])
    reader = open_reader(manifest, settings).open_subset(facts["dataset"], facts["subset"])
    show = reporter()
    show.begin("write", 3)
    tracks = reader.read_tracks(settings, *TRACK_COLUMNS)
    types = list_types(reader.table(VEHICLES, "vehicle_id", "class", "length_m", "width_m"))
    road = find_road(tracks, facts)
    placed = place_vehicles(tracks, types, road, facts)
    show.advance("write", "tracks")
    named = pl.DataFrame({name: [facts[name]] for name in ("dataset", "subset")})
    shown = read_facts(settings.lake, manifest, named)
    export = SumoExport(
        out=out,
        dataset=facts["dataset"],
        subset=facts["subset"],
        tracks_from=settings.tracks_from,
        vehicles=placed["vehicle_id"].n_unique(),
        entries=placed.height,
        lanes=road.lanes,
        notes=tuple(_list_notes(tracks, placed, types, road)),
        licences=list_licences(shown),
        synthetic=describe_synthetic({facts["subset"]: facts["origin"]}),
    )

    def write(aside: Path) -> None:
        write_fcd(aside / FCD, placed, road, half_ms, number_parts=False)
        show.advance("write", FCD)
        write_fcd(aside / REPLAY, add_ends(placed, road, half_ms), road, half_ms, number_parts=True)
        show.advance("write", REPLAY)
        write_network(aside / NETWORK, road)
        write_types(aside / TYPES, types)
        last_ms = 2000 + int(placed["step"].to_numpy().max()) * half_ms
        _write_config(aside / CONFIG, half_ms, last_ms)
        _write_card(aside / CARD, export, road, shown)

    write_files(out, NAMES, write)
    return export


def _choose_subset(lake: Path, manifest: Manifest, name: str | None) -> dict[str, Any]:
    """Return the facts of the freeway subset of a name, or of the only one."""
    found = scan(lake, manifest, SUBSETS).filter("freeway").sort("dataset", "subset").collect()
    if found.is_empty():
        raise ExportError(
            f"{lake}: the lake holds no freeway recordings, and a straight road shows no other streets; "
            "`tracklake ingest SOURCE` adds recordings."
        )
    keys = [f"{dataset}/{subset}" for dataset, subset in found.select("dataset", "subset").iter_rows()]
    chosen = [row for row, key in enumerate(keys) if name is None or name in (key, key.partition("/")[2])]
    if len(chosen) > 1:
        raise ExportError(
            f"{lake}: expected one subset, got {len(chosen)}: name one of {_name_some(keys)} with --subset"
        )
    if name is not None and not chosen:
        raise ExportError(f"{lake}: no freeway subset is called {name}; {suggest_name(name, found['subset'])}")
    return found.row(chosen[0], named=True)


def _name_some(names: list[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def _list_notes(tracks: pl.DataFrame, placed: pl.DataFrame, types: pl.DataFrame, road: Road) -> list[str]:
    """List what the files show otherwise than the tracks, and what was estimated."""
    backward = int((tracks["speed_mps"] < 0).sum())
    lanes = int(tracks["lane"].null_count())
    gaps = int(placed["enters"].sum()) - placed["vehicle_id"].n_unique()
    sizes = int((types["length_m"].is_null() | types["width_m"].is_null()).sum())
    counted = (
        (backward, "entries drive backwards: SUMO knows no negative speed, theirs is 0; positions are as they are"),
        (lanes, "entries have no lane: theirs is the one in which they lie"),
        (gaps, f"gaps in tracks: {REPLAY} has a track's further parts as vehicles of their own (7, 7.2, 7.3)"),
        (sizes, "vehicles have no length or width: SUMO's own of their class is shown"),
    )
    return [f"lanes: {road.source}", *(f"{count:,} {what}" for count, what in counted if count)]


def _write_config(path: Path, half_ms: int, last_ms: int) -> None:
    """Write the configuration of the replay; --fcd-output of SUMO then gives the frames alone."""
    values = {
        "net-file": NETWORK,
        "additional-files": TYPES,
        "device.fcd-replay.files": REPLAY,
        "begin": "0",
        "end": f"{last_ms / 1000}",
        "step-length": f"{half_ms / 1000}",
        "device.fcd.period": f"{2 * half_ms / 1000}",
        "precision": "3",
        "insertion-checks": "none",
        "collision.action": "none",
        "time-to-teleport": "-1",
        "no-warnings": "true",
        "no-step-log": "true",
    }
    lines = [f'        <{name} value="{value}"/>' for name, value in values.items()]
    text = ['<?xml version="1.0" encoding="UTF-8"?>', "<configuration>", "    <input>", *lines, "    </input>"]
    path.write_text("\n".join([*text, "</configuration>"]) + "\n", encoding="utf-8")


def _write_card(path: Path, export: SumoExport, road: Road, facts: pl.DataFrame) -> None:
    lines = [
        f"# {export.dataset}/{export.subset} for SUMO",
        "",
        f"Written by tracklake {version('tracklake')}: `tracklake export sumo-fcd --subset {export.subset}`, "
        f"{export.tracks_from} tracks: {export.vehicles:,} vehicles, {export.entries:,} entries.",
        "",
        *([f"**{export.synthetic}**", ""] if export.synthetic else []),
        FILES,
        *(f"- {note}" for note in export.notes),
        "",
        "Markings of the lanes, y_m: " + ", ".join(f"{own:.2f}" for own in road.markings_m),
        "",
        *describe_licences(facts, "The files"),
        *describe_provenance(facts),
    ]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


FILES = f"""\
| file | content |
| --- | --- |
| {FCD} | the tracks as SUMO's floating-car data: one row per vehicle and frame |
| {CONFIG} | replays them: `sumo-gui -c {CONFIG}`, or `sumo -c {CONFIG} --fcd-output replayed.xml` |
| {REPLAY} | {FCD} for the replay: vehicles also enter half a frame before their first entry, and leave after the last |
| {NETWORK}, {TYPES} | a straight road with the recording's lanes; a type for each class and size of vehicles |

- The replay needs SUMO 1.28 (`pip install eclipse-sumo`).
- x is x_m, y is -y_m (SUMO's y points to the left of travel), both of the front bumper's middle, in m. The time is
  time_s + 1 s. The angle is 90 degrees along the road, more to the driver's right.
- Lane `road_0` is the rightmost one. In {FCD} it is the recorded lane; in a replay it is the lane in which the front
  lies.
- Replayed positions are those of the tracks, to 1 mm, at every frame. Speeds are the tracks'. What SUMO computes beside
  that (emissions, detectors, surrogate safety measures) is of these movements: nothing is simulated.
"""
