"""Extras of the distribution: packages that only some commands need, and the message where they are missing."""

from importlib.util import find_spec

from tracklake.schemas.errors import MissingExtraError

EXTRAS = {
    "flows": ("prefect",),
    "report": ("altair", "vl_convert"),
    "training": ("torch",),
    "forest": ("sklearn", "skops"),
    "matlab": ("scipy",),
    "reconstruct": ("scipy",),
    "sample": ("sumo",),
    "distributed": ("distributed",),
    "object-store": ("obstore", "duckdb_extension_httpfs", "duckdb_extension_aws"),
    "ducklake": ("duckdb_extension_ducklake",),
    "onboard": ("pyproj", "rosbags", "scipy", "sklearn"),
}
"""Modules that each extra installs, by the extra's name in pyproject.toml."""


def find_missing(extra: str) -> list[str]:
    """Return the modules of an extra that are not installed."""
    return [name for name in EXTRAS[extra] if find_spec(name) is None]


def require_extras(what: str, *extras: str) -> None:
    """Refuse work whose packages are not installed.

    Args:
        what: subject of the message, for instance a command.
        extras: names of EXTRAS.

    Raises:
        MissingExtraError: naming what is missing and the command that installs it.
    """
    missing = {extra: names for extra in extras if (names := find_missing(extra))}
    if missing:
        packages = ", ".join(name for names in missing.values() for name in names)
        raise MissingExtraError(
            f"{what} needs the extra{'s' * (len(missing) > 1)} {' and '.join(f'[{extra}]' for extra in missing)} "
            f'(not installed: {packages}): pip install "tracklake[{",".join(missing)}]"'
        )
