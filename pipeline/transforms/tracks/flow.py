"""Flow of a carriageway by Edie's generalised definition."""

import polars as pl


def compute_flow(tracks: pl.DataFrame, *, lanes: int | None, rate_hz: float, seconds: float) -> float | None:
    """Compute vehicles per hour and lane: distance driven on the main lanes / (length * lanes * time) (Edie 1963).

    An entry drives its recorded speed for 1 / frame rate, as in the macro `flow_density`, whose lanes 1 to `lanes` have
    this mean over the whole recording.

    `tracks` have x_m, lane, speed_mps of one subset; `seconds` is the length of the recording. None where the lanes or
    the section's length are unknown.
    """
    if lanes is None:
        return None
    on_main_lane = pl.col("lane").is_between(1, lanes)
    length_m, is_known, speeds_mps = tracks.select(
        pl.col("x_m").max() - pl.col("x_m").min(),
        pl.col("lane").is_not_null().any(),
        pl.col("speed_mps").filter(on_main_lane).cast(pl.Float64).sum(),
    ).row(0)
    if not (length_m and is_known):
        return None
    return float(3600 * speeds_mps / rate_hz / (length_m * lanes * seconds))
