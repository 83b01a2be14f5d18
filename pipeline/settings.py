"""Settings: files `tracklake.toml`, then the environment (`TRACKLAKE_*`), then options; and where each came from."""

import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from tracklake.schemas.errors import UsageError
from tracklake.schemas.files import SETTINGS_FILE
from tracklake.schemas.protocols import CSP, DRIVE_PROTOCOLS, PROTOCOLS, Protocol
from tracklake.schemas.split_recipes import SPLIT_NAMES, SplitName, SplitRecipe
from tracklake.schemas.text import suggest_name

PREFIX = "TRACKLAKE_"
"""Beginning of the names of environment variables that are settings."""
DEBUG = "TRACKLAKE_DEBUG"
"""Environment variable: if set to 1, every error shows its traceback, as with the option --debug."""
ENVIRONMENT, OPTION = "environment", "option"
"""Names of the sources of values that are variables, and that are given to a command or function."""
PROTOCOL_SETTINGS = ("min_future_s", "drop_error_findings", "nearest", "split")
"""Names of the settings that replace a protocol's own values."""

KINDS = {"int": "a whole number", "float": "a number", "bool": "true or false", "string": "a text"}
KINDS |= {"path": "a path", "list": "a list", "dict": "a table"}
"""Words for kinds of values, by pydantic's names."""

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
            names = (PREFIX + "__".join(part).upper() for part in (key, key[:1]))
            return next((name for name in names if name in map(str.upper, os.environ)), self.name)
        return f"{self.name}:{self.lines[key]}" if key in self.lines else self.name


class Settings(BaseModel):
    """All settings of the pipeline; each is part of the fingerprints of the tables that it influences."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True)

    lake: Path = Field(Path("lake"), description="folder of the lake")
    columns: Path | None = Field(None, description="mapping of the columns of raw files in a format of their own")
    recording: str | None = Field(
        None,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$",
        description="name of the recording of a file without usable times; none: the file's name",
    )
    workers: int = Field(min(os.cpu_count() or 1, 4), ge=1, description="recordings worked on at once")
    runner: Literal["threads", "dask"] = Field(
        "threads", description="where recordings are worked on: threads of this process, or Dask workers"
    )
    refusals_fail: bool = Field(
        False, description="a Prefect run that refused files ends as Failed, not as CompletedWithRefusals"
    )
    dask_address: str | None = Field(None, description="address of a Dask scheduler; none: a cluster on this machine")
    thresholds: dict[str, float] = Field(
        default_factory=dict, description="thresholds of the rules by name, such as high_acceleration_mps2"
    )
    max_backward_share: float = Field(
        0.01, ge=0, le=1, description="a subset with a larger share of vehicles driving backwards is excluded"
    )
    car_following_min_s: float = Field(2.0, ge=0, description="car_following: shortest episode, s")
    on_ramp_lanes: dict[str, list[Annotated[int, Field(ge=1)]]] = Field(
        default_factory=dict, description="lanes that are on-ramps by site, where the source does not state them"
    )
    protocol: str = Field(CSP.name, description="name of the protocol")
    min_future_s: float | None = Field(
        None, gt=0, description="future track that a sample needs, s, up to the horizon; none: the protocol's"
    )
    drop_error_findings: bool | None = Field(
        None,
        description="no samples where the vehicle breaks a rule of severity error in the history or the horizon; none: "
        "the protocol's",
    )
    nearest: int | None = Field(
        None, ge=0, le=100, description="nearest vehicles listed with each sample, 0 = none; none: the protocol's"
    )
    validation_part: bool = Field(
        False,
        description="10 % of a split are a validation part, taken from the training part (70 / 10 / 20, not 80 / 20 %)",
    )
    split: SplitName | None = Field(None, description="split that tensors are made of; none: the protocol's")
    splits: list[SplitName] = Field(
        list(SPLIT_NAMES), description="splits that are made; tensors are made of one of them"
    )
    tensor_positions: Literal["float32", "int16-decimetres", "int16-centimetres"] = Field(
        "float32", description="how tensors store positions; int16 halves them and rounds along the road"
    )
    onboard_lidar: bool = Field(True, description="drives: LiDAR is used to track the vehicles around the ego")
    onboard_camera: bool = Field(True, description="drives: camera boxes are used to track the vehicles around the ego")
    split_seed: int = Field(0, ge=0, description="seed of the splits' searches and draws")
    split_block_s: float = Field(120.0, ge=10, description="time-blocks: length of a block, s")
    split_purge_s: float = Field(8.0, ge=0, description="time-blocks: s between blocks, at least history and future")
    drop_cut_samples: bool = Field(
        False, description="time-blocks: samples of val and eval with a neighbor that is cut off are left out"
    )

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  (settings are of several types)
        """Read the settings from files and environment, with these options on top.

        Raises:
            SettingError: a setting is unknown, out of its bounds or cannot be read.
        """
        sources = read_sources(options)
        try:
            super().__init__(**merge_sources(sources))
        except ValidationError as error:
            problems = [
                (tuple(map(str, each["loc"])), _describe_problem(each), each["input"]) for each in error.errors()
            ]
            raise _make_error(problems, sources) from error
        if self.thresholds:  # the rules' modules are imported only where some are set
            from tracklake.quality_reports.rules.registry import ALL_RULES, find_threshold_faults

            faults = find_threshold_faults(ALL_RULES, self.thresholds).items()
            if faults:
                found = [(("thresholds", name), fault, self.thresholds[name]) for name, fault in faults]
                raise _make_error(found, sources)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans(cls, value: object, info: ValidationInfo) -> object:
        """Refuse true and false where a number is expected, for which pydantic takes 1 and 0."""
        is_switch = "bool" in str(cls.model_fields[str(info.field_name)].annotation)
        held = value.values() if isinstance(value, Mapping) else [value]
        if not is_switch and any(isinstance(each, bool) for each in held):
            raise ValueError("expected a number or a text, not true or false")
        return value

    @field_validator("protocol")
    @classmethod
    def _check_protocol(cls, name: str) -> str:
        if name in DRIVE_PROTOCOLS:
            drives = f"{name} is for drives, and `tracklake onboard` uses it by itself"
            raise ValueError(f"{drives}; expected one of {', '.join(PROTOCOLS)}")
        if name not in PROTOCOLS:
            raise ValueError(f"no protocol is called {name}; {suggest_name(name, PROTOCOLS)}")
        return name

    @field_validator("min_future_s")
    @classmethod
    def _check_min_future(cls, seconds: float | None, others: ValidationInfo) -> float | None:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        if seconds is not None and protocol is not None and seconds > protocol.horizon_s:
            raise ValueError(f"expected {protocol.horizon_s:g} or less, the horizon of the protocol {protocol.name}")
        return seconds

    @field_validator("splits")
    @classmethod
    def _check_splits(cls, names: list[SplitName], others: ValidationInfo) -> list[SplitName]:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        trains = others.data.get("split") or (protocol.split if protocol is not None else None)
        if trains not in (None, *names):
            raise ValueError(f"expected {trains!r} among them, the split that tensors are made of")
        return names

    @field_validator("split_purge_s")
    @classmethod
    def _check_purge(cls, purge_s: float, others: ValidationInfo) -> float:
        protocol = PROTOCOLS.get(others.data.get("protocol", ""))
        if protocol is not None and purge_s < protocol.history_s + protocol.horizon_s:
            raise ValueError(f"expected {protocol.history_s + protocol.horizon_s:g} or more, history and future")
        return purge_s

    def get_protocol(self) -> Protocol:
        """Return the protocol with the settings that change it."""
        changes: dict[str, Any] = {name: getattr(self, name) for name in PROTOCOL_SETTINGS}
        return replace(
            PROTOCOLS[self.protocol], **{name: value for name, value in changes.items() if value is not None}
        )

    def get_split_recipe(self, name: str | None = None) -> SplitRecipe:
        """Return the recipe of a split; None: of the protocol's."""
        trains = name or self.get_protocol().split
        return next(recipe for recipe in self.get_split_recipes() if recipe.name == trains)

    def get_split_recipes(self) -> list[SplitRecipe]:
        """Return the recipes of all splits to make, in the order of SPLIT_NAMES."""
        protocol = self.get_protocol()
        return [
            SplitRecipe(
                name=name,
                train_share=protocol.train_share,
                validation=self.validation_part,
                seed=self.split_seed,
                block_s=self.split_block_s,
                purge_s=self.split_purge_s,
                rate_hz=protocol.rate_hz,
                history_s=protocol.history_s,
                horizon_s=protocol.horizon_s,
                min_future_s=protocol.min_future_s,
            )
            for name in SPLIT_NAMES
            if name in self.splits
        ]


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
    lake = merge_sources(sources).get("lake", Settings.model_fields["lake"].default)
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
    for field, declared in Settings.model_fields.items():
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
    tables = {name for name, field in Settings.model_fields.items() if field.default_factory is dict}
    for name, value in values.items():
        is_table = name in tables and isinstance(value, Mapping)
        yield from ((name, inner) for inner in value) if is_table else [(name,)]


