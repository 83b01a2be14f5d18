"""Writers of windows: Parquet with a row per sample, or NumPy arrays in an `.npz`."""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Self
from zipfile import ZIP_STORED, ZipFile, ZipInfo

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from tracklake.pipeline.export.windows.result import Windows
from tracklake.schemas.arrays import Flags, Singles
from tracklake.schemas.columns import DATASETS, LATERAL_MANEUVERS, LONGITUDINAL_MANEUVERS
from tracklake.training.data.tensor_folder import TensorFolder

AXES = ("x", "y")


class ParquetWindows:
    """Writer of one Parquet file: a row per sample, with lists of positions and neighbors."""

    def __init__(self, path: Path, folder: TensorFolder, samples: int, neighbors: int) -> None:
        del samples, neighbors
        self.folder = folder
        # Values of a dictionary must differ; no two data sets share a subset's name.
        self.dataset_of = np.array([DATASETS.index(subset["dataset"]) for subset in folder.index["subsets"]])
        self.schema = pa.schema([(name, dtype) for name, (dtype, _) in list_columns(folder).items()])
        self.writer = pq.ParquetWriter(path, self.schema, compression="zstd")

    def __enter__(self) -> Self:
        """Return the open writer."""
        return self

    def __exit__(self, *_: object) -> None:
        """Write the footer and close the file."""
        self.writer.close()

    def add_windows(self, windows: Windows) -> None:
        """Write samples as one row group."""
        batch, rate_hz = windows.batch, self.folder.protocol.rate_hz
        subsets = self.folder.index["subsets"]
        neighbor_offset = np.searchsorted(batch.neighbor_sample, np.arange(len(batch) + 1)).astype(np.int32)
        columns: dict[str, Any] = {
            "dataset": _encode_names(DATASETS, self.dataset_of[windows.subset]),
            "subset": _encode_names([subset["subset"] for subset in subsets], windows.subset),
            "vehicle_id": windows.vehicle_id,
            "tick": windows.tick,
            "time_s": windows.tick / rate_hz,
            "lane": pa.array(windows.lane, mask=windows.lane == 0),
            "lateral_maneuver": _encode_names(LATERAL_MANEUVERS, batch.lateral),
            "longitudinal_maneuver": _encode_names(LONGITUDINAL_MANEUVERS, batch.longitudinal),
        }
        for axis, name in enumerate(AXES):
            columns[f"origin_{name}_m"] = np.ascontiguousarray(batch.origin[:, axis])
            columns[f"history_{name}_m"] = _build_lists(batch.history[..., axis])
            columns[f"future_{name}_m"] = _build_lists(batch.future[..., axis], batch.future_mask)
        columns["neighbor_cell"] = pa.ListArray.from_arrays(neighbor_offset, batch.neighbor_cell)
        columns["neighbor_id"] = pa.ListArray.from_arrays(neighbor_offset, windows.neighbor_id)
        for axis, name in enumerate(AXES):
            inner = _build_lists(batch.neighbor_history[..., axis], batch.neighbor_mask)
            columns[f"neighbor_history_{name}_m"] = pa.ListArray.from_arrays(neighbor_offset, inner)
        arrays = [pa.array(columns[field.name]).cast(field.type) for field in self.schema]
        self.writer.write_table(pa.Table.from_arrays(arrays, schema=self.schema))


def list_columns(folder: TensorFolder) -> dict[str, tuple[pa.DataType, str]]:
    """List type and meaning of every column of the Parquet files."""
    history = pa.list_(pa.float32(), folder.protocol.history_ticks)
    future = pa.list_(pa.float32(), folder.protocol.horizon_ticks)
    text = pa.dictionary(pa.int32(), pa.string())
    cells = "cell of each neighbor, 13 * column + row (left, own, right lane; row 12 ahead), increasing"
    origin, neighbors = (
        "of the sample's last position on the carriageway, m",
        "of each neighbor up to the sample's tick, m",
    )
    return {
        "dataset": (text, "ngsim or highd"),
        "subset": (text, "one carriageway of one recording"),
        "vehicle_id": (pa.int32(), "unique within the subset"),
        "tick": (pa.int32(), "tick of the sample"),
        "time_s": (pa.float64(), "time since the recording's first frame, s"),
        "lane": (pa.int16(), "1 is the driver's leftmost; null = unknown"),
        "lateral_maneuver": (text, "keep, left or right"),
        "longitudinal_maneuver": (text, "normal or brake"),
        **{f"origin_{axis}_m": (pa.float32(), f"{axis} {origin}") for axis in AXES},
        **{f"history_{axis}_m": (history, f"{axis} up to the sample's tick, m") for axis in AXES},
        **{f"future_{axis}_m": (future, f"{axis} after the sample's tick, m; null = unknown") for axis in AXES},
        "neighbor_cell": (pa.list_(pa.int8()), cells),
        "neighbor_id": (pa.list_(pa.int32()), "vehicle_id of each neighbor"),
        **{f"neighbor_history_{axis}_m": (pa.list_(history), f"{axis} {neighbors}; null = unknown") for axis in AXES},
    }


