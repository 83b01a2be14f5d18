"""Options that several commands take, each with one name and one meaning."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

FolderOption = Annotated[
    Path | None, typer.Option("--lake", metavar="DIR", help="Folder of the lake (or TRACKLAKE_LAKE; default: lake).")
]
LakeOption = Annotated[
    Path | None,
    typer.Option(
        "--lake",
        metavar="DIR|ADDRESS",
        help="Folder of the lake, or s3://bucket/lake (or TRACKLAKE_LAKE; default: lake).",
    ),
]
WorkersOption = Annotated[
    int | None, typer.Option("--workers", min=1, help="Recordings worked on at once (or TRACKLAKE_WORKERS).")
]
ProtocolOption = Annotated[
    str | None,
    typer.Option("--protocol", help="Protocol of samples, split and tensors (docs/protocols.md; default: csp)."),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and no progress.")]
DatasetOption = Annotated[
    str | None,
    typer.Option(
        "--dataset", help="Read SOURCE as this only: ngsim, highd, exid, ind, round, tgsim, i24, custom or v2v."
    ),
]
ColumnsOption = Annotated[
    Path | None,
    typer.Option("--columns", metavar="FILE", help="TOML file that names the columns of SOURCE (docs/data.md)."),
]
RecordingOption = Annotated[
    str | None,
    typer.Option("--recording", help="Name of the recording, where times do not tell it; I-24: of all of it."),
]
OnlyDatasetOption = Annotated[
    str | None,
    typer.Option("--dataset", help="Only samples of this dataset (ngsim, highd, exid, tgsim, i24 or custom)."),
]
OnlyRecordingOption = Annotated[
    str | None, typer.Option("--recording", help="Only samples of this recording or subset (us-101-0750, 01-upper).")
]
ReplaceOption = Annotated[
    bool, typer.Option("--replace", help="Let SOURCE's files replace a recording's earlier files that SOURCE lacks.")
]
PruneOption = Annotated[
    bool, typer.Option("--prune", help="Remove recordings whose files were in SOURCE, a folder, and are missing now.")
]
RebuildOption = Annotated[
    bool,
    typer.Option("--rebuild", help="Recreate the lake in its place, also one of another schema version; redo all."),
]
MinutesOption = Annotated[float | None, typer.Option("--minutes", help="Length of the generated recordings.")]
SeedOption = Annotated[int | None, typer.Option("--seed", help="Seed of the generated sample: same seed, same bytes.")]


def require_choice(option: str, value: str | None, choices: tuple[str, ...]) -> None:
    """Refuse a value that is given and is none of an option's choices."""
    if value is not None and value not in choices:
        raise typer.BadParameter(f"{option} is one of {', '.join(choices)}; got {value!r}")


def read_pairs(pairs: list[str], known: Mapping[str, Any], owner: str) -> dict[str, Any]:
    """Read NAME=VALUE pairs of `--set`, each value in the type of its default.

    Args:
        pairs: arguments as given.
        known: settings with their defaults; a default of None allows every type.
        owner: model or method that has these settings, for messages.
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
