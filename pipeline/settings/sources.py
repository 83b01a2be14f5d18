"""Places that settings come from: files `tracklake.toml`, then the environment (`TRACKLAKE_*`), then options."""

import json
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_origin

from tracklake.pipeline.settings.fields import DeclaredSettings
from tracklake.schemas.errors import UsageError
from tracklake.schemas.files import SETTINGS_FILE
from tracklake.schemas.text import suggest_name
from tracklake.schemas.validation import BOUNDS, describe_fault

PREFIX = "TRACKLAKE_"
"""Beginning of the names of environment variables that are settings."""
DEBUG = "TRACKLAKE_DEBUG"
"""Environment variable: if set to 1, every error shows its traceback, as with the option --debug."""
ENVIRONMENT, OPTION = "environment", "option"
"""Names of the sources of values that are variables, and that are given to a command or function."""

Key = tuple[str, ...]
"""Name of a setting, and with a table of settings such as `thresholds` the name in it."""


class SettingError(UsageError, ValueError):
    """A setting is unknown, out of its bounds or cannot be read; the message names where it stands."""


@dataclass(frozen=True)
class SettingSource:
    """A place that settings come from.

    Args:
        name: path of a file, `environment`, or `option`.
        values: settings by name, as they are given.
        lines: number of the line of each setting in a file.
    """

    name: str
    values: Mapping[str, Any]
    lines: Mapping[Key, int]

    def locate(self, key: Key) -> str:
        """Return where a setting stands: file and line, variable, or `option`."""
        if self.name == ENVIRONMENT:
            variables = sorted(map(str.upper, os.environ))
            names = [PREFIX + "__".join(part).upper() for part in (key, key[:1])]
            within = [name for name in variables if name.startswith(f"{names[-1]}__")]
            return next((name for name in [*names, *within] if name in variables), self.name)
        line = next((line for own, line in self.lines.items() if own[: len(key)] == key), None)
        return self.name if line is None else f"{self.name}:{line}"


def read_sources(options: Mapping[str, Any]) -> list[SettingSource]:
    """Read all places that settings come from, the weakest first.

    Those are the first tracklake.toml in the working folder or one above it, that of the lake's folder, the
    environment, and the options.

    Raises:
        SettingError: a file or variable cannot be read, or the lake's own file names a lake.
    """
    found = find_file()
    sources = [] if found is None else [_read_file(found)]
    sources += [SettingSource(ENVIRONMENT, _read_environment(), {}), SettingSource(OPTION, options, {})]
    lake = merge_sources(sources).get("lake", DeclaredSettings.model_fields["lake"].default)
    own = Path(lake) / SETTINGS_FILE if isinstance(lake, str | Path) else Path(SETTINGS_FILE)
    if _is_file(own) and not (found is not None and own.samefile(found)):
        of_lake = _read_file(own)
        if "lake" in of_lake.values:
            raise SettingError(f"{of_lake.locate(('lake',))}: a lake's own file names no lake; remove the line")
        sources.insert(-2, of_lake)
    return sources


def _read_environment() -> dict[str, Any]:
    """Return the settings of the variables TRACKLAKE_NAME, and TRACKLAKE_NAME__KEY of tables; empty ones are not set.

    Lists and tables are written as JSON.
    """
    variables = {name.upper(): text for name, text in os.environ.items() if text}
    found: dict[str, Any] = {}
    for field, declared in DeclaredSettings.model_fields.items():
        name = f"{PREFIX}{field.upper()}"
        is_json = get_origin(declared.annotation) in (dict, list)
        if name in variables:
            found[field] = _read_json(name, variables[name]) if is_json else variables[name]
        if get_origin(declared.annotation) is dict:
            table = {
                each.removeprefix(f"{name}__").lower(): _read_json(each, text) if text.startswith("[") else text
                for each, text in sorted(variables.items())
                if each.startswith(f"{name}__")
            }
            whole = found.get(field, {})
            if table and isinstance(whole, Mapping):
                found[field] = {**whole, **table}
    return found


def _read_json(name: str, text: str) -> Any:  # noqa: ANN401  (JSON holds values of any type)
    """Return the value of a variable written as JSON."""
    try:
        return json.loads(text)
    except ValueError as error:
        raise SettingError(f'{name}: expected JSON such as ["a"] or {{"a": 1}}, got {text!r}') from error


def list_files(lake: Path) -> list[str]:
    """Return the paths of the files of settings that hold for a lake."""
    return [source.name for source in read_sources({"lake": lake}) if source.name not in (ENVIRONMENT, OPTION)]


