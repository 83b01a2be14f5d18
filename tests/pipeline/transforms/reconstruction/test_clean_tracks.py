"""Tracks with other positions: by hand, and against a slow loop over the entries."""

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tracklake.pipeline.transforms.reconstruction.clean_tracks import MOTION, replace_positions
from tracklake.pipeline.transforms.tracks.kinematics import add_kinematics
from tracklake.schemas import RECONSTRUCTED, TRACKS

LAST_ID = 2**31 - 1
VEHICLES = pl.DataFrame(
    {"vehicle_id": [1, 2, LAST_ID], "length_m": [4.0, None, 5.0]},
    schema={"vehicle_id": pl.Int32, "length_m": pl.Float32},
)
LENGTHS = dict(VEHICLES.iter_rows())


def make_tracks(rows):
    """Entries of TRACKS from {(vehicle, frame): {column: value}}; what is not given is null, or 0 where it must not."""
    given = {"dataset": "highd", "subset": "01-upper", "time_s": 0.0, "x_m": 0.0, "y_m": 0.0, "speed_mps": 0.0}
    full = [
        dict.fromkeys(TRACKS.columns) | given | {"vehicle_id": key[0], "frame": key[1]} | own
        for key, own in sorted(rows.items())
    ]
    return pl.DataFrame(full, schema=TRACKS.dtypes)


def make_motion(rows):
    """Entries of RECONSTRUCTED from {(vehicle, frame): x}, whose other values tell them apart."""
    full = [
        {"vehicle_id": key[0], "frame": key[1], "x_m": x, "y_m": x / 10, "speed_mps": 7.0, "accel_mps2": 0.5,
         "lateral_speed_mps": 0.25}
        for key, x in sorted(rows.items())
    ]  # fmt: skip
    return pl.DataFrame(full, schema={name: RECONSTRUCTED.dtypes[name] for name in ("vehicle_id", "frame", *MOTION)})


def replace(tracks, motion, rate_hz=10.0, first_frame=1):
    return replace_positions(tracks, motion, VEHICLES, {"frame_rate_hz": rate_hz, "first_frame": first_frame})


def test_a_filled_gap_by_hand():
    # Vehicle 1 is not seen in frames 3 to 6; it changes from lane 2 to lane 3 and keeps its leader.
    seen = {
        (1, 1): {"x_m": 10.0, "lane": 2, "leader_id": LAST_ID, "follower_id": 2, "accel_mps2": 1.0},
        (1, 2): {"x_m": 11.0, "lane": 2, "leader_id": LAST_ID, "follower_id": 2, "headway_recorded_m": 20.0},
        (1, 7): {"x_m": 16.0, "lane": 3, "leader_id": LAST_ID},
        (2, 1): {"x_m": 0.0, "leader_id": 1, "gap_m": 99.0},
        (2, 9): {"x_m": 5.0, "leader_id": 1, "gap_m": 3.5},  # its leader has no entry: the recorded headway's
        (LAST_ID, 4): {"x_m": 33.0},
    }
    motion = {(1, 1): 10.5, (1, 2): 11.5} | {(1, frame): 9.5 + frame for frame in range(3, 7)}
    found = replace(make_tracks(seen), make_motion(motion))
    assert found.select("vehicle_id", "frame").rows() == sorted(seen.keys() | motion.keys())
    own = found.filter(pl.col("vehicle_id") == 1)
    assert own["x_m"].to_list() == [10.5, 11.5, 12.5, 13.5, 14.5, 15.5, 16.0]
    assert own["time_s"].to_list() == pytest.approx([0.0, 0.0, 0.2, 0.3, 0.4, 0.5, 0.0])  # of new entries alone
    assert own["lane"].to_list() == [2, 2, 2, 2, 3, 3, 3]
    assert own["leader_id"].to_list() == [LAST_ID] * 7
    assert own["follower_id"].to_list() == [2, 2, None, None, None, None, None]
    assert own["accel_mps2"].to_list() == [0.5] * 6 + [None]
    assert own["gap_m"].to_list() == [None, None, None, 33.0 - 5.0 - 13.5, None, None, None]
    assert own["headway_recorded_m"].to_list() == [None, 20.0] + [None] * 5
    assert own["speed_cd_mps"].to_list() == pytest.approx([None, 10.0, 10.0, 10.0, 10.0, 7.5, None])
    assert found.filter(pl.col("vehicle_id") == 2)["gap_m"].to_list() == [10.5 - 4.0 - 0.0, 3.5]


tracks_of_vehicles = st.dictionaries(
    st.tuples(st.sampled_from([1, 2, LAST_ID]), st.integers(1, 12)),
    st.tuples(st.integers(0, 400), st.sampled_from([None, 1, 2, LAST_ID]), st.sampled_from([None, 1, 2])),
    max_size=30,
)


@given(
    recorded=tracks_of_vehicles,
    new=st.dictionaries(st.integers(0, 40), st.integers(-4, 4)),
    rate=st.sampled_from([10.0, 25.0]),
)
@settings(max_examples=30)
def test_tracks_are_those_of_a_slow_loop(recorded, new, rate):
    tracks = make_tracks(
        {key: {"x_m": float(x), "leader_id": leader, "lane": lane} for key, (x, leader, lane) in recorded.items()}
    )
    inside = [
        (vehicle, frame)
        for vehicle in sorted({key[0] for key in recorded})
        for frame in range(*(edge(own[1] for own in recorded if own[0] == vehicle) for edge in (min, max)))
    ]
    motion = {inside[at % len(inside)]: 50.0 + shift for at, shift in new.items()} if inside else {}
    found = replace(tracks, make_motion(motion), rate)
    assert found.schema == TRACKS.dtypes
    keys = sorted(recorded.keys() | motion.keys())
    assert found.select("vehicle_id", "frame").rows() == keys
    x_m = {key: motion.get(key, recorded.get(key, (None,))[0]) for key in keys}
    assert found["x_m"].to_list() == [x_m[key] for key in keys]
    assert found["speed_mps"].to_list() == [7.0 if key in motion else 0.0 for key in keys]
    for row in found.iter_rows(named=True):
        key = (row["vehicle_id"], row["frame"])
        sides = [max((k for k in recorded if k[0] == key[0] and k[1] <= key[1]), default=None),
                 min((k for k in recorded if k[0] == key[0] and k[1] >= key[1]), default=None)]  # fmt: skip
        before, after = sides
        nearer = before if key[1] - before[1] <= after[1] - key[1] else after
        assert row["lane"] == recorded[nearer][2]
        leader = recorded[before][1] if recorded[before][1] == recorded[after][1] else None
        assert row["leader_id"] == leader
        ahead, length = x_m.get((leader, key[1])), LENGTHS.get(leader)
        assert row["gap_m"] == (None if None in (ahead, length) else ahead - length - row["x_m"])
    derived = ["speed_cd_mps", "accel_cd_mps2", "speed_10hz_mps", "accel_10hz_mps2"]
    again = add_kinematics(found.drop(derived), rate).select(pl.col(derived).cast(pl.Float32))
    assert found.select(derived).equals(again)


def test_without_new_positions_only_derived_columns_may_differ():
    tracks = make_tracks({(1, 1): {"x_m": 5.0, "gap_m": 1.0, "heading_rad": 0.1}})
    assert replace(tracks, make_motion({})).equals(tracks)
    assert replace(TRACKS.empty(), make_motion({})).equals(TRACKS.empty())
