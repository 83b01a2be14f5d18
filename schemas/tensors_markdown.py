"""Page of the tensor folder as Markdown, derived from its declaration: see `make docs`."""

import sys

from tracklake.schemas import tensors
from tracklake.schemas.markdown import format_table
from tracklake.schemas.protocols import CSP
from tracklake.schemas.tensors import ARRAYS, INDEX_KEYS, STEPS_M, SUBSET_KEYS, TENSORS_VERSION, Array

LETTERS = {
    "N": "rows: entries on the protocol's clock that are in a part of the split, of subsets with samples",
    "R": "runs: gap-free stretches of one vehicle's ticks inside one block",
    "S": "samples",
    "K": "(sample, neighbor) pairs",
    "C": "scenes: moments with at least one sample",
    "M": "vehicles in scenes",
}

HEAD = f"""# Tensors

Derived from `schemas/tensors.py`; do not edit (`make docs` writes it). Version {TENSORS_VERSION}.

`tracklake tensors` writes a folder that `tracklake.training.data.tensor_folder.TensorFolder.open` maps into memory and
checks: a file of NumPy's format for each array (`sample_row.npy`), and `{tensors.INDEX_FILE}`, which describes them.

Shapes, order and units of the batches gathered from them (NumPy arrays, or torch tensors on a device) are those of
`training.data.batches.Batch` and `SceneBatch`. Under the protocol `{CSP.name}` a history has H = \
{CSP.history_ticks} positions, a future F = {CSP.horizon_ticks}; of others see [protocols](protocols.md).

## Sizes
"""


def write_tensors_page() -> str:
    """Write the whole page."""
    lines = [HEAD, *(f"- {letter}: {meaning}" for letter, meaning in LETTERS.items())]
    lines += ["", "## Arrays", "", *format_table(("array", "dtype", "shape", "meaning"), map(_describe, ARRAYS))]
    lines += ["", tensors.ORDER.strip(), "", "## Positions as int16", "", tensors.STORAGE, ""]
    steps = ((storage, f"{along:g}", f"{across:g}") for storage, (along, across) in STEPS_M.items())
    lines += format_table(("storage", "m per step along", "m per step across"), steps)
    lines += ["", "## The index", "", tensors.INDEX_MEANING, ""]
    lines += [f"Keys: {', '.join(f'`{key}`' for key in INDEX_KEYS)}.", "", tensors.SUBSET_MEANING, ""]
    lines += [f"Keys: {', '.join(f'`{key}`' for key in SUBSET_KEYS)}.", ""]
    return "\n".join(lines)


def _describe(array: Array) -> tuple[str, ...]:
    """Return the cells of an array's row."""
    dtype = "float32 or int16" if array.dtype == "position" else array.dtype
    return f"`{array.name}`", dtype, f"({', '.join(array.shape)})", array.meaning


if __name__ == "__main__":
    sys.stdout.write(write_tensors_page())
