"""Samples with the neighbors in their grids, gathered in batches."""

from tracklake.training.data.batches import Batch
from tracklake.training.data.namespaces import Array, cast, expand_groups
from tracklake.training.data.positions import Folder, locate_rows, read_future, read_history, to_absolute, to_relative


def gather_samples(folder: Folder, sample: Array, *, absolute: bool = False) -> Batch:
    """Read samples by their numbers (B,) int64, in any order; no sample is read by itself.

    Args:
        folder: tensors to read from; the batch's arrays are of the same kind, and on the same device.
        sample: numbers of samples, each within the folder.
        absolute: measure positions on the carriageway.
    """
    row = cast(folder.sample_row[sample], "int64")
    pair, owner = expand_groups(folder.neighbor_offset, sample)
    neighbor_row = cast(folder.neighbor_row[pair], "int64")
    history, _ = read_history(folder, row, row + 1 - folder.protocol.history_ticks)  # complete by definition
    future, future_mask = read_future(folder, row, row + cast(folder.sample_future[sample], "int64"))
    neighbor_first = neighbor_row + 1 - cast(folder.neighbor_known[pair], "int64")
    neighbor_history, neighbor_mask = read_history(folder, neighbor_row, neighbor_first)
    if absolute:
        history, future = to_absolute(folder, history, row), to_absolute(folder, future, row)
        neighbor_history = to_absolute(folder, neighbor_history, neighbor_row)
    else:
        origin = folder.position_m[row]
        history, future = to_relative(folder, history, origin), to_relative(folder, future, origin)
        neighbor_history = to_relative(folder, neighbor_history, origin[owner])
    return Batch(
        sample=sample,
        history=history,
        future=future,
        future_mask=future_mask,
        neighbor_history=neighbor_history,
        neighbor_mask=neighbor_mask,
        neighbor_sample=owner,
        neighbor_cell=folder.neighbor_cell[pair],
        lateral=folder.sample_lateral[sample],
        longitudinal=folder.sample_longitudinal[sample],
        origin=locate_rows(folder, row),
        absolute=absolute,
    )
