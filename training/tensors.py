"""Tensor folders: opened memory-mapped, checked against their declaration, gathered in batches by indexing."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from schemas.columns import PARTS
from schemas.protocols import Protocol
from schemas.tensors import ARRAYS, TENSORS_VERSION

Floats = npt.NDArray[np.float32]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class TensorError(ValueError):
    """A tensor folder is absent, unfinished or not what its index says."""


@dataclass(frozen=True)
class Batch:
    """Samples as arrays. B samples, K neighbors of all of them together, H ticks of history, F of future.

    Positions are in m, float32, and relative to the sample's last known position (that at its own tick):
    `[..., 0]` along the direction of travel (x_m), `[..., 1]` across it, positive to the driver's right (y_m).

    Args:
        sample: (B,) which samples of the folder these are.
        history: (B, H, 2) the sample's own positions; the last one is (0, 0).
        future: (B, F, 2) its positions at 1, 2, ... ticks; where masked, its last known future position again.
        future_mask: (B, F) True where the position is known.
        neighbor_history: (K, H, 2) relative to the SAMPLE's last position; where masked (the neighbor's track began
            later), its earliest known position again.
        neighbor_mask: (K, H) True where the position is known; the last one always is.
        neighbor_sample: (K,) position in the batch, 0 to B - 1, increasing.
        neighbor_cell: (K,) cell 0 to 38 of the grid, increasing within a sample.
        lateral: (B,) the maneuver's position in `schemas.columns.LATERAL_MANEUVERS`.
        longitudinal: (B,) likewise in `LONGITUDINAL_MANEUVERS`.
        origin: (B, 2) the sample's last position on the carriageway; adding it makes positions absolute.
    """

    sample: Integers
    history: Floats
    future: Floats
    future_mask: Flags
    neighbor_history: Floats
    neighbor_mask: Flags
    neighbor_sample: Integers
    neighbor_cell: npt.NDArray[np.int8]
    lateral: npt.NDArray[np.uint8]
    longitudinal: npt.NDArray[np.uint8]
    origin: Floats

    def __len__(self) -> int:
        """B."""
        return len(self.sample)


@dataclass(frozen=True)
class TensorFolder:
    """The arrays of one split, mapped into memory and not read until indexed. See `schemas.tensors.ARRAYS`.

    Args:
        path: the folder.
        index: what `index.json` holds.
        protocol: whose samples these are.
    """

    path: Path
    index: dict[str, Any]
    protocol: Protocol
    x_m: Floats
    y_m: Floats
    segment_first: Integers
    segment_last: Integers
    sample_row: Integers
    sample_part: npt.NDArray[np.uint8]
    sample_lateral: npt.NDArray[np.uint8]
    sample_longitudinal: npt.NDArray[np.uint8]
    neighbor_offset: Integers
    neighbor_row: Integers
    neighbor_cell: npt.NDArray[np.int8]
    subset: npt.NDArray[np.int32]

    @classmethod
    def open(cls, path: Path) -> Self:
        """Map a folder that the pipeline's tensors stage wrote.

        Raises:
            TensorError: the folder or its index is absent, of another version or unreadable; or an array is absent or
                not of the dtype and size declared.
        """
        index = _read_index(path)
        protocol = _read_protocol(path, index)
        arrays = {array.name: _map_array(path, array.name, array.dtype, array.shape, index) for array in ARRAYS}
        wanted = {field.name for field in fields(cls)}
        return cls(
            path=path, index=index, protocol=protocol, **{name: arrays[name] for name in arrays if name in wanted}
        )

    @property
    def split(self) -> str:
        """The split's name."""
        return str(self.index["split"])

    def samples_of(self, part: str) -> Integers:
        """(S_part,) numbers of the samples of one part, increasing.

        Raises:
            ValueError: no such part.
        """
        if part not in PARTS:
            raise ValueError(f"unknown part `{part}`: expected one of {', '.join(PARTS)}")
        return np.flatnonzero(self.sample_part == PARTS.index(part)).astype(np.int64)

    def subsets_of(self, part: str) -> set[str]:
        """Subsets (`dataset/subset`) that have samples in a part."""
        present = np.unique(self.subset[self.sample_row[self.samples_of(part)]])
        return {f"{named['dataset']}/{named['subset']}" for named in (self.index["subsets"][i] for i in present)}

    def batches(self, part: str, batch_size: int, *, shuffle_seed: int | None = None) -> Iterator[Batch]:
        """Every sample of a part once; the last batch may be smaller.

        Args:
            part: train, val or eval.
            batch_size: B.
            shuffle_seed: draws the order; None = the samples' own.
        """
        samples = self.samples_of(part)
        if shuffle_seed is not None:
            samples = np.random.default_rng(shuffle_seed).permutation(samples)
        for start in range(0, len(samples), batch_size):
            yield self.gather(samples[start : start + batch_size])

    def gather(self, samples: npt.ArrayLike) -> Batch:
        """Read samples by their numbers (B,), in any order; no sample is looked at by itself."""
        sample = np.asarray(samples, dtype=np.int64)
        row = self.sample_row[sample]
        x_m, y_m = self.x_m[row], self.y_m[row]

        # A sample's history is gap-free by definition; its future ends with the run of rows it stands in.
        history_rows = row[:, None] + np.arange(1 - self.protocol.history_ticks, 1)
        last_row = self.segment_last[row][:, None]
        future_rows = row[:, None] + np.arange(1, self.protocol.horizon_ticks + 1)
        future_mask = future_rows <= last_row

        pair_first = self.neighbor_offset[sample]
        pairs = self.neighbor_offset[sample + 1] - pair_first
        neighbor_sample = np.repeat(np.arange(len(sample)), pairs)
        pair = np.arange(len(neighbor_sample)) + np.repeat(pair_first - (np.cumsum(pairs) - pairs), pairs)
        neighbor_row = self.neighbor_row[pair]
        neighbor_rows = neighbor_row[:, None] + np.arange(1 - self.protocol.history_ticks, 1)
        first_row = self.segment_first[neighbor_row][:, None]
        neighbor_mask = neighbor_rows >= first_row

        return Batch(
            sample=sample,
            history=self._positions(history_rows, x_m, y_m),
            future=self._positions(np.minimum(future_rows, last_row), x_m, y_m),
            future_mask=future_mask,
            neighbor_history=self._positions(
                np.maximum(neighbor_rows, first_row), x_m[neighbor_sample], y_m[neighbor_sample]
            ),
            neighbor_mask=neighbor_mask,
            neighbor_sample=neighbor_sample,
            neighbor_cell=self.neighbor_cell[pair],
            lateral=self.sample_lateral[sample],
            longitudinal=self.sample_longitudinal[sample],
            origin=np.stack([x_m, y_m], axis=-1),
        )

    def _positions(self, rows: Integers, x_m: Floats, y_m: Floats) -> Floats:
        """(M, T, 2) positions of rows (M, T) relative to origins (M,)."""
        positions = np.empty((*rows.shape, 2), dtype=np.float32)
        np.subtract(self.x_m[rows], x_m[:, None], out=positions[..., 0])
        np.subtract(self.y_m[rows], y_m[:, None], out=positions[..., 1])
        return positions


