"""Small scenes for the derived traffic tables: written down by hand, and drawn at random."""

from collections.abc import Mapping, Sequence

import polars as pl
from hypothesis import strategies as st

from tracklake.pipeline.transforms.tracks.gaps import add_gaps
from tracklake.pipeline.transforms.traffic.scene import Scene
from tracklake.schemas import TRACKS, Table

DEFAULTS = {"y_m": 0.0, "lane": 1, "speed_mps": 0.0, "accel_mps2": 0.0, "leader_id": None, "follower_id": None}
PLACE = {"dataset": "highd", "subset": "01-lower"}


def make_scene(
    rows: Sequence[Mapping], *, lengths: Mapping[int, float | None] | None = None, rate_hz=10.0, end_s=None
) -> Scene:
    """The scene of entries (vehicle_id, frame, x_m and what differs from DEFAULTS); vehicles are 4 m long."""
    filled = [{**DEFAULTS, "accel_10hz_mps2": None, "headway_recorded_m": None, **row} for row in rows]
    names = [*filled[0]] if filled else [*DEFAULTS, "vehicle_id", "frame", "x_m", "accel_10hz_mps2"]
    names += ["headway_recorded_m"] * ("headway_recorded_m" not in names)
    tracks = pl.DataFrame(filled, schema={name: TRACKS.dtypes[name] for name in names}).sort("vehicle_id", "frame")
    ids = tracks["vehicle_id"].unique(maintain_order=True).to_list()
    vehicles = pl.DataFrame(
        {"vehicle_id": ids, "length_m": [(lengths or {}).get(vehicle, 4.0) for vehicle in ids]},
        schema={"vehicle_id": pl.Int32, "length_m": pl.Float32},
    )
    tracks = add_gaps(tracks, vehicles, use_recorded_headway=False)
    last = tracks["frame"].max()
    return Scene(tracks, vehicles, rate_hz, 0, (last or 0) / rate_hz if end_s is None else end_s)


def drive(vehicle: int, frames: Sequence[int], x_m: float, speed_mps: float, *, rate_hz=10.0, **columns) -> list[dict]:
    """Entries of a vehicle at constant speed from `x_m` on; a column is one value, or a function of the frame."""
    return [
        {
            "vehicle_id": vehicle,
            "frame": frame,
            "x_m": x_m + speed_mps * (frame - frames[0]) / rate_hz,
            "speed_mps": speed_mps,
            **{name: value(frame) if callable(value) else value for name, value in columns.items()},
        }
        for frame in frames
    ]


def complete(frame: pl.DataFrame, table: Table) -> pl.DataFrame:
    """The rows as the lake would hold them, checked against the table's declaration."""
    placed = frame.lazy().with_columns(pl.lit(value).alias(name) for name, value in PLACE.items())
    return table.validate(table.conform(placed.sort(table.key)).collect(), where="test")


@st.composite
def draw_rows(draw) -> list[dict]:
    """Entries of up to four vehicles: gaps, single entries, lanes and leaders that come and go, ids at the limits."""
    ids = draw(st.lists(st.sampled_from([0, 1, 2, 7, 2**31 - 1]), min_size=1, max_size=4, unique=True))
    rows = []
    for vehicle in ids:
        frames = draw(st.lists(st.integers(0, 12), min_size=1, max_size=10, unique=True))
        x_m = draw(st.floats(-50, 150))
        for frame in sorted(frames):
            x_m += draw(st.sampled_from([-0.5, 0.0, 0.3, 2.0, 30.0]))
            rows.append(
                {
                    "vehicle_id": vehicle,
                    "frame": frame,
                    "x_m": round(x_m, 3),
                    "y_m": draw(st.sampled_from([0.0, 0.4, 3.0, 5.5])),
                    "lane": draw(st.sampled_from([1, 1, 1, 2, None])),
                    "speed_mps": draw(st.sampled_from([-1.0, 0.0, 4.0, 20.0, 33.3])),
                    "accel_mps2": draw(st.sampled_from([None, -2.0, 0.0, 1.0])),
                    "leader_id": draw(st.sampled_from([None, 5, *(other for other in ids if other != vehicle)])),
                    "follower_id": draw(st.sampled_from([None, 5, *(other for other in ids if other != vehicle)])),
                }
            )
    return rows
