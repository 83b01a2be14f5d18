"""Facts about vehicles in tensors: their sizes, and the findings on their entries."""

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.resample import find_stride, join_key
from tracklake.schemas.arrays import Bytes, Integers, Singles
from tracklake.schemas.columns import SEVERITIES


def find_sizes(vehicles: pl.DataFrame, vehicle_id: Integers, *, where: str) -> tuple[Singles, Singles]:
    """Look up (R,) lengths and (R,) widths of vehicles, in m; NaN = unknown.

    `vehicles` have vehicle_id (unique), length_m, width_m (null = unknown), in any order.

    Raises:
        ValueError: a vehicle is not among `vehicles`.
    """
    known = vehicles.sort("vehicle_id")
    ids = known["vehicle_id"].to_numpy().astype(np.int64)
    row = np.searchsorted(ids, vehicle_id)
    unknown = np.append(ids, -1)[row] != vehicle_id
    if unknown.any():
        raise ValueError(
            f"{where}: expected every vehicle of the tracks in `vehicles`, got {int(unknown.sum())} runs of others, "
            f"for example vehicle {vehicle_id[np.argmax(unknown)]}; ingest the recording again"
        )
    sizes = known.select(pl.col("length_m", "width_m").cast(pl.Float32).fill_null(np.nan))
    return sizes["length_m"].to_numpy()[row], sizes["width_m"].to_numpy()[row]


def mark_findings(
    vehicle_id: Integers,
    tick: Integers,
    findings: pl.DataFrame,
    *,
    first_frame: int,
    frame_rate_hz: float,
    rate_hz: int,
) -> Bytes:
    """Mark every tick with the worst severity of the vehicle's own findings: 1 + position in SEVERITIES; 0 = none.

    A tick stands for the frames after the previous tick up to its own, so no frame of a 25 Hz source is skipped. A
    tick between two frames covers both: the later one counts there, and again at the next tick.

    The (N,) entries are sorted by (vehicle_id, tick), with tick 0 at `first_frame`; findings have vehicle_id, severity,
    first_frame, last_frame, in any order, and may overlap.
    """
    stride = find_stride(frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    ends = join_key(vehicle_id, first_frame - (-tick * stride.numerator // stride.denominator))
    begins = join_key(vehicle_id, first_frame + (tick - 1) * stride.numerator // stride.denominator + 1)
    marked = np.zeros(len(tick), dtype=np.uint8)
    for code, severity in reversed(list(enumerate(SEVERITIES, start=1))):  # worse severities overwrite others
        own = findings.filter(pl.col("severity") == severity)
        if own.is_empty():
            continue
        ids = own["vehicle_id"].to_numpy()
        # Rows of a finding: from the first that does not end before it to the last that does not begin after it.
        first = np.searchsorted(ends, join_key(ids, own["first_frame"].to_numpy()), side="left")
        beyond = np.searchsorted(begins, join_key(ids, own["last_frame"].to_numpy()), side="right")
        open_findings = np.bincount(first, minlength=len(tick) + 1) - np.bincount(beyond, minlength=len(tick) + 1)
        marked[np.cumsum(open_findings)[:-1] > 0] = code
    return marked
