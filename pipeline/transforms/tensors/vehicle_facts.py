"""What tensors say of vehicles beside their places: sizes, and which of their entries findings touch."""

import numpy as np
import numpy.typing as npt
import polars as pl

from tracklake.pipeline.transforms.resample import find_stride
from tracklake.schemas.columns import SEVERITIES

Integers = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float32]


def find_sizes(vehicles: pl.DataFrame, vehicle_id: Integers, *, where: str) -> tuple[Floats, Floats]:
    """Look up lengths and widths.

    Args:
        vehicles: vehicle_id (unique), length_m, width_m (null where the source has none), in any order.
        vehicle_id: (R,) whose are wanted.
        where: the subset, for messages.

    Returns:
        (R,) lengths and (R,) widths in m; NaN where there is none.

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
            f"for example vehicle {vehicle_id[np.argmax(unknown)]}; ingest the recording anew"
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
) -> npt.NDArray[np.uint8]:
    """Tell the worst severity of a vehicle's own findings at every tick.

    A tick stands for the frames after the tick before, up to its own: what a source of 25 Hz shows between two ticks
    is not lost. Ticks between two frames are made of both: the later one counts here, and again at the next tick.

    Args:
        vehicle_id: (N,) of entries on the clock, sorted by (vehicle_id, tick).
        tick: (N,) of the same.
        findings: vehicle_id, severity, first_frame, last_frame, in any order; they may overlap.
        first_frame: the subset's first frame, where tick 0 lies.
        frame_rate_hz: of the source.
        rate_hz: of the clock.

    Returns:
        (N,) 1 + position in SEVERITIES, the worst being 1; 0 where there is none.
    """
    stride = find_stride(frame_rate_hz=frame_rate_hz, rate_hz=rate_hz)
    ends = _key(vehicle_id, first_frame - (-tick * stride.numerator // stride.denominator))
    begins = _key(vehicle_id, first_frame + (tick - 1) * stride.numerator // stride.denominator + 1)
    marked = np.zeros(len(tick), dtype=np.uint8)
    for code, severity in reversed(list(enumerate(SEVERITIES, start=1))):  # the worse overwrites the less bad
        own = findings.filter(pl.col("severity") == severity)
        if own.is_empty():
            continue
        who = own["vehicle_id"].to_numpy().astype(np.int64)
        # Rows of a finding: from the first that does not end before it to the last that does not begin after it.
        first = np.searchsorted(ends, _key(who, own["first_frame"].to_numpy()), side="left")
        beyond = np.searchsorted(begins, _key(who, own["last_frame"].to_numpy()), side="right")
        open_findings = np.bincount(first, minlength=len(tick) + 1) - np.bincount(beyond, minlength=len(tick) + 1)
        marked[np.cumsum(open_findings)[:-1] > 0] = code
    return marked


def _key(vehicle_id: Integers, frame: npt.NDArray[np.integer]) -> Integers:
    """Vehicle and frame as one number of the same order, also for frames some way beyond those of Int32."""
    key: Integers = (vehicle_id << 32) + frame
    return key
