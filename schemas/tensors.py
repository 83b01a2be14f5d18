"""The files under `tensors/<split>/<fingerprint>/`: flat arrays and an index of samples, declared once."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Array:
    """One `.npy` file of a tensor folder.

    Args:
        name: the file is `<name>.npy`.
        dtype: NumPy's name of it.
        shape: letters: N entries on the clock, S samples, K (sample, neighbor) pairs.
        meaning: unit, order and sign included.
    """

    name: str
    dtype: str
    shape: str
    meaning: str


ARRAYS = (
    Array("x_m", "float32", "N", "front centre along the direction of travel, m"),
    Array("y_m", "float32", "N", "front centre from the carriageway's left edge, positive to the right, m"),
    Array("speed_mps", "float32", "N", "recorded speed along the direction of travel, m/s"),
    Array("lane", "int16", "N", "1 is the driver's leftmost; 0 where the source has none"),
    Array("subset", "int32", "N", "position in index.json's `subsets`"),
    Array("vehicle_id", "int32", "N", "unique within the subset"),
    Array("tick", "int32", "N", "time_s = tick / rate_hz"),
    Array("segment_first", "int64", "N", "first row of the gap-free run of ticks that the row stands in"),
    Array("segment_last", "int64", "N", "last row of the gap-free run of ticks that the row stands in"),
    Array("sample_row", "int64", "S", "the row of each sample's origin, increasing"),
    Array("sample_part", "uint8", "S", "position in schemas.columns.PARTS"),
    Array("sample_lateral", "uint8", "S", "position in schemas.columns.LATERAL_MANEUVERS"),
    Array("sample_longitudinal", "uint8", "S", "position in schemas.columns.LONGITUDINAL_MANEUVERS"),
    Array("neighbor_offset", "int64", "S+1", "pairs of sample s are [neighbor_offset[s], neighbor_offset[s + 1])"),
    Array("neighbor_row", "int64", "K", "the neighbor's row at the sample's tick"),
    Array("neighbor_cell", "int8", "K", "13 * column + row of the 13 x 3 grid"),
)
"""Rows are sorted by (subset, vehicle_id, tick). Beside them stands `index.json`: version, split, protocol (its
parameters and digest), subsets (dataset, subset, frame_rate_hz), blocks (the split's rows), the sizes N, S, K, and
samples_by_part."""

TENSORS_VERSION = 1
