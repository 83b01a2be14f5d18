"""`tracklake info`: what a lake holds, what is stale in it and why, and its size on disk."""

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.console import Terminal
from tracklake.pipeline.cli.drives import list_drives, print_drives
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption
from tracklake.pipeline.cli.tables import format_number, print_table
from tracklake.pipeline.ingest.staleness import StageState, describe_stages
from tracklake.pipeline.lake import Manifest, connect, load
from tracklake.pipeline.lake.catalog import CATALOG
from tracklake.pipeline.lake.ducklake import DUCKLAKE
from tracklake.pipeline.lake.files import MODELS, REPORTS, STORE, TABLE_BY_NAME, TENSORS
from tracklake.pipeline.lake.history import list_generations
from tracklake.pipeline.lake.object_access import name_object
from tracklake.pipeline.lake.places import LakePlace, find_place, open_store
from tracklake.quality_reports.gates.metrics import collect_metrics
from tracklake.schemas.origin import describe_synthetic

SHOWN = ("origin", "subsets", "vehicles", "entries", "error_share", "excluded_subsets")
"""Metrics of each recording that are shown."""
MAX_REASONS = 3
"""Most reasons of one stage that are printed; --json has all."""


def info(lake: LakeOption = None, protocol: ProtocolOption = None, json: JsonOption = False) -> None:
    """Show a lake's recordings, stages, what is stale and why, and sizes on disk.

    Stages are compared with the settings in force. Raw files are compared by size and time of change.
    """
    with command(json=json) as terminal:
        settings = read_settings(lake=lake, protocol=protocol, in_folder=False)
        place = find_place(settings.lake)
        manifest = load(place)
        with connect(place) as connection:
            rows = collect_metrics(connection, ())
        recordings = _list_recordings([row for row in rows if row["scope"] == "recording"], manifest)
        drives = list_drives(place, manifest)
        # On an object store no stage runs, and raw files are not compared: the folder it was published from has both.
        stages = describe_stages(place, manifest, settings) if isinstance(place, Path) else []
        sizes, generations = measure_sizes(place, manifest), list_generations(place)
        terminal.print_line(f"{place}", style="bold")
        terminal.print_origin(describe_synthetic({row["subset"]: row["origin"] for row in rows if row["subset"]}))
        if recordings or not drives:
            _show_recordings(terminal, recordings)
        print_drives(terminal, drives)
        if stages:
            _show_stages(terminal, stages)
        print_table(terminal, ("stored", "MB"), [[name, f"{size / 1e6:,.1f}"] for name, size in sizes.items()])
        print_table(
            terminal,
            ("generation", "last change", "commits"),
            [[str(each.number), each.show_time(), f"{each.commits:,}"] for each in generations],
            title="States of the lake (tracklake sql --as-of GENERATION)",
            right=(True, False, True),
        )
        terminal.print_json(
            {
                "lake": place,
                "lake_id": manifest.lake_id,
                "ingested_from": manifest.ingested_from,
                "recordings": recordings,
                "drives": drives,
                "stages": [asdict(state) for state in stages],
                "bytes": sizes,
                "generations": [asdict(each) for each in generations],
            }
        )


def _list_recordings(rows: Sequence[dict[str, Any]], manifest: Manifest) -> list[dict[str, Any]]:
    """Return facts of each recording, with the bytes of its live files."""
    sizes: Counter[str] = Counter()
    for commit in manifest.commits.values():
        sizes[commit.tail] += sum(file.bytes for file in commit.all_files)
    return [
        {
            **{name: row[name] for name in ("dataset", "recording", *SHOWN)},
            "bytes": sizes[f"{row['dataset']}/{row['recording']}"],
        }
        for row in rows
    ]


def measure_sizes(place: LakePlace, manifest: Manifest) -> dict[str, int]:
    """Return the bytes of the parts of a lake; files with several names count once.

    Folders of tables hold links to the tables, or `copies` where the file system has none. Files that were `replaced`
    are kept for readers and deleted by a later session.
    """
    parts = {STORE: "tables", TENSORS: "tensors", REPORTS: "reports", MODELS: "models"}
    parts |= dict.fromkeys(TABLE_BY_NAME, "copies")
    sizes = dict.fromkeys((*parts.values(), "catalog", "replaced", "others"), 0)
    if isinstance(place, str):
        objects = {name_object(file) for commit in manifest.commits.values() for file in commit.all_files}
        for item in open_store(place).list():
            part = parts.get(item.path.partition("/")[0], "others")
            sizes[part if item.path in objects or part == "others" else "replaced"] += item.bytes
        return sizes | {"total": sum(sizes.values())}
    root, live, seen = place, manifest.live_paths(), set()
    for top in (*parts, "."):  # the content of tables before the folders with links to it
        for folder, _, names in os.walk(root / top):
            for path in (Path(folder) / name for name in names):
                status = path.lstat()
                if (status.st_dev, status.st_ino) in seen:
                    continue
                seen.add((status.st_dev, status.st_ino))
                is_replaced = top in (STORE, TENSORS) and path.relative_to(root).as_posix() not in live
                part = "catalog" if path in (root / CATALOG, root / DUCKLAKE) else parts.get(top, "others")
                sizes["replaced" if is_replaced else part] += status.st_size
    return sizes | {"total": sum(sizes.values())}


def _show_recordings(terminal: Terminal, recordings: Sequence[dict[str, Any]]) -> None:
    headings = ("recording", "origin", "subsets", "vehicles", "entries", "errors, %", "excluded", "MB")
    rows = [
        [
            f"{row['dataset']}/{row['recording']}",
            row["origin"],
            str(row["subsets"]),
            f"{row['vehicles']:,}",
            f"{row['entries']:,}",
            format_number(row["error_share"], 2, 100),
            format_number(row["excluded_subsets"], 0),
            f"{row['bytes'] / 1e6:,.1f}",
        ]
        for row in recordings
    ]
    print_table(terminal, headings, rows, right=(False, False, *[True] * 6), fold=True)
    if not recordings:
        terminal.print_line("no recordings; `tracklake ingest SOURCE` adds some")


def _show_stages(terminal: Terminal, stages: Sequence[StageState]) -> None:
    rows = []
    for state in stages:
        reasons = Counter(state.stale.values())
        shown = [f"{reason} ({count})" if count > 1 else reason for reason, count in reasons.most_common(MAX_REASONS)]
        more = [f"and {len(reasons) - MAX_REASONS} more, see --json"] if len(reasons) > MAX_REASONS else []
        rows.append([state.stage, str(state.done), str(state.possible), "; ".join(shown + more) or "up to date"])
        if state.note:
            terminal.print_line(f"note: {state.note}", style="dim")
    print_table(terminal, ("stage", "done", "of", "state"), rows, right=(False, True, True, False))
