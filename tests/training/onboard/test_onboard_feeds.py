"""Feeds: the same origins and futures from overhead and as perceived; missed vehicles, ghosts and their warnings."""

import numpy as np
import polars as pl
import pytest
from drive_tables import make_drive, make_traffic

from tracklake.schemas.perception import FIRST_LIDAR_ID
from tracklake.training.onboard.feeds import pair_feeds, score_feeds, select_feeds
from tracklake.training.onboard.models import make_forecaster, predict_turns
from tracklake.training.onboard.samples import build_samples

BRAKING = {"speed": 20.0, "x_m": 30.0}


def score(feeds):
    model = make_forecaster("ctrv", predict_turns, feeds.overhead)
    rows = score_feeds([model], feeds)
    assert [(row.feed, row.seconds) for row in rows[::4]] == [("overhead", 0.5), ("perceived", 0.5)]
    return rows[3], rows[7]


def test_both_feeds_share_origins_and_futures():
    surrounding, truth, drives = make_traffic(8, noise_m=0.5)
    feeds = pair_feeds(surrounding, truth, drives)
    assert len(feeds.overhead) == len(feeds.perceived) == 8 * 16
    assert len(feeds.ghosts) == 0
    shared = feeds.overhead.select(feeds.shared)
    for name in ("place_m", "tick", "track", "vehicle", "maneuver", "subset"):
        np.testing.assert_array_equal(getattr(feeds.perceived, name), getattr(shared, name))
    overhead, perceived = score(feeds)
    assert overhead.n == perceived.n == 128
    assert perceived.rmse_m > overhead.rmse_m
    assert (perceived.missed_vehicles, perceived.false_vehicles) == (0, 0)


def test_a_vehicle_that_is_not_perceived_is_a_missed_warning():
    surrounding, truth, drives = make_drive([BRAKING, {"lane": 3}], ticks=61)
    feeds = pair_feeds(surrounding.filter(pl.col("vehicle_id") == 1), truth, drives)
    overhead, perceived = score(feeds)
    assert (len(feeds.overhead), len(feeds.perceived)) == (10, 5)
    assert (overhead.hits, overhead.missed_warnings, overhead.missed_vehicles) == (4, 0, 0)
    assert (perceived.hits, perceived.missed_warnings, perceived.missed_vehicles) == (0, 4, 5)
    assert perceived.true_warnings == 4


def test_a_ghost_is_a_false_vehicle_and_warns_falsely():
    surrounding, truth, drives = make_drive([{"lane": 3}, BRAKING], ticks=61, ids=[0, FIRST_LIDAR_ID])
    feeds = pair_feeds(surrounding, truth.filter(pl.col("truth_id") == 100), drives)
    assert feeds.ghosts.vehicle_id.tolist() == [FIRST_LIDAR_ID] * 9  # without a future, to the last tick
    _, perceived = score(feeds)
    assert (perceived.false_vehicles, perceived.true_warnings) == (9, 0)
    assert perceived.false_warnings == 8  # all but at tick 20, and before


def test_a_vehicle_perceived_twice_counts_once():
    surrounding, truth, drives = make_drive(
        [{}, {"x_m": 30.5}], ticks=61, ids=[4, FIRST_LIDAR_ID], truth_ids=[100, 100], noise_m=0.01
    )
    feeds = pair_feeds(surrounding, truth.unique(("truth_id", "tick"), keep="first", maintain_order=True), drives)
    assert feeds.perceived.vehicle_id.tolist() == [4] * 5
    assert feeds.ghosts.vehicle_id.tolist() == [FIRST_LIDAR_ID] * 5


def test_vehicles_are_selected_in_both_feeds():
    feeds = pair_feeds(*make_traffic(6))
    chosen = np.isin(feeds.overhead.track, (101, 104))
    some = select_feeds(feeds, chosen)
    assert set(some.perceived.track.tolist()) == {101, 104}
    np.testing.assert_array_equal(some.overhead.select(some.shared).track, some.perceived.track)


def test_penetration_changes_nothing_overhead():
    surrounding, truth, drives = make_traffic(6)
    few = surrounding.filter(pl.col("vehicle_id") < 2)
    np.testing.assert_array_equal(
        pair_feeds(few, truth, drives).overhead.feature, pair_feeds(surrounding, truth, drives).overhead.feature
    )
    assert len(build_samples(few, truth, drives).samples) == 32
    assert score(pair_feeds(few, truth, drives))[1].n == 32
    none = score(pair_feeds(surrounding.clear(), truth, drives))[1]
    assert (none.n, none.rmse_m, none.missed_vehicles) == (0, None, 96)
    assert pytest.approx(none.hits) == 0
