"""Parquet, Feather and MATLAB files, read as the CSV text of their rows.

Line 1 is the header, so row n is line n + 1; a matrix of a MATLAB file has no header, and row n is line n.
"""

from collections.abc import Iterator
from typing import BinaryIO

import polars as pl
import pyarrow as pa

from tracklake.pipeline.sources.source import SourceError
from tracklake.schemas.errors import MissingExtraError
from tracklake.schemas.extras import require_extras

BLOCK_ROWS = 1 << 16
"""Rows converted at once."""
MATRIX_COLUMNS = (18, 19, 24, 25)
"""Numbers of columns of a matrix that can hold NGSIM's rows: the 18 fields, with an index, and the longer exports."""
EXACT_WHOLE = float(1 << 53)
"""Lowest number above which double precision skips whole numbers."""
PARQUET, FEATHER, MATLAB, MATLAB_7_3 = MAGICS = (b"PAR1", b"ARROW1", b"MATLAB 5.0", b"MATLAB 7.3")
"""First bytes of the files that this module knows."""


class NoTableError(SourceError):
    """A binary file that holds no table of trajectories, or none that can be read."""


def is_table(head: bytes) -> bool:
    """Recognise a Parquet, Feather or MATLAB file by its first bytes."""
    return head.startswith(MAGICS)


def read_as_csv(handle: BinaryIO, head: bytes, name: str) -> Iterator[bytes]:
    """Yield the CSV text of a file's table; the handle can be rewound, and `head` are its first bytes.

    Raises:
        NoTableError: the file is damaged or holds no such table.
        SourceError: SciPy, which reads MATLAB files, is not installed.
    """
    try:
        if head.startswith(MATLAB):
            yield from _read_matrix(handle, name)
        elif head.startswith(MATLAB_7_3):
            raise NoTableError(
                f"{name}: a MATLAB file of version 7.3. Expected one of version 7 or older; save it with `-v7`, or as "
                "text (`writematrix`)."
            )
        else:
            yield from _write_frames(_read_batches(handle, head))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, pl.exceptions.PolarsError) as damage:
        raise NoTableError(f"{name}: cannot be read as a table ({str(damage)[:120]}). Download it again.") from None


def _read_batches(handle: BinaryIO, head: bytes) -> Iterator[pl.DataFrame]:
    if head.startswith(PARQUET):
        from pyarrow import parquet

        file = parquet.ParquetFile(handle)
        yield pl.DataFrame(pl.from_arrow(file.schema_arrow.empty_table()))
        for batch in file.iter_batches(BLOCK_ROWS):
            yield pl.DataFrame(pl.from_arrow(pa.Table.from_batches([batch])))
    else:
        reader = pa.ipc.open_file(handle)
        yield pl.DataFrame(pl.from_arrow(reader.schema.empty_table()))
        for number in range(reader.num_record_batches):
            yield pl.DataFrame(pl.from_arrow(pa.Table.from_batches([reader.get_batch(number)])))


def _read_matrix(handle: BinaryIO, name: str) -> Iterator[bytes]:
    try:
        require_extras(name, "matlab")
    except MissingExtraError as missing:
        raise SourceError(str(missing)) from None
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    try:
        held = whosmat(handle)
        wanted = [found for found, shape, _ in held if len(shape) == 2 and shape[1] in MATRIX_COLUMNS]
        if len(wanted) != 1:
            shapes = ", ".join(f"{found} {' x '.join(map(str, shape))}" for found, shape, _ in held[:5]) or "nothing"
            raise NoTableError(
                f"{name}: expected one matrix with NGSIM's 18 columns, got {shapes}. Save that matrix alone."
            )
        handle.seek(0)
        matrix = loadmat(handle, variable_names=wanted)[wanted[0]]
    except (MatReadError, ValueError, TypeError, NotImplementedError, OSError, EOFError) as damage:
        raise NoTableError(f"{name}: cannot be read as a MATLAB file ({str(damage)[:120]}).") from None
    frames = (pl.DataFrame(matrix[start : start + BLOCK_ROWS]) for start in range(0, len(matrix), BLOCK_ROWS))
    return (block for frame in frames for block in _write_frames(iter([frame]), header=False))


def _write_frames(frames: Iterator[pl.DataFrame], *, header: bool = True) -> Iterator[bytes]:
    for number, frame in enumerate(frames):
        plain = frame.select(
            _write_plainly(frame[name]) for name in frame.columns if not frame.schema[name].is_nested()
        )
        yield plain.write_csv(include_header=header and number == 0).encode()


def _write_plainly(values: pl.Series) -> pl.Series:
    """Prepare a column for CSV text: no NaN, no line feeds, whole numbers without a fraction, times in ms."""
    if values.dtype == pl.Datetime:
        return values.dt.epoch("ms")
    if values.dtype == pl.String:
        return values.str.replace_all(r"[\r\n]", " ")
    if not values.dtype.is_float():
        return values
    values = values.fill_nan(None)
    whole = ((values == values.floor()) & (values.abs() < EXACT_WHOLE)).all()
    return values.cast(pl.Int64) if whole else values