def _read_index(path: Path) -> dict[str, Any]:
    """`index.json`, of a version and with the keys that are read here."""
    file = path / "index.json"
    if not file.is_file():
        raise TensorError(f"{path}: no tensors here (no index.json); run `tracklake tensors`")
    try:
        index = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as broken:
        raise TensorError(f"{file}: not readable as JSON ({broken}); run `tracklake tensors` again") from broken
    if not isinstance(index, dict) or index.get("version") != TENSORS_VERSION:
        found = index.get("version") if isinstance(index, dict) else type(index).__name__
        raise TensorError(
            f"{file}: expected version {TENSORS_VERSION} of tensors, got {found}; run `tracklake tensors` again"
        )
    missing = [key for key in ("split", "protocol", "subsets", "blocks", "sizes") if key not in index]
    if missing:
        raise TensorError(f"{file}: lacks {', '.join(missing)}; run `tracklake tensors` again")
    return index


def _read_protocol(path: Path, index: dict[str, Any]) -> Protocol:
    """The protocol whose parameters the index holds."""
    parameters = {name: value for name, value in index["protocol"].items() if name != "digest"}
    known = {field.name for field in fields(Protocol)}
    if set(parameters) != known:
        raise TensorError(
            f"{path / 'index.json'}: expected a protocol of {', '.join(sorted(known))}, "
            f"got {', '.join(sorted(parameters))}; run `tracklake tensors` again"
        )
    protocol = Protocol(**parameters)
    if protocol.digest != index["protocol"].get("digest"):
        raise TensorError(
            f"{path / 'index.json'}: the protocol's digest is {index['protocol'].get('digest')}, its parameters give "
            f"{protocol.digest}; run `tracklake tensors` again"
        )
    return protocol


def _map_array(path: Path, name: str, dtype: str, shape: str, index: dict[str, Any]) -> npt.NDArray[Any]:
    """One array, mapped read-only, of the declared dtype and size."""
    file = path / f"{name}.npy"
    letter, _, more = shape.partition("+")
    expected = (int(index["sizes"][letter]) + int(more or 0),)
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, EOFError, ValueError) as broken:
        raise TensorError(f"{file}: cannot be read ({broken}); run `tracklake tensors` again") from broken
    if array.dtype != np.dtype(dtype) or array.shape != expected:
        raise TensorError(
            f"{file}: expected {dtype} of shape {expected}, got {array.dtype} of shape {array.shape}; "
            "run `tracklake tensors` again"
        )
    # A plain view: indexing np.memmap itself runs Python code for every result.
    plain: npt.NDArray[Any] = array.view(np.ndarray)
    return plain
