"""The `config.json` of a trained run, read from disk and checked."""

from pathlib import Path
from typing import Any

from tracklake.schemas.documents import read_json
from tracklake.schemas.errors import TracklakeError

RUN_VERSION = 2
"""Number of the run folder's layout; it grows when older runs cannot be read."""

AGAIN = "train it again"
KINDS = {"model": str, "parameters": dict, "protocol": dict, "train_subsets": list, "val_subsets": list, "blocks": list}
"""Keys that a run's config must hold, and their types."""


class StaleRunError(TracklakeError):
    """A run cannot be evaluated on these tensors: it was trained for others, is unfinished, or is damaged."""


def read_config(path: Path) -> dict[str, Any]:
    """Read a run's `config.json`; StaleRunError where it is of another version, or damaged."""
    file = path / "config.json"
    try:
        config = read_json(file)
    except ValueError as broken:
        raise StaleRunError(f"{file}: not readable as JSON ({broken}); {AGAIN}") from None
    version = config.get("version") if isinstance(config, dict) else f"a {type(config).__name__}"
    if version != RUN_VERSION:
        raise StaleRunError(f"{file}: expected version {RUN_VERSION}, got {version}; {AGAIN}")
    config = {"val_subsets": [], **config}
    lacking = sorted(name for name, kind in KINDS.items() if not isinstance(config.get(name), kind))
    if not lacking and not {"name", "digest"} <= config["protocol"].keys():
        lacking = ["the name and digest of a protocol"]
    if not lacking and not all(isinstance(name, str) for name in config["train_subsets"] + config["val_subsets"]):
        lacking = ["names of subsets"]
    if lacking:
        raise StaleRunError(f"{file}: expected {', '.join(lacking)} in it; {AGAIN}")
    return config
