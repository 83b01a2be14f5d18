"""Settings of the pipeline: declared in `fields`, read by `sources` from files, the environment and options."""

from typing import Any

from pydantic import ValidationError

from tracklake.pipeline.settings.fields import PROTOCOL_SETTINGS, DeclaredSettings
from tracklake.pipeline.settings.sources import (
    DEBUG,
    OPTION,
    Key,
    SettingError,
    describe_problem,
    find_unknown_variables,
    list_files,
    locate_setting,
    make_error,
    merge_sources,
    read_sources,
)

__all__ = [
    "DEBUG",
    "OPTION",
    "PROTOCOL_SETTINGS",
    "Key",
    "SettingError",
    "Settings",
    "find_unknown_variables",
    "list_files",
    "locate_setting",
    "read_sources",
]


class Settings(DeclaredSettings):
    """All settings of the pipeline, read from files, the environment and options."""

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
                (tuple(map(str, each["loc"])), describe_problem(each), each["input"]) for each in error.errors()
            ]
            raise make_error(problems, sources) from error
        if self.thresholds:  # the rules' modules are imported only where some are set
            from tracklake.quality_reports.rules.registry import ALL_RULES, find_threshold_faults

            faults = find_threshold_faults(ALL_RULES, self.thresholds).items()
            if faults:
                found = [(("thresholds", name), fault, self.thresholds[name]) for name, fault in faults]
                raise make_error(found, sources)