def find_unknown_variables() -> list[str]:
    """Return messages about environment variables that look like settings and are none.

    They are no errors: others may set them, as Kubernetes does for a service called tracklake.
    """
    known = {f"{PREFIX}{name.upper()}": field for name, field in Settings.model_fields.items()}
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
    """Read a file of settings; relative paths in it are relative to its folder."""
    try:
        text = path.read_text(encoding="utf-8")
        values = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise SettingError(f"{path}: {error}") from error
    for name in ("lake", "columns"):
        if isinstance(values.get(name), str):
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


def _describe_problem(problem: Any) -> str:  # noqa: ANN401  (a TypedDict that pydantic keeps private)
    """Return what was expected where pydantic found something else."""
    if problem["type"] == "extra_forbidden":
        return f"unknown setting; {suggest_name(str(problem['loc'][0]), Settings.model_fields)}"
    words = {"ge": "{:g} or more", "gt": "more than {:g}", "le": "{:g} or less"}
    if {*problem.get("ctx", {})} & {*words}:
        declared = Settings.model_fields[problem["loc"][0]].metadata
        limits = {name: getattr(each, name) for each in declared for name in words if hasattr(each, name)}
        bounds = [words[name].format(limit) for name, limit in (limits or problem["ctx"]).items()]
        return f"expected {' and '.join(bounds)}"
    kind = problem["type"]
    if kind == "string_pattern_mismatch":
        return "expected letters, digits, `.`, `_` and `-`"
    if kind in ("int_from_float", *(f"{name}_{what}" for name in KINDS for what in ("type", "parsing"))):
        return f"expected {KINDS[kind.partition('_')[0]]}"
    return re.sub("^Input should be ", "expected ", problem["msg"].removeprefix("Value error, "))


def _make_error(problems: Sequence[tuple[Key, str, object]], sources: Sequence[SettingSource]) -> SettingError:
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
        if part in list_keys(source.values)
    )
    return next(found, None)
