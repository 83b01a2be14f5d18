"""Safety Pilot's BsmP1: one message a line, 19 comma-separated fields, with or without a header.

Confidence, PathCount and RadiusOfCurve are not kept: nothing reads the first two, and the unit of the last is unknown.
"""

import polars as pl

from tracklake.pipeline.sources.csv import BOM, LINE, Chunk, Layout, map_chunks, read_head
from tracklake.pipeline.sources.source import RawFile
from tracklake.pipeline.sources.v2v.messages import RawMessages, collect_messages, write_ids

FIELDS = (
    "RxDevice", "FileId", "TxDevice", "Gentime", "TxRandom", "MsgCount", "DSecond", "Latitude", "Longitude",
    "Elevation", "Speed", "Heading", "Ax", "Ay", "Az", "Yawrate", "PathCount", "RadiusOfCurve", "Confidence",
)  # fmt: skip
"""Names of the 19 fields, in the order of the file."""
WHOLE = ("RxDevice", "TxDevice", "Gentime", "TxRandom", "MsgCount", "DSecond")
MEASURED_AS = {
    "Latitude": "lat_deg",
    "Longitude": "lon_deg",
    "Elevation": "elevation_m",
    "Speed": "speed_mps",
    "Heading": "heading_deg",
    "Ax": "accel_mps2",
    "Ay": "lateral_accel_mps2",
    "Az": "vertical_accel_mps2",
    "Yawrate": "yaw_rate_degps",
}
"""Columns of the frame by field: the units are the same."""
REQUIRED = ("RxDevice", "TxDevice", "Gentime", "Latitude", "Longitude")
DTYPES: dict[str, pl.DataType] = {
    name: pl.String() if name == "FileId" else pl.Int64() if name in WHOLE else pl.Float64()
    for name in FIELDS
    if name in (*WHOLE, "FileId", *MEASURED_AS)
}
EPOCH_US = 1_072_915_200_000_000
"""Microseconds from 1970 to 2004-01-01 UTC, at which Gentime is 0."""
SYNTHETIC_FILE_ID = "synthetic"
"""Value of FileId in generated messages; recorded ones have a number there."""
PARSING_THREADS = 2
"""Chunks of lines that are parsed at once."""
MAX_ID = 2**32 - 1
"""Greatest temporary id, which has 32 bits."""


def recognise_bsmp1(head: bytes) -> bool:
    """Recognise BsmP1 by its header, or by a first line of 19 fields with a device, a time and a position in place."""
    line = head.removeprefix(BOM).split(b"\n", 1)[0].decode("utf-8", errors="replace").strip()
    cells = [cell.strip().strip('"') for cell in line.split(",")]
    if len(cells) != len(FIELDS):
        return False
    if _is_header(cells):
        return True
    try:
        numbers = [float(cell or "nan") for name, cell in zip(FIELDS, cells, strict=True) if name != "FileId"]
    except ValueError:
        return False
    by_name = dict(zip((name for name in FIELDS if name != "FileId"), numbers, strict=True))
    whole = all(by_name[name].is_integer() for name in ("RxDevice", "TxDevice", "Gentime"))
    return whole and abs(by_name["Latitude"]) <= 90 and abs(by_name["Longitude"]) <= 180


def _is_header(cells: list[str]) -> bool:
    return [cell.lower() for cell in cells] == [name.lower() for name in FIELDS]


def read_bsmp1(file: RawFile) -> RawMessages:
    """Read a file of BsmP1; lines that cannot be parsed or state an impossible position or heading are rejects.

    Raises:
        SourceError: a compressed file is damaged.
    """
    line = read_head(file).removeprefix(BOM).split(b"\n", 1)[0].decode("utf-8", errors="replace")
    header = _is_header([cell.strip().strip('"') for cell in line.split(",")])
    layout = Layout(FIELDS, DTYPES, frozenset(REQUIRED), header_lines=int(header))
    chunks = list(map_chunks(file, layout, lambda _number, chunk: chunk, threads=PARSING_THREADS))
    return _convert(file, chunks)


def _convert(file: RawFile, chunks: list[Chunk]) -> RawMessages:
    rows = pl.concat([chunk.frame for chunk in chunks] or [pl.DataFrame(schema={LINE: pl.Int64(), **DTYPES})])
    random_id = rows["TxRandom"].fill_null(0)
    ids = write_ids(random_id.clip(0, MAX_ID).to_numpy().astype("u4"))
    is_logged = random_id.is_between(1, MAX_ID) | (rows["TxDevice"] == 0)
    frame = rows.rename(MEASURED_AS).with_columns(
        # Without a random id, which is 0 or empty then, the device stands for itself.
        ids.zip_with(is_logged, rows["TxDevice"].cast(pl.String)).alias("temporary_id"),
        receiver=pl.col("RxDevice").cast(pl.String),
        utc_us=pl.col("Gentime") + EPOCH_US,
        second_mark_ms=pl.col("DSecond"),
        own=pl.col("RxDevice") == pl.col("TxDevice"),
        sender=pl.when(pl.col("TxDevice") != 0).then(pl.col("TxDevice").cast(pl.String)),
        message_count=pl.col("MsgCount"),
    )
    return collect_messages(
        file,
        [frame],
        [chunk.rejects for chunk in chunks],
        sum(chunk.rows_read for chunk in chunks),
        synthetic=bool((rows["FileId"] == SYNTHETIC_FILE_ID).any()),
    )
