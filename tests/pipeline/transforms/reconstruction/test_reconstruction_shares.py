"""The reconstruction of a long subset, some whole tracks at a time, is that of the whole subset, value for value."""

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal
from recorded import make_facts, make_vehicles

from tracklake.pipeline.lake.scratch import open_scratch
from tracklake.pipeline.transforms.reconstruction.reconstruction import Reconstruction, reconstruct, reconstruct_shares

RATE_HZ = 10.0


def drive_platoons(seed, vehicles=14, ticks=160):
    """Vehicles close behind each other in two lanes, with noise, jumps, gaps, lane changes and leaders in circles."""
    rng = np.random.default_rng(seed)
    parts = []
    for number in range(vehicles):
        first = int(rng.integers(0, ticks // 2))
        frame = np.arange(first, min(ticks, first + int(rng.integers(3, ticks))))
        time_s, lane = frame / RATE_HZ, number % 2
        x = 12 * time_s - 3.6 * number + 2.5 * np.sin(0.5 * time_s + number) + rng.normal(0, 0.15, len(frame))
        x += rng.choice([0, 3.0, -2.0], p=[0.5, 0.3, 0.2]) * (frame > first + 30)
        x += 5000.0 * (number == 5 and seed % 3 == 0) * (frame % 7)  # outside of the table's ranges
        change = rng.integers(first, ticks) if number % 4 == 1 else ticks
        y = 2.0 + 3.5 * (lane + 1 / (1 + np.exp((change - frame) / 5))) + rng.normal(0, 0.05, len(frame))
        leader = np.where(frame % 40 < 35, number - 2, number + 2)
        leader = np.where((leader < 0) | (leader >= vehicles), -1, leader)
        part = pl.DataFrame(
            {"vehicle_id": 10 * number, "frame": frame, "x_m": x, "y_m": y, "leader_id": leader * 10}
        ).with_columns(lane=pl.lit(1 + lane) + (pl.col("frame") > change), time_s=pl.col("frame") / RATE_HZ)
        kept = np.ones(len(frame), bool)
        for lost in rng.integers(1, [4, 25]):
            begin = rng.integers(0, len(frame))
            kept[begin : begin + lost] = number % 3 == 0
        parts.append(part.filter(kept))
    return pl.concat(parts).with_columns(
        pl.col("vehicle_id", "frame").cast(pl.Int32),
        pl.col("lane").cast(pl.Int16),
        leader_id=pl.when(pl.col("leader_id") >= 0).then("leader_id").cast(pl.Int32),
    )


def describe(tracks, seed):
    vehicles = make_vehicles(tracks)
    place = pl.col("vehicle_id") // 10
    return vehicles.with_columns(
        pl.when(place % 5 == 4).then(pl.lit("truck")).otherwise("class").alias("class"),
        length_m=pl.when(place != seed % 9).then("length_m"),
    )


def read_by(tracks, at_once):
    """Functions that yield tracks of so many vehicles at a time; the first share has none."""
    ids = tracks["vehicle_id"].unique().sort().to_list()
    groups = [[], *(ids[first : first + at_once] for first in range(0, len(ids), at_once))]
    return lambda: [tracks.filter(pl.col("vehicle_id").is_in(group)) for group in groups]


@given(
    seed=st.integers(0, 10_000),
    vehicles_at_once=st.integers(1, 8),
    at_once=st.integers(1, 900),
    has_lanes=st.booleans(),
)
@settings(max_examples=20)  # each reconstructs twice
def test_shares_are_those_of_the_whole(tmp_path_factory, seed, vehicles_at_once, at_once, has_lanes):
    tracks = drive_platoons(seed)
    tracks = tracks if has_lanes else tracks.with_columns(lane=pl.lit(None, pl.Int16))
    vehicles = describe(tracks, seed)
    whole = reconstruct(tracks, vehicles, make_facts(RATE_HZ))
    with open_scratch(tmp_path_factory.mktemp("scratch")) as make_store:
        made = list(
            reconstruct_shares(
                read_by(tracks, vehicles_at_once), vehicles, make_facts(RATE_HZ), make_store=make_store, at_once=at_once
            )
        )
    assert len(made) > len(vehicles) / vehicles_at_once + 1
    *shares, rest = made
    assert_frame_equal(pl.concat([share.entries for share in shares]), whole.entries, check_exact=True)
    for name in ("quality", "skips", "unkept"):
        assert_frame_equal(getattr(rest, name), getattr(whole, name), check_exact=True)
        assert all(getattr(share, name).is_empty() for share in shares)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_platoons_have_what_shares_could_spoil(seed):
    done = reconstruct(drive_platoons(seed), describe(drive_platoons(seed), seed), make_facts(RATE_HZ))
    assert done.entries["imputed"].any()
    assert done.entries["constrained"].mean() > 0.05
    assert {"overlap", "acceleration"} & set(done.unkept["bound"])
    assert set(done.skips["reason"]) >= {"no_length"}
    assert done.quality["moved_over_half_m_share"].item() > 0.01


def test_a_subset_of_which_nothing_can_be_reconstructed_in_shares():
    tracks = drive_platoons(1)
    facts = make_facts(RATE_HZ, freeway=False)
    *shares, rest = reconstruct_shares(read_by(tracks, 5), make_vehicles(tracks), facts)
    whole = reconstruct(tracks, make_vehicles(tracks), facts)
    assert isinstance(whole, Reconstruction)
    assert sum(share.entries.height for share in shares) == whole.entries.height == 0
    assert_frame_equal(rest.quality, whole.quality)
    assert_frame_equal(rest.skips, whole.skips)
    assert rest.skips["entries"].item() == tracks.height
