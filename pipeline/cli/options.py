"""Options that several commands take, each with one name and one meaning."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

LakeOption = Annotated[
    Path | None, typer.Option("--lake", metavar="DIR", help="Folder of the lake (or TRACKLAKE_LAKE; default: lake).")
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", min=1, help="Recordings worked on at once (or TRACKLAKE_WORKERS).")
]
ProtocolOption = Annotated[
    str | None, typer.Option("--protocol", help="Whose samples, split and tensors (docs/protocols.md) [default: csp].")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and no progress.")]


def read_pairs(pairs: list[str], known: Mapping[str, Any], owner: str) -> dict[str, Any]:
    """NAME=VALUE pairs of `--set`, each value of the kind that its default is of.

    Args:
        pairs: as given.
        known: what can be set, with its defaults; None: of any kind.
        owner: whose settings these are.
    """
    read: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or name not in known:
            raise typer.BadParameter(f"--set NAME=VALUE: {owner} has {', '.join(known)}; got {pair!r}")
        read[name] = _read_value(pair, text, known[name])
    return read


def _read_value(pair: str, text: str, default: object) -> object:
    try:
        value = json.loads(text)
    except ValueError:
        value = text
    if isinstance(default, float) and type(value) is int:
        value = float(value)
    if default is not None and type(value) is not type(default):
        raise typer.BadParameter(f"--set {pair}: expected {type(default).__name__} like {default}")
    return value
