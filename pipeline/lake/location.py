"""Where lakes are: other commands' output must not be written into one."""

import os
from pathlib import Path

from tracklake.pipeline.lake.catalog import CATALOG
from tracklake.pipeline.lake.errors import LakeError, LakeMissingError
from tracklake.pipeline.lake.manifest import read_root


def find_lake(path: Path) -> Path | None:
    """Return the lake that a path lies in or is, whether by its name or by the links in it; None: in no lake."""
    named = Path(os.path.abspath(path))  # noqa: PTH100  (Path.absolute keeps "..")
    folders = (folder for place in (named, Path(os.path.realpath(path))) for folder in (place, *place.parents))
    return next(filter(_is_lake, folders), None)


def refuse_lake(out: Path | None, option: str = "--out") -> None:
    """Refuse an output inside of any lake, whose files it would replace or be deleted with.

    Args:
        out: the place; None: there is none.
        option: option that names it, for the message.

    Raises:
        LakeError: it lies in a lake.
    """
    lake = None if out is None else find_lake(out)
    if lake is not None:
        raise LakeError(
            f"{out}: lies in the lake {lake}, which holds only its own files. Name another place with {option}."
        )


def _is_lake(folder: Path) -> bool:
    """Return whether a folder holds our manifest, or one that is damaged beside our catalog."""
    try:
        return "lake_id" in read_root(folder)
    except LakeMissingError:
        return False
    except LakeError:
        return (folder / CATALOG).exists()
