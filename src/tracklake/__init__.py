"""tracklake: highway trajectory recordings to a clean Parquet lake, quality reports, splits and tensors.

    lake = tracklake.open("lake")
    lake.sql("SELECT subset, vehicles FROM subsets").pl()

See docs/python.md.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tracklake.pipeline.lake.lake import Lake as Lake
    from tracklake.pipeline.lake.lake import open_lake as open
    from tracklake.pipeline.orchestration.api import run as run
    from tracklake.schemas.errors import TracklakeError as TracklakeError

    __version__: str

__all__ = ["Lake", "TracklakeError", "__version__", "open", "run"]

_PUBLIC = {
    "Lake": ("tracklake.pipeline.lake.lake", "Lake"),
    "TracklakeError": ("tracklake.schemas.errors", "TracklakeError"),
    "open": ("tracklake.pipeline.lake.lake", "open_lake"),
    "run": ("tracklake.pipeline.orchestration.api", "run"),
}

_package = Path(__file__).resolve().parent
if not (_package / "pipeline").exists():
    # In a checkout the packages stand at the top of the repository; in an installed wheel they stand in this folder.
    __path__.append(str(_package.parents[1]))


def __getattr__(name: str) -> Any:  # noqa: ANN401  (module attributes of several types)
    """Import a public name when it is first used, so that `import tracklake` costs nothing."""
    if name == "__version__":
        from importlib.metadata import version

        return version("tracklake")
    if name in _PUBLIC:
        module, attribute = _PUBLIC[name]
        return getattr(import_module(module), attribute)
    raise AttributeError(f"module 'tracklake' has no attribute {name!r}")
