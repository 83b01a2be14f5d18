"""Features of a target and of the vehicle behind it: by hand, by a slow loop, mirrored, shifted, in any order."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lane_tracks import CODES

from tracklake.schemas.lane_forest import FEATURE_NAMES, FEATURE_NUMBER, FEATURES
from tracklake.schemas.tensors import NOMINAL_LANE_M
from tracklake.training.data.observed import ObservedScene
from tracklake.training.lane_changes.features import (
    choose_features,
    describe_targets,
    find_egos,
    mirror_targets,
    shift_targets,
    weigh_positions,
)

RATE, H = 10, 21
LANES = [[-4.0, 4.0, 1], [0.0, 4.0, 1], [4.0, 4.0, 1]]
PAST_S = np.arange(1 - H, 1) / RATE


def scene(*vehicles, lanes=LANES):
    """One scene: the target first; each vehicle is (H, 2) positions, or fewer where it came later."""
    history = np.zeros((1, len(vehicles), H, 2), np.float32)
    mask = np.zeros((1, len(vehicles), H), np.bool_)
    for number, positions in enumerate(vehicles):
        positions = np.asarray(positions, np.float32)
        history[0, number, : H - len(positions)] = positions[0]
        history[0, number, H - len(positions) :] = positions
        mask[0, number, H - len(positions) :] = True
    return ObservedScene(
        history=history,
        history_mask=mask,
        vehicle_mask=np.ones((1, len(vehicles)), np.bool_),
        size_m=np.zeros((1, len(vehicles), 2), np.float32),
        lanes=np.array([lanes], np.float32),
        all_lanes=np.array([lanes], np.float32),
    )


def drive(speed, *, x_m=0.0, y_m=0.0, accel=0.0, lateral_speed=0.0, lateral_accel=0.0, ticks=H):
    """Positions over the last ticks, ending at (x_m, y_m) with these speeds."""
    along = x_m + speed * PAST_S + accel / 2 * PAST_S**2
    across = y_m + lateral_speed * PAST_S + lateral_accel / 2 * PAST_S**2
    return np.stack([along, across], axis=1)[-ticks:]


def describe(*vehicles, rate_hz=RATE, **of_scene):
    values = describe_targets(scene(*vehicles, **of_scene), rate_hz)
    assert values.shape == (1, len(FEATURES))
    assert values.dtype == np.float32
    return dict(zip(FEATURE_NAMES, values[0].tolist(), strict=True))


def test_the_target_alone():
    found = describe(
        drive(20, accel=-1.5, lateral_speed=0.5, lateral_accel=0.25), lanes=[[0, 0, 0], [0.7, 4, 1], [4.7, 4, 1]]
    )
    # Heading and its change by hand: atan(0.5 / 20); (20 * 0.25 - 0.5 * -1.5) / (20^2 + 0.5^2). Over the history it
    # moved 2 s * 0.5 m/s - 0.25 / 2 * 2^2 = 0.5 m. It is 0.7 m left of the lane's centre.
    expected = {
        "speed_mps": 20,
        "accel_mps2": -1.5,
        "lateral_speed_mps": 0.5,
        "lateral_accel_mps2": 0.25,
        "heading_rad": 0.024994793,
        "yaw_rate_radps": 5.75 / 400.25,
        "moved_m": 0.5,
        "offset_m": -0.7,
        "left_marking_m": 1.3,
        "right_marking_m": 2.7,
        "left_lane": 0,
        "right_lane": 1,
    }
    others = dict.fromkeys(FEATURE_NAMES[FEATURE_NUMBER["ego"] :], 0)
    assert found == pytest.approx(expected | others, abs=2e-3, rel=1e-3)


def test_target_and_the_vehicle_behind():
    found = describe(drive(20, lateral_speed=0.5), drive(25, x_m=-30, y_m=-3.5, accel=1.0, lateral_speed=-0.5))
    expected = {
        "ego": 1,
        "ego_column": -1,
        "gap_m": 30,
        "side_m": 3.5,
        "relative_speed_mps": -5,
        "relative_accel_mps2": -1,
        "relative_lateral_speed_mps": 1,
        "relative_heading_rad": np.arctan(0.5 / 20) + np.arctan(0.5 / 25),
        "relative_yaw_rate_radps": -(0.5 * 1.0) / (25**2 + 0.5**2),
    }
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=2e-3, rel=1e-3)


def test_on_a_circle_the_yaw_rate_is_the_circle_s():
    turn = 0.08  # rad/s to the right at 18 m/s
    around = turn * PAST_S
    circle = 18 / turn * np.stack([np.sin(around), 1 - np.cos(around)], axis=1)
    found = describe(circle)
    assert (found["yaw_rate_radps"], found["speed_mps"]) == pytest.approx((turn, 18), rel=0.01)
    assert found["heading_rad"] == pytest.approx(0, abs=1e-3)


def test_at_standstill_nothing_is_noise():
    found = describe(drive(0, lateral_speed=0.1), drive(0, x_m=-5))
    assert found["heading_rad"] == pytest.approx(np.arctan(0.1), abs=1e-3), "as if at 1 m/s"
    assert all(np.isfinite(list(found.values())))


@pytest.mark.parametrize(
    ("others", "ego"),
    [
        ([], None),
        ([(40, 0)], None),  # ahead
        ([(0, 4)], None),  # alongside
        ([(-40, 0)], 1),
        ([(-60, 0), (-40, 0.9)], 2),  # the nearer
        ([(-5, 4), (-60, 0)], 2),  # one's own lane first, however far
        ([(-5, 4), (60, 0), (-4, -4)], 3),  # then the nearer of those beside
        ([(-5, 8)], None),  # two lanes away
        ([(-5, -6.1), (-50, 5.9)], 2),  # the outer edge of the lane beside is at 6 m
        ([(-5, 2.0), (-50, 1.99)], 2),  # the marking, at 2 m, is the right lane's
    ],
)
def test_who_the_ego_is(others, ego):
    found = scene(drive(20), *(drive(20, x_m=x_m, y_m=y_m) for x_m, y_m in others))
    which, there = find_egos(found, found.history_mask.sum(axis=2))
    assert (which.tolist(), there.tolist()) == (([ego], [True]) if ego else ([0], [False]))


def test_who_was_only_just_seen_is_no_ego():
    for ticks, ego in ((1, 2), (2, 1)):
        found = scene(drive(20), drive(22, x_m=-9, ticks=ticks), drive(20, x_m=-50))
        which, _ = find_egos(found, found.history_mask.sum(axis=2))
        assert which.tolist() == [ego]
    twice = describe(drive(20), drive(22, x_m=-9, accel=3, ticks=2))
    assert twice["relative_speed_mps"] == pytest.approx(-2 + 3 / 2 * 0.1, abs=1e-3), "a line through two positions"
    assert twice["relative_accel_mps2"] == pytest.approx(0, abs=1e-3)


def test_without_a_lane_a_nominal_one_lies_around_the_target():
    side = NOMINAL_LANE_M / 2
    nothing = np.zeros((3, 3))
    found = describe(drive(20), drive(20, x_m=-9, y_m=side + 0.01), lanes=nothing)
    assert (found["ego_column"], found["left_lane"], found["offset_m"]) == (1, 0, 0)
    assert describe(drive(20), drive(20, x_m=-9, y_m=side - 0.01), lanes=nothing)["ego_column"] == 0


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 12), st.sampled_from([2, 5, 10]))
def test_speeds_are_those_of_a_parabola_fitted_one_by_one(seed, known, rate_hz):
    place = np.random.default_rng(seed).uniform(-5, 5, known)
    weights = weigh_positions(12, rate_hz)[known] @ np.concatenate([np.full(12 - known, 99.0), place])
    expected = [0.0, 0.0]
    if known > 1:
        terms = np.polyfit(np.arange(1 - known, 1) / rate_hz, place, min(2, known - 1))[::-1]
        expected = [terms[1], 2 * terms[2] if known > 2 else 0.0]
    assert weights == pytest.approx(np.array(expected), rel=1e-6, abs=1e-6)


def random_scenes(seed, count=7, vehicles=5):
    draw = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        target = drive(*draw.uniform(0, 30, 1), accel=draw.normal(), lateral_speed=draw.normal())
        others = [
            drive(
                draw.uniform(0, 30),
                x_m=draw.uniform(-60, 60),
                y_m=draw.uniform(-9, 9),
                accel=draw.normal(),
                lateral_speed=draw.normal(),
                ticks=int(draw.integers(1, H + 1)),
            )
            for _ in range(vehicles - 1)
        ]
        offset, width, left, right = draw.uniform(-2, 2), draw.uniform(3, 4), *draw.integers(0, 2, 2)
        lanes = np.array([[offset - width, width, 1], [offset, width, 1], [offset + width, width, 1]])
        lanes[[0, 2]] *= np.array([[left], [right]])
        made.append(scene(target, *others, lanes=lanes))
    joined = {name: np.concatenate([getattr(one, name) for one in made]) for name in vars(made[0])}
    joined["vehicle_mask"][:, 1:] = draw.random((count, vehicles - 1)) < 0.8
    gone = ~joined["vehicle_mask"]
    for name in ("history", "history_mask"):
        joined[name][gone] = 0
    return ObservedScene(**joined)


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_mirrored_scenes_have_mirrored_features(seed):
    seen = random_scenes(seed)
    flip = np.array([1, -1], np.float32)
    lanes = seen.lanes[:, ::-1] * np.array([-1, 1, 1], np.float32)
    mirrored = describe_targets(replace(seen, history=seen.history * flip, lanes=lanes), RATE)
    features = describe_targets(seen, RATE)
    np.testing.assert_allclose(mirrored, mirror_targets(features), atol=1e-5)
    np.testing.assert_array_equal(mirror_targets(mirror_targets(features)), features)
    lateral = [FEATURE_NUMBER[name] for name in ("lateral_speed_mps", "offset_m")]
    np.testing.assert_array_equal(mirror_targets(features)[:, lateral], -features[:, lateral])


@settings(max_examples=25)
@given(st.integers(0, 10_000))
def test_order_of_scenes_and_of_vehicles_changes_nothing(seed):
    seen, draw = random_scenes(seed), np.random.default_rng(seed)
    scenes, vehicles = draw.permutation(7), np.concatenate([[0], 1 + draw.permutation(4)])
    other = ObservedScene(
        history=seen.history[scenes][:, vehicles],
        history_mask=seen.history_mask[scenes][:, vehicles],
        vehicle_mask=seen.vehicle_mask[scenes][:, vehicles],
        size_m=seen.size_m[scenes][:, vehicles],
        lanes=seen.lanes[scenes],
        all_lanes=seen.all_lanes[scenes],
    )
    np.testing.assert_array_equal(describe_targets(other, RATE), describe_targets(seen, RATE)[scenes])


def test_no_scenes_have_no_features():
    none = random_scenes(0).each(lambda array: array[:0])
    assert describe_targets(none, RATE).shape == (0, len(FEATURES))


def test_a_shift_moves_the_ego_alone_and_leaves_it_behind():
    features = np.zeros((4, len(FEATURES)), np.float32)
    gap, ego = FEATURE_NUMBER["gap_m"], FEATURE_NUMBER["ego"]
    features[:, ego] = [1, 1, 1, 0]
    features[:, gap] = [30, 30, 4, 0]
    shifted = shift_targets(features, np.array([5.0, -5.0, -5.0, 5.0], np.float32))
    assert shifted[:, gap].tolist() == [35, 25, 2, 0], "no nearer than half of 4 m; and a missing one is not moved"
    others = [number for number in range(len(FEATURES)) if number != gap]
    np.testing.assert_array_equal(shifted[:, others], features[:, others])


def test_features_are_chosen_by_their_correlation():
    draw = np.random.default_rng(5)
    maneuver = draw.integers(0, 3, 500).astype(np.uint8)
    feature = np.zeros((500, len(FEATURES)), np.float32)
    left, right = (maneuver == CODES[letter] for letter in "lr")
    feature[:, FEATURE_NUMBER["lateral_speed_mps"]] = right * 1.0 - left + draw.normal(scale=0.3, size=500)
    feature[:, FEATURE_NUMBER["moved_m"]] = feature[:, FEATURE_NUMBER["lateral_speed_mps"]] * 3 + draw.normal(
        scale=0.4, size=500
    )
    feature[:, FEATURE_NUMBER["speed_mps"]] = left * 2.0 + draw.normal(size=500)
    feature[:, FEATURE_NUMBER["gap_m"]] = draw.normal(size=500)
    feature[:, FEATURE_NUMBER["ego"]] = 1
    table = choose_features(feature, maneuver, least=0.2, most=0.95)
    assert len(table) == len(FEATURES)
    by_name = {row.feature: row for row in table}
    for name in ("lateral_speed_mps", "moved_m", "speed_mps", "gap_m"):
        expected = [np.corrcoef(feature[:, FEATURE_NUMBER[name]], maneuver == code)[0, 1] for code in range(3)]
        assert [by_name[name].keep, by_name[name].left, by_name[name].right] == pytest.approx(expected, abs=1e-6)
    strengths = [max(abs(row.keep), abs(row.left), abs(row.right)) for row in table]
    assert strengths == sorted(strengths, reverse=True)
    assert [row.feature for row in table if row.chosen] == ["lateral_speed_mps", "speed_mps"]
    alike = np.corrcoef(feature[:, FEATURE_NUMBER["moved_m"]], feature[:, FEATURE_NUMBER["lateral_speed_mps"]])[0, 1]
    assert by_name["moved_m"].reason == f"as lateral_speed_mps ({alike:.3f})"
    assert by_name["gap_m"].reason == by_name["ego"].reason == "below 0.2"
    assert by_name["ego"].strength == 0, "what does not vary says nothing"
    loose = choose_features(feature, maneuver, least=0.2, most=0.999)
    assert [row.feature for row in loose if row.chosen] == ["lateral_speed_mps", "moved_m", "speed_mps"]
