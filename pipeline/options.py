"""Options that several commands take, each with one name and one meaning."""

from pathlib import Path
from typing import Annotated

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