def _encode_names(names: Sequence[str], codes: npt.NDArray[np.integer]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(codes.astype(np.int32), pa.array(list(names), pa.string()))


def _build_lists(values: Singles, known: Flags | None = None) -> pa.FixedSizeListArray:
    """Turn (M, T) values into M lists, with null for unknown values."""
    flat = pa.array(values.reshape(-1), mask=None if known is None else ~known.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


class NpzWindows:
    """Writer of one `.npz`: each array is spooled to a file, then added to the archive uncompressed."""

    def __init__(self, path: Path, folder: TensorFolder, samples: int, neighbors: int) -> None:
        self.path, self.folder, self.sizes = path, folder, {"S": samples, "K": neighbors}
        self.spool = path.with_name(f"{path.name}.spool")
        self.files: dict[str, IO[bytes]] = {}
        self.offset = 0
        self.stack = ExitStack()

    def __enter__(self) -> Self:
        """Write the header of every array; the shapes are known."""
        self.spool.mkdir()
        for name, (dtype, shape, _) in list_npz_arrays(self.folder).items():
            file = self.stack.enter_context((self.spool / f"{name}.npy").open("wb"))
            sizes = tuple(self.sizes.get(str(axis), axis) for axis in shape)
            header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": sizes}
            np.lib.format.write_array_header_1_0(file, header)
            self.files[name] = file
        return self

    def __exit__(self, *raised: object) -> None:
        """Add the arrays to the archive and delete the spooled files."""
        self.stack.close()
        if raised[0] is None:
            names = [f"{subset['dataset']}/{subset['subset']}" for subset in self.folder.index["subsets"]]
            np.save(self.spool / "subsets.npy", np.array(names, dtype=np.str_), allow_pickle=False)
            with ZipFile(self.path, "w", ZIP_STORED) as archive:
                for name in (*self.files, "subsets"):
                    # A fixed time, so that the same windows give the same bytes.
                    entry = ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                    with (
                        (self.spool / f"{name}.npy").open("rb") as values,
                        archive.open(entry, "w", force_zip64=True) as out,
                    ):
                        shutil.copyfileobj(values, out, 4 * 2**20)
        shutil.rmtree(self.spool)

    def add_windows(self, windows: Windows) -> None:
        """Append samples to the spooled arrays."""
        batch = windows.batch
        values: Mapping[str, npt.NDArray[Any]] = {
            **{name: getattr(batch, name) for name in list_npz_arrays(self.folder) if hasattr(batch, name)},
            "neighbor_sample": batch.neighbor_sample + self.offset,
            "subset": windows.subset,
            "vehicle_id": windows.vehicle_id,
            "tick": windows.tick,
            "lane": windows.lane,
            "neighbor_id": windows.neighbor_id,
        }
        for name, (dtype, _, _) in list_npz_arrays(self.folder).items():
            np.ascontiguousarray(values[name], dtype=dtype).tofile(self.files[name])
        self.offset += len(batch)


def list_npz_arrays(folder: TensorFolder) -> dict[str, tuple[str, tuple[int | str, ...], str]]:
    """List dtype, shape and meaning of every array in an `.npz` but `subsets`, for S samples and K neighbors."""
    history, future = folder.protocol.history_ticks, folder.protocol.horizon_ticks
    return {
        "history": ("float32", ("S", history, 2), "positions up to the sample's tick, m: along the road, across it"),
        "future": ("float32", ("S", future, 2), "positions after it; masked ones repeat the last known one"),
        "future_mask": ("bool", ("S", future), "True if the position is known"),
        "neighbor_history": ("float32", ("K", history, 2), "neighbors' positions; masked ones repeat the first known"),
        "neighbor_mask": ("bool", ("K", history), "True if the position is known"),
        "neighbor_sample": ("int64", ("K",), "the neighbor's sample in this file, increasing"),
        "neighbor_cell": ("int8", ("K",), "13 * column + row of the grid (left, own, right; row 12 ahead)"),
        "neighbor_id": ("int32", ("K",), "the neighbor's vehicle_id"),
        "lateral": ("uint8", ("S",), ", ".join(f"{code} {name}" for code, name in enumerate(LATERAL_MANEUVERS))),
        "longitudinal": ("uint8", ("S",), ", ".join(f"{i} {name}" for i, name in enumerate(LONGITUDINAL_MANEUVERS))),
        "origin": ("float32", ("S", 2), "the sample's last position on the carriageway, m"),
        "subset": ("int32", ("S",), "position in `subsets`"),
        "vehicle_id": ("int32", ("S",), "unique within the subset"),
        "tick": ("int32", ("S",), f"time_s = tick / {folder.protocol.rate_hz}"),
        "lane": ("int16", ("S",), "1 is the driver's leftmost; 0 = unknown"),
    }


WRITERS: dict[str, type[ParquetWindows] | type[NpzWindows]] = {"parquet": ParquetWindows, "npz": NpzWindows}
