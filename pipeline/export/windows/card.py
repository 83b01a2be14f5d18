"""The card beside exported windows: what they hold, where they come from, what may be done with them."""

import json
import math
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl

from tracklake.pipeline.export.windows.files import npz_arrays, window_schema
from tracklake.schemas.columns import PARTS
from tracklake.training.data.tensor_folder import TensorFolder

if TYPE_CHECKING:
    from tracklake.pipeline.export.windows.export import WindowsExport

RELATIVE = """\
Positions are in m and relative to the sample's last position (`origin`, which is the front centre on the carriageway):
x along the direction of travel, y across it, positive to the driver's right.
"""
ABSOLUTE = """\
Positions are in m on the carriageway: x of the front centre along the direction of travel, y across it, from the
carriageway's left edge, positive to the driver's right. `origin` is the sample's last position.
"""
COLUMNS = {
    "dataset": "ngsim or highd",
    "subset": "one carriageway of one recording",
    "vehicle_id": "unique within the subset",
    "tick": "of the sample",
    "time_s": "since the recording's first frame, s",
    "lane": "1 is the driver's leftmost; null = unknown",
    "lateral_maneuver": "keep, left or right",
    "longitudinal_maneuver": "normal or brake",
    "origin_x_m": "the sample's last position on the carriageway, m",
    "origin_y_m": "likewise",
    "history_x_m": "up to the sample's tick, m",
    "history_y_m": "likewise",
    "future_x_m": "after it, m; null where unknown",
    "future_y_m": "likewise",
    "neighbor_cell": "of each neighbor: 13 * column + row of the grid (left, own, right; row 12 ahead), increasing",
    "neighbor_id": "its vehicle_id, in the same order",
    "neighbor_history_x_m": "its history, in the same order; null where unknown",
    "neighbor_history_y_m": "likewise",
}
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


def write_card(path: Path, export: "WindowsExport", folder: TensorFolder, facts: pl.DataFrame) -> None:
    """Write it; the same export gives the same bytes.

    Args:
        path: of the card.
        export: what is written.
        folder: the tensors.
        facts: of the subsets, see `pipeline.export.windows.export.read_facts`.
    """
    index, protocol = folder.index, folder.protocol
    asked = f"tracklake export {'windows' if export.format == 'parquet' else 'npz'}"
    lines = [
        f"# Trajectory windows: protocol {protocol.name}, split {folder.split}",
        "",
        f"Written by tracklake {version('tracklake')}: `{asked}{' --absolute' if export.absolute else ''}`.",
        "",
        "## Counts",
        "",
        "| file | samples | neighbors | subsets |",
        "| --- | ---: | ---: | --- |",
    ]
    for part in PARTS:
        named = ", ".join(sorted(folder.subsets_of(part))) or "-"
        counts = f"{export.samples[part]:,} | {export.neighbors[part]:,}"
        lines.append(f"| {part}.{export.format} | {counts} | {named} |")
    lines += ["", "## Licence", ""]
    lines += [f"- {note}" for note in export.notes]
    lines += [
        "",
        "Windows are the recordings' data in another form: the licence of each data set holds for them, too.",
        "",
        "## Provenance",
        "",
        "| subset | recording | vehicles | file | sha256 |",
        "| --- | --- | ---: | --- | --- |",
    ]
    for row in facts.iter_rows(named=True):
        for file in row["source_files"] or [{"file": "-", "sha256": "-"}]:
            shown = f"{row['dataset']}/{row['subset']} | {row['recording']} | {row['vehicles']:,}"
            lines.append(f"| {shown} | {file['file']} | {file['sha256']} |")
    lines += ["", *_cite(facts), "## Protocol", ""]
    lines += [f"- {name}: {value}" for name, value in index["protocol"].items()]
    lines += [
        f"- H = {protocol.history_ticks} positions of history, the sample's own included; F = "
        f"{protocol.horizon_ticks} of future",
        "",
        "## Split",
        "",
        *_name_recipe(index["split_recipe"]),
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
    lines += [
        "",
        "## What the files hold",
        "",
        ABSOLUTE if export.absolute else RELATIVE,
        _bound_errors(index, absolute=export.absolute),
        "",
        *_describe(export, folder),
        "",
        LOADING[export.format],
    ]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def _bound_errors(index: Mapping[str, Any], *, absolute: bool) -> str:
    """How far positions are from the tables'; the difference of two of them errs up to twice as far."""
    most_mm = [(1 if absolute else 2) * 1000 * error for error in index["max_error_m"]]
    # Rounded up, and float32's own errors on top: differences of up to 400 m err by less than 0.04 mm.
    along, across = (f"{math.ceil((error + 0.04) * 10) / 10:g}" for error in most_mm)
    said = f"Positions were stored as {index['storage']}; the rounding error is at most {along} mm along the road and "
    if absolute:
        return f"{said}{across} mm across it."
    return f"{said}{across} mm across it (each is the difference of two stored ones), half of that in `origin`."


def _name_recipe(recipe: dict[str, Any]) -> list[str]:
    """What the split is made by: digest, parameters, and how many vehicles it leaves out."""
    return [
        f"- recipe: {recipe['digest']}",
        *(f"- {name}: {value}" for name, value in recipe["parameters"].items()),
        f"- vehicles left out of val and eval: {recipe['left_out_vehicles']:,}",
    ]


def _cite(facts: pl.DataFrame) -> list[str]:
    """What to cite, by data set."""
    from tracklake.pipeline.sources import SOURCES

    used = set(facts["dataset"])
    return [line for source in SOURCES if source.name in used for line in (f"Cite: {source.citation}", "")]


def _describe(export: "WindowsExport", folder: TensorFolder) -> list[str]:
    """A table of columns or arrays: name, type, meaning."""
    if export.format == "parquet":
        schema = window_schema(folder)
        rows = [f"| {field.name} | {_spell(str(field.type))} | {COLUMNS[field.name]} |" for field in schema]
        return ["| column | type | meaning |", "| --- | --- | --- |", *rows]
    rows = [
        f"| {name} | {dtype} | {json.dumps(shape).replace(chr(34), '')} | {meaning} |"
        for name, (dtype, shape, meaning) in npz_arrays(folder).items()
    ]
    rows.append("| subsets | str | [subsets] | data set and subset, by the numbers in `subset` |")
    return ["| array | dtype | shape (S samples, K neighbors) | meaning |", "| --- | --- | --- | --- |", *rows]


def _spell(kind: str) -> str:
    """An Arrow type as people write it."""
    return "string" if kind.startswith("dictionary") else kind.replace("element: ", "").replace("item: ", "")
