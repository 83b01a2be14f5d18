"""Messages in the ego's frame: what they say at the tick by which they arrived, worked out by hand."""

import numpy as np
import polars as pl
import pytest
from drive_scenes import conform

from tracklake.pipeline.transforms.onboard.ego import EgoTrack
from tracklake.pipeline.transforms.onboard.geodesy import convert_to_ecef
from tracklake.pipeline.transforms.onboard.relative import advance, choose_messages, place_messages
from tracklake.schemas import BSM

DEGREE_EAST_M = 111_319.49


def make_messages(**columns):
    constants = {"own": False, "temporary_id": "00", "lost_before": 0, "lat_deg": 0.0, "lon_deg": 0.0, "vehicle_id": 1}
    return conform(
        BSM,
        pl.DataFrame({**columns}).with_columns(
            **{name: pl.lit(value) for name, value in constants.items() if name not in columns}
        ),
    )


def make_ego(ticks, heading_deg=90.0):
    """An ego that stands on the equator, heading east."""
    zero = np.zeros(ticks)
    return EgoTrack(
        known=np.ones(ticks, dtype=bool),
        start=np.ones(ticks, dtype=np.int64),
        ecef_m=convert_to_ecef(zero, zero, zero),
        lat_deg=zero,
        lon_deg=zero,
        height_m=zero,
        heading_rad=np.full(ticks, np.radians(heading_deg)),
        heading_sigma_rad=zero,
        speed_mps=zero,
        yaw_rate_radps=zero,
        odometry_m=np.zeros((ticks, 2)),
        odometry_rad=zero,
    )


def test_age_is_made_up_for_by_the_speed():
    """50 m ahead at 0.0 s, 20 m/s along the road; received at 0.22 s, so used at 0.3 s: 56 m ahead."""
    message = make_messages(
        time_s=[0.0], received_s=[0.22], lon_deg=[50 / DEGREE_EAST_M], speed_mps=[20.0], heading_deg=[90.0]
    )
    placed = place_messages(message, make_ego(5))
    assert placed.tick.tolist() == [3]
    assert placed.age_s == pytest.approx([0.3])
    assert placed.centre_m[0] == pytest.approx([56.0, 0.0], abs=1e-3)
    assert placed.heading_rad[0] == pytest.approx(0.0, abs=1e-6)


def test_right_is_positive_and_headings_are_clockwise():
    """South of an ego that heads east lies to its right; a vehicle that heads south drives to its right."""
    message = make_messages(
        time_s=[0.0], received_s=[0.1], lat_deg=[-10 / 110_574.3], speed_mps=[10.0], heading_deg=[180.0]
    )
    placed = place_messages(message, make_ego(5))
    assert placed.centre_m[0] == pytest.approx([0.0, 11.0], abs=1e-3)
    assert np.degrees(placed.heading_rad[0]) == pytest.approx(90.0)


def test_way_on_a_circle_and_with_braking():
    """A quarter of a circle to the right, radius 10 / (pi / 2) m; straight on; and braking to a standstill."""
    ahead, right = advance(
        np.array([10.0, 10.0, 1.0]), np.array([0, -2.0, -8.0]), np.array([np.pi / 2, 0, 0]), np.ones(3)
    )
    assert ahead == pytest.approx([20 / np.pi, 9.0, 0.0])
    assert right == pytest.approx([20 / np.pi, 0.0, 0.0])


def test_only_what_has_arrived_and_is_newer_is_used():
    messages = make_messages(
        time_s=[0.0, 0.1, 0.2, 0.3, 0.4],
        received_s=[0.05, 0.45, 0.25, 0.28, 1.9],  # the second arrives after the third; the last is 1.5 s old
    )
    assert choose_messages(messages, 30).select("tick", "time_s").rows() == [(1, 0.0), (3, 0.3)]
    unlogged = make_messages(time_s=[0.0, 0.13], received_s=[None, None])
    assert choose_messages(unlogged, 30).select("tick", "time_s").rows() == [(0, 0.0), (2, 0.13)]


def test_unknown_values_stay_unknown():
    placed = place_messages(make_messages(time_s=[0.0], received_s=[0.1]), make_ego(3))
    assert np.isnan(placed.heading_rad[0])
    assert np.isnan(placed.speed_mps[0])
    assert placed.centre_m[0] == pytest.approx([0.0, 0.0])
    assert placed.accuracy_m[0] == 1.5


def test_own_messages_and_ticks_without_ego_are_left_out():
    ego = make_ego(3)
    ego.known[1] = False
    messages = make_messages(time_s=[0.0, 0.1, 0.2], received_s=[0.0, 0.1, 0.2], own=[True, False, False])
    assert place_messages(messages, ego).tick.tolist() == [2]
    assert len(place_messages(messages.clear(), ego).tick) == 0
