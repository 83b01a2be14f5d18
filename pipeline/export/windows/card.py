"""The card beside exported windows: contents, provenance and licence."""

import json
import math
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import polars as pl

from tracklake.pipeline.export.provenance import describe_licences, describe_provenance
from tracklake.pipeline.export.windows.files import list_columns, list_npz_arrays
from tracklake.pipeline.export.windows.result import WindowsExport
from tracklake.schemas.columns import PARTS
from tracklake.training.data.tensor_folder import TensorFolder

RELATIVE = """\
Positions are in m, relative to the sample's last position (`origin`, the front centre on the carriageway): x along the
direction of travel, y across it, positive to the driver's right.
"""
ABSOLUTE = """\
Positions are in m on the carriageway: x of the front centre along the direction of travel, y from the carriageway's
left edge, positive to the driver's right. `origin` is the sample's last position.
"""
LOADING = {
    "parquet": """\
```python
import polars as pl

train = pl.read_parquet("train.parquet")
```
""",
    "npz": """\
```python
import numpy as np

train = np.load("train.npz")
history, future, known = train["history"], train["future"], train["future_mask"]
```
""",
}


def write_card(path: Path, export: WindowsExport, folder: TensorFolder, facts: pl.DataFrame) -> None:
    """Write the card, with facts of the subsets from `read_facts`; the same export gives the same bytes."""
    command = f"tracklake export {'windows' if export.format == 'parquet' else 'npz'}"
    lines = [
        f"# Trajectory windows: protocol {folder.protocol.name}, split {folder.split}",
        "",
        f"Written by tracklake {version('tracklake')}: `{command}{' --absolute' if export.absolute else ''}`.",
        "",
        *([f"**{export.synthetic}**", ""] if export.synthetic else []),
        *_describe_counts(export, folder),
        *describe_licences(facts, "Windows"),
        *describe_provenance(facts),
        *_describe_protocol(folder),
        *_describe_split(folder.index),
        "## What the files hold",
        "",
        ABSOLUTE if export.absolute else RELATIVE,
        _bound_errors(folder.index, absolute=export.absolute),
        "",
        *_describe_columns(export, folder),
        "",
        LOADING[export.format],
    ]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _describe_counts(export: WindowsExport, folder: TensorFolder) -> list[str]:
    lines = ["## Counts", "", "| file | samples | neighbors | subsets |", "| --- | ---: | ---: | --- |"]
    for part in PARTS:
        subsets = ", ".join(sorted(folder.subsets_of(part))) or "-"
        counts = f"{export.samples[part]:,} | {export.neighbors[part]:,}"
        lines.append(f"| {part}.{export.format} | {counts} | {subsets} |")
    return [*lines, ""]


def _describe_protocol(folder: TensorFolder) -> list[str]:
    protocol = folder.protocol
    return [
        "## Protocol",
        "",
        *(f"- {name}: {value}" for name, value in folder.index["protocol"].items()),
        f"- H = {protocol.history_ticks} positions of history, the sample's own included; F = "
        f"{protocol.horizon_ticks} of future",
        "",
    ]


def _describe_split(index: Mapping[str, Any]) -> list[str]:
    """Describe the split's recipe and blocks."""
    recipe = index["split_recipe"]
    lines = [
        "## Split",
        "",
        f"- recipe: {recipe['digest']}",
        *(f"- {name}: {value}" for name, value in recipe["parameters"].items()),
        f"- vehicles left out of val and eval: {recipe['left_out_vehicles']:,}",
        "",
        "| subset | block | frames | vehicles | part |",
        "| --- | ---: | --- | --- | --- |",
    ]
    for block in index["blocks"]:
        low, high = block["first_vehicle_id"], block["last_vehicle_id"]
        ends = ("first" if low is None else low, "last" if high is None else high)
        vehicles = "all" if low is None and high is None else f"{ends[0]} to {ends[1]}"
        frames = f"{block['first_frame']} to {block['last_frame']}"
        subset = f"{block['dataset']}/{block['subset']}"
        lines.append(f"| {subset} | {block['block']} | {frames} | {vehicles} | {block['part']} |")
    return [*lines, ""]


def _bound_errors(index: Mapping[str, Any], *, absolute: bool) -> str:
    """Describe the largest rounding error of positions; a difference of two positions has up to twice that error."""
    largest_mm = [(1 if absolute else 2) * 1000 * error for error in index["max_error_m"]]
    # Rounded up, plus float32's own error: differences of up to 400 m are exact to 0.04 mm.
    along, across = (f"{math.ceil((error + 0.04) * 10) / 10:g}" for error in largest_mm)
    text = f"Positions were stored as {index['storage']}; the rounding error is at most {along} mm along the road and "
    if absolute:
        return f"{text}{across} mm across it."
    return f"{text}{across} mm across it (each is the difference of two stored ones), half of that in `origin`."


def _describe_columns(export: WindowsExport, folder: TensorFolder) -> list[str]:
    """Build a table of columns or arrays: name, type, meaning."""
    if export.format == "parquet":
        columns = list_columns(folder).items()
        rows = [f"| {name} | {_name_type(str(dtype))} | {meaning} |" for name, (dtype, meaning) in columns]
        return ["| column | type | meaning |", "| --- | --- | --- |", *rows]
    rows = [
        f"| {name} | {dtype} | {json.dumps(shape).replace(chr(34), '')} | {meaning} |"
        for name, (dtype, shape, meaning) in list_npz_arrays(folder).items()
    ]
    rows.append("| subsets | str | [subsets] | data set and subset, by the numbers in `subset` |")
    return ["| array | dtype | shape (S samples, K neighbors) | meaning |", "| --- | --- | --- | --- |", *rows]


def _name_type(arrow_type: str) -> str:
    """Shorten the name of an Arrow type."""
    if arrow_type.startswith("dictionary"):
        return "string"
    return arrow_type.replace("element: ", "").replace("item: ", "")
