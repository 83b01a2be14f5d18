"""The user's own description of a file's columns: `--columns mapping.toml`."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from tracklake.pipeline.sources.source import SourceError
from tracklake.schemas.columns import FOOT_M, Dataset
from tracklake.schemas.raw_ngsim import RAW_NGSIM

LENGTH_UNITS = dict.fromkeys(("ft", "feet", "foot"), 1.0)
LENGTH_UNITS |= dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1 / FOOT_M) | {"cm": 0.01 / FOOT_M}
SPEED_UNITS = dict.fromkeys(("ft/s", "ft/sec", "feet/s", "feet/sec", "fps"), 1.0)
SPEED_UNITS |= dict.fromkeys(("m/s", "m/sec", "mps"), 1 / FOOT_M) | {"mph": 5280 / 3600}
SPEED_UNITS |= dict.fromkeys(("km/h", "kmh", "kph"), 1 / FOOT_M / 3.6)
ACCEL_UNITS = dict.fromkeys(("ft/s2", "ft/s^2", "ft/s\u00b2", "feet/s2", "ft/s/s"), 1.0)
ACCEL_UNITS |= dict.fromkeys(("m/s2", "m/s^2", "m/s\u00b2", "mps2", "m/s/s"), 1 / FOOT_M)
TIME_UNITS = {"ms": 1.0, "s": 1000.0, "sec": 1000.0, "seconds": 1000.0}
HEADWAY_UNITS = {unit: factor / 1000 for unit, factor in TIME_UNITS.items()}
UNITS: Mapping[str, Mapping[str, float]] = {
    **dict.fromkeys(("Local_X", "Local_Y", "v_length", "v_Width", "Space_Headway"), LENGTH_UNITS),
    "v_Vel": SPEED_UNITS,
    "v_Acc": ACCEL_UNITS,
    "Global_Time": TIME_UNITS,
    "Time_Headway": HEADWAY_UNITS,
}
"""Factors from a unit to NGSIM's own, by column."""

ESSENTIAL = ("Vehicle_ID", "Frame_ID", "Local_X", "Local_Y", "v_Vel")
"""Columns without which a file is no recording; without Global_Time its frames tell one recording."""
NGSIM_RATE_HZ = 10.0
"""Frames per second of all of NGSIM's recordings."""
COLUMNS = tuple(name for name in RAW_NGSIM.columns if name != "line")
"""Columns that a mapping can name."""


class ColumnMapping(BaseModel):
    """The meaning of a file's columns, their units, and what the file does not say of its recording.

    Args:
        columns: name of a column in the file, or its number from 1, by NGSIM's name.
        units: units that are not NGSIM's own, by NGSIM's name.
        dataset: `ngsim` for a file made of NGSIM's; `custom` for recordings of the user's own.
        lanes: main lanes of the road, if it is none of NGSIM's.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    columns: dict[str, str | int]
    units: dict[str, str] = Field(default_factory=dict)
    dataset: Dataset = "custom"
    rate_hz: float = Field(NGSIM_RATE_HZ, gt=0, le=1000)
    site: str | None = Field(None, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    lanes: int | None = Field(None, ge=1)

    @field_validator("columns")
    @classmethod
    def _check_columns(cls, columns: dict[str, str | int]) -> dict[str, str | int]:
        if unknown := sorted(set(columns) - set(COLUMNS)):
            raise ValueError(f"expected names among {', '.join(COLUMNS)}; got {', '.join(unknown)}")
        if missing := [name for name in ESSENTIAL if columns.get(name, "?") == "?"]:
            raise ValueError(f"expected all of {', '.join(ESSENTIAL)}; {', '.join(missing)} missing")
        if len({*map(str, columns.values())}) < len(columns):
            raise ValueError("expected each of the file's columns once")
        return columns

    @field_validator("units")
    @classmethod
    def _check_units(cls, units: dict[str, str]) -> dict[str, str]:
        for name, unit in units.items():
            if unit not in UNITS.get(name, {}):
                raise ValueError(f"{name}: expected one of {', '.join(UNITS.get(name, {})) or 'no unit'}; got {unit!r}")
        return units

    @model_validator(mode="after")
    def _check_dataset(self) -> "ColumnMapping":
        if self.dataset not in ("ngsim", "custom"):
            raise ValueError("expected the dataset ngsim or custom; the files of others need no mapping")
        if self.dataset == "ngsim" and self.rate_hz != NGSIM_RATE_HZ:
            raise ValueError(f"expected rate_hz {NGSIM_RATE_HZ:g} for the dataset ngsim; leave `dataset` out")
        return self


def load_mapping(path: Path) -> ColumnMapping:
    """Read a mapping from a TOML file.

    Raises:
        SourceError: the file cannot be read, or is no mapping.
    """
    try:
        return ColumnMapping(**tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        reason = error.strerror or str(error)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        reason = str(error)
    except ValidationError as error:
        reason = "; ".join(
            ".".join([*map(str, fault["loc"]), fault["msg"].removeprefix("Value error, ")][-2:]).replace(".", ": ", 1)
            for fault in error.errors()
        )
    raise SourceError(f"{path}: no column mapping ({reason}). docs/data.md shows one.")


def suggest_mapping(guesses: Mapping[str, str | int]) -> str:
    """Write a mapping for the user to complete: `?` where nothing is known of a column."""
    names = [*ESSENTIAL, *(name for name in COLUMNS if name in guesses and name not in ESSENTIAL)]
    lines = (f"{name} = {json.dumps(guesses.get(name, '?'))}" for name in names)
    first = 'dataset = "ngsim"  # leave this line out for recordings of your own'
    return "\n".join([first, "", "[columns]", *lines])