def find_file() -> Path | None:
    """Return the first tracklake.toml in the working folder or one above it."""
    try:
        here = Path.cwd()
    except OSError:  # the working folder was deleted
        return None
    if _is_file(Path(SETTINGS_FILE)):
        return Path(SETTINGS_FILE)
    return next((folder / SETTINGS_FILE for folder in here.parents if _is_file(folder / SETTINGS_FILE)), None)


def _is_file(path: Path) -> bool:
    return os.path.isfile(path)  # noqa: PTH113  (that of Path raises an error in a folder without rights)


def merge_sources(sources: Sequence[SettingSource]) -> dict[str, Any]:
    """Return the values of all sources, of which later ones win; tables such as `thresholds` are joined."""
    merged: dict[str, Any] = {}
    for source in sources:
        for name, value in source.values.items():
            before = merged.get(name)
            is_table = isinstance(value, Mapping) and isinstance(before, Mapping)
            merged[name] = {**(before or {}), **value} if is_table else value
    return merged


def list_keys(values: Mapping[str, Any]) -> Iterator[Key]:
    """Yield the keys of settings, and instead of that of a table of settings those in it."""
    tables = {name for name, field in DeclaredSettings.model_fields.items() if field.default_factory is dict}
    for name, value in values.items():
        is_table = name in tables and isinstance(value, Mapping)
        yield from ((name, inner) for inner in value) if is_table else [(name,)]


def find_unknown_variables() -> list[str]:
    """Return messages about environment variables that look like settings and are none.

    They are no errors: others may set them, as Kubernetes does for a service called tracklake.
    """
    known = {f"{PREFIX}{name.upper()}": field for name, field in DeclaredSettings.model_fields.items()}
    tables = tuple(f"{name}__" for name, field in known.items() if field.default_factory is dict)
    messages = []
    for name in sorted(os.environ):
        upper = name.upper()
        if upper.startswith(PREFIX) and upper not in (*known, DEBUG) and not upper.startswith(tables):
            hint = suggest_name(upper, (*known, DEBUG))
            hint = hint if hint.endswith("?") else "`tracklake config` lists the settings"
            messages.append(f"{name}: no setting has this name, so it has no effect; {hint}")
    return messages


def _read_file(path: Path) -> SettingSource:
    """Read a file of settings; relative paths in it are relative to its folder, addresses are not."""
    try:
        text = path.read_text(encoding="utf-8")
        values = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise SettingError(f"{path}: {error}") from error
    for name in ("lake", "columns", "cache"):
        if isinstance(values.get(name), str) and "://" not in values[name]:
            values[name] = str(path.parent / values[name])
    return SettingSource(str(path), values, _find_lines(text))


def _find_lines(text: str) -> dict[Key, int]:
    """Return the line on which each setting of a TOML text begins: where the text up to its end first has it."""
    lines = text.splitlines()
    found: dict[Key, int] = {}
    begin = 1
    for end in range(1, len(lines) + 1):
        try:
            values = tomllib.loads("\n".join(lines[:end]))
        except tomllib.TOMLDecodeError:
            continue  # within a value of several lines
        found |= {key: begin for key in list_keys(values) if key not in found}
        begin = end + 1
    return found


def describe_problem(problem: Any) -> str:  # noqa: ANN401  (a TypedDict that pydantic keeps private)
    """Return what was expected where pydantic found something else."""
    if problem["type"] == "extra_forbidden":
        return f"unknown setting; {suggest_name(str(problem['loc'][0]), DeclaredSettings.model_fields)}"
    if problem["type"] == "string_pattern_mismatch":
        return "expected letters, digits, `.`, `_` and `-`"
    if {*problem.get("ctx", {})} & {*BOUNDS}:  # pydantic tells one bound; both are shown
        declared = DeclaredSettings.model_fields[problem["loc"][0]].metadata
        limits = {name: getattr(each, name) for each in declared for name in BOUNDS if hasattr(each, name)}
        return describe_fault({**problem, "ctx": limits or problem["ctx"]})
    return describe_fault(problem)


def make_error(problems: Sequence[tuple[Key, str, object]], sources: Sequence[SettingSource]) -> SettingError:
    """Return the error about some settings: where each stands, its name, what was expected and what was found."""
    lines = []
    for key, expected, got in problems:
        where = locate_setting(key, sources)
        place = "" if where in (OPTION, None) else f"{where}: "
        lines.append(f"{place}setting {'.'.join(key)}: {expected}" + ("" if expected[-1] == "?" else f", got {got!r}"))
    return SettingError("\n".join(lines))


def locate_setting(key: Key, sources: Sequence[SettingSource]) -> str | None:
    """Return where the value in force of a setting stands; None: nowhere, so that it is the default."""
    found = (
        source.locate(part)
        for part in (key[:2], key[:1])
        for source in reversed(sources)
        if any(own == part or own[: len(key)] == key for own in list_keys(source.values))
    )
    return next(found, None)
