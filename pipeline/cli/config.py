"""`tracklake config`: the settings in force, and where each comes from."""

from json import dumps
from typing import Any

from tracklake.pipeline.cli.command import command, read_settings
from tracklake.pipeline.cli.options import JsonOption, LakeOption, ProtocolOption, WorkersOption
from tracklake.pipeline.cli.tables import print_table
from tracklake.pipeline.lake.object_store import find_address
from tracklake.pipeline.settings import (
    OPTION,
    PROTOCOL_SETTINGS,
    Key,
    Settings,
    find_unknown_variables,
    list_files,
    locate_setting,
    read_sources,
)
from tracklake.quality_reports.rules.registry import ALL_RULES, resolve
from tracklake.schemas.files import SETTINGS_FILE


def config(
    lake: LakeOption = None,
    protocol: ProtocolOption = None,
    workers: WorkersOption = None,
    json: JsonOption = False,
) -> None:
    """Show the settings in force, and where each comes from.

    Options override the environment, which overrides the lake's own tracklake.toml, which overrides the first
    tracklake.toml in the working folder or one above it.
    """
    with command(json=json) as terminal:
        given = {"lake": lake, "protocol": protocol, "workers": workers}
        settings = read_settings(lake=lake, protocol=protocol, workers=workers, in_folder=False)
        rows = _list_settings(settings, {name: value for name, value in given.items() if value is not None})
        files = list_files(settings.lake)
        terminal.print_line(
            f"files: {', '.join(files)}"
            if files
            else f"files: no {SETTINGS_FILE} here, in a folder above or in the lake"
        )
        cells = [[name, _format_value(row["value"]), row["from"]] for name, row in rows.items()]
        print_table(terminal, ("setting", "value", "from"), cells, right=(False, False, False))
        terminal.print_json({"files": files, "settings": rows, "warnings": find_unknown_variables()})


def _list_settings(settings: Settings, options: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return value and origin of every setting, and of every threshold, by name."""
    sources = read_sources(options)
    protocol = settings.get_protocol()
    values: dict[Key, Any] = {}
    lake = find_address(settings.lake) or str(settings.lake)
    for name, value in {**settings.model_dump(mode="json"), "lake": lake}.items():
        table = resolve(ALL_RULES, settings.thresholds) if name == "thresholds" else value
        values |= (
            {(name, inner): own for inner, own in table.items()}
            if table and isinstance(table, dict)
            else {(name,): value}
        )
    rows = {}
    for key, value in values.items():
        origin = locate_setting(key, sources) or "default"
        if value is None and key[0] in PROTOCOL_SETTINGS:
            value, origin = getattr(protocol, key[0]), f"protocol {protocol.name}"
        rows[".".join(key)] = {"value": value, "from": f"--{key[0]}" if origin == OPTION else origin}
    return rows


def _format_value(value: object) -> str:
    """Return a value as it stands in a file of settings; `none` where there is none."""
    return "none" if value is None else value if isinstance(value, str) else dumps(value)
