"""Rows of exported car following: an entry of the follower, its leader's at the same time, and what is between."""

import numpy as np
import polars as pl

from tracklake.pipeline.transforms.traffic.car_following import classify_regimes
from tracklake.pipeline.transforms.traffic.scene import Scene
from tracklake.schemas.arrays import expand_ranges
from tracklake.schemas.traffic import REGIMES

COLUMNS = {
    "dataset": (pl.String, "data set"),
    "subset": (pl.String, "one carriageway of one recording"),
    "episode": (pl.Int32, "number of the episode in the subset, from 1"),
    "follower_id": (pl.Int32, "the follower's vehicle_id"),
    "leader_id": (pl.Int32, "the leader's vehicle_id"),
    "lane": (pl.Int16, "lane of both; 1 is the driver's leftmost"),
    "frame": (pl.Int32, "the source's frame number"),
    "time_s": (pl.Float64, "time since the recording's first frame, s"),
    "x_m": (pl.Float64, "position of the follower's front along the road, m"),
    "speed_mps": (pl.Float64, "speed of the follower, m/s"),
    "accel_mps2": (pl.Float64, "acceleration of the follower, m/s2; recomputed where the source has none"),
    "length_m": (pl.Float64, "length of the follower, m"),
    "class": (pl.String, "class of the follower"),
    "leader_x_m": (pl.Float64, "position of the leader's front along the road, m"),
    "leader_speed_mps": (pl.Float64, "speed of the leader, m/s"),
    "leader_accel_mps2": (pl.Float64, "acceleration of the leader, m/s2; recomputed where the source has none"),
    "leader_length_m": (pl.Float64, "length of the leader, m"),
    "leader_class": (pl.String, "class of the leader"),
    "gap_m": (pl.Float64, "leader's front - leader's length - follower's front, m; negative = overlap"),
    "relative_speed_mps": (pl.Float64, "speed of the leader - that of the follower, m/s; negative = the gap closes"),
    "regime": (pl.String, f"one of {', '.join(REGIMES)}; empty where the acceleration is unknown"),
}
"""Type and meaning of every exported column, by name."""
DECIMALS = 4
"""Decimals of exported numbers: tracks have single precision in speeds and millimetres in recorded positions."""


def expand_episodes(scene: Scene, episodes: pl.DataFrame, vehicles: pl.DataFrame) -> pl.DataFrame:
    """Write episodes out, one row per entry, by episode and frame.

    Args:
        scene: the subset's entries that the episodes were found in.
        episodes: vehicle_id, first_frame, entries of `car_following`, sorted by the first two.
        vehicles: vehicle_id, class, length_m of the subset.

    Returns:
        COLUMNS but for dataset and subset.
    """
    first, _ = scene.find_entries(episodes["vehicle_id"].to_numpy(), episodes["first_frame"].to_numpy())
    own, episode = expand_ranges(first, episodes["entries"].to_numpy().astype(np.int64))
    leader = scene.leader_rows[0][own]
    x_m, speed_mps, gap_m = (scene.read(name) for name in ("x_m", "speed_mps", "gap_m"))
    accel_mps2 = scene.read_acceleration()
    regime = classify_regimes(speed_mps[own], accel_mps2[own], x_m[leader] - x_m[own])
    rows = pl.DataFrame(
        {
            "episode": episode + 1,
            "follower_id": scene.ids[own],
            "leader_id": scene.ids[leader],
            "lane": scene.lanes[own],
            "frame": scene.frames[own],
            "time_s": (scene.frames[own] - scene.first_frame) / scene.rate_hz,
            "x_m": x_m[own],
            "speed_mps": speed_mps[own],
            "accel_mps2": accel_mps2[own],
            "leader_x_m": x_m[leader],
            "leader_speed_mps": speed_mps[leader],
            "leader_accel_mps2": accel_mps2[leader],
            "gap_m": gap_m[own],
            "relative_speed_mps": speed_mps[leader] - speed_mps[own],
            "regime": pl.Series(regime).replace_strict(dict(enumerate(REGIMES)), default=None, return_dtype=pl.String),
        }
    ).fill_nan(None)
    for side, prefix in (("follower_id", ""), ("leader_id", "leader_")):
        facts = vehicles.select(pl.col("vehicle_id").alias(side), pl.col("class", "length_m").name.prefix(prefix))
        rows = rows.join(facts, on=side, how="left", maintain_order="left")
    chosen = rows.select(pl.col(name).cast(dtype) for name, (dtype, _) in COLUMNS.items() if name in rows.columns)
    return chosen.with_columns(pl.col(pl.Float64).round(DECIMALS))
