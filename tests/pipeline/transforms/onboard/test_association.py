"""Vehicles measured by LiDAR: a plain ray caster makes the scans, so every position is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ray_caster import SCANNER_Z_M, CarBox, cast_rays, truck

from tracklake.pipeline.transforms.onboard.association import measure_by_lidar
from tracklake.pipeline.transforms.onboard.measurements import LidarMeasurement, Predicted
from tracklake.schemas.arrays import Floats
from tracklake.schemas.perception import FIRST_LIDAR_ID, SIDES

NOISE_M = 0.03


def predict(boxes: list[CarBox], error_m: Floats | float = 0.0, sd_m: float = 1.0, *, sends: bool = True) -> Predicted:
    """Predict boxes with an error; vehicles that send no messages are of unknown size."""
    count = len(boxes)
    size = np.array([(box.length_m, box.width_m) for box in boxes]).reshape(-1, 2)
    return Predicted(
        vehicle_id=np.arange(count) + (0 if sends else FIRST_LIDAR_ID),
        centre_m=np.array([(box.x_m, box.y_m) for box in boxes]).reshape(-1, 2) + error_m,
        covariance_m2=np.tile(np.eye(2) * sd_m**2, (count, 1, 1)),
        heading_rad=np.radians([box.heading_deg for box in boxes]),
        size_m=size if sends else np.full((count, 2), np.nan),
    )


def measure_one(box: CarBox, *, sends: bool = True, seed: int = 0, error_m: float = 0.0) -> tuple[Floats, Floats, str]:
    """Measure one vehicle alone: the error of its centre, the standard deviations, and the side."""
    points, _ = cast_rays([box], noise_m=NOISE_M, seed=seed)
    found = measure_by_lidar(points, predict([box], error_m, sends=sends))
    measured = found.measured
    assert measured.row.tolist() == [0]
    error = measured.centre_m[0] - (box.x_m, box.y_m)
    return error, np.sqrt(np.diagonal(measured.covariance_m2[0])), SIDES[found.association["side"][0]]


@pytest.mark.parametrize("distance_m", [20.0, 50.0, 80.0])
@pytest.mark.parametrize("lane_m", [0.0, 3.6, -3.6])
def test_car_with_a_known_size_is_measured_to_a_decimetre(distance_m: float, lane_m: float) -> None:
    """At 80 m a car gives six returns on one beam; the spacing at its corners is corrected, not added to its place."""
    error, sd, side = measure_one(CarBox(distance_m, lane_m), error_m=0.7)
    assert np.hypot(*error) < 0.15
    assert (np.abs(error) < 3 * sd).all()
    assert (sd < 0.12).all()
    assert side == "rear"


@pytest.mark.parametrize(
    ("box", "side"),
    [
        (CarBox(50.0, 2.0, -10.0), "rear"),
        (CarBox(8.0, -3.6), "rear"),
        (CarBox(0.5, 3.6), "left"),
        (CarBox(-1.0, -3.6), "right"),
        (CarBox(-25.0, 0.0), "front"),
        (truck(3.0, 3.6), "left"),
        (truck(50.0, 3.6), "rear"),
        (truck(-50.0, -3.6), "front"),
        (CarBox(30.0, -7.0, 180.0), "front"),
    ],
)
def test_side_of_the_vehicle_follows_from_heading_and_bearing(box: CarBox, side: str) -> None:
    """Rear, front or side: the centre is right whichever the scanner sees."""
    error, sd, found = measure_one(box)
    assert found == side
    assert np.hypot(*error) < 0.15
    assert (np.abs(error) < 3 * sd).all()


@pytest.mark.parametrize("box", [CarBox(50.0, 0.0), CarBox(30.0, 3.6), truck(50.0, 3.6), truck(50.0, 0.0)])
def test_unknown_length_shows_in_the_covariance_along_the_line_of_sight(box: CarBox) -> None:
    """The rear is known to centimetres, the centre only as well as the length."""
    error, sd, _ = measure_one(box, sends=False)
    assert sd[0] > 0.1
    assert (np.abs(error) < 3 * sd).all()
    assert abs(error[1]) < 0.15


def test_nearest_return_alone_would_be_biased_by_the_spacing_of_the_beams() -> None:
    """The lateral error over many phases of the beams has no bias and is far below the spacing, 0.28 m at 80 m."""
    box = CarBox(80.0, 0.0)
    errors = []
    for phase in (np.arange(16) + 0.5) / 16:
        points, _ = cast_rays([box], noise_m=NOISE_M, seed=int(100 * phase), phase=float(phase))
        errors.append(measure_by_lidar(points, predict([box])).measured.centre_m[0] - (80.0, 0.0))
    mean, rms = np.mean(errors, axis=0), np.sqrt(np.mean(np.square(errors), axis=0))
    assert abs(mean[1]) < 0.04
    assert rms[1] < 0.09
    assert abs(mean[0]) < 0.02


def test_vehicle_without_messages_is_new_and_later_its_own() -> None:
    """An unexpected car is row -1; expected as a LiDAR vehicle it is that one."""
    box = CarBox(30.0, 3.6)
    points, _ = cast_rays([box], noise_m=NOISE_M)
    new = measure_by_lidar(points, predict([]))
    assert new.measured.row.tolist() == [-1]
    assert np.hypot(*(new.measured.centre_m[0] - (30.0, 3.6))) < 0.5
    assert np.isnan(new.association["gate"]).all()
    assert measure_by_lidar(points, predict([box], 0.3, sends=False)).measured.row.tolist() == [0]


def test_what_cannot_be_a_vehicle_is_a_cluster_and_no_measurement() -> None:
    """A barrier of 60 m, a wall far beside the road, a post, and a lone return."""
    barrier = CarBox(40.0, 8.0, 0.0, 60.0, 0.3, 0.9, 0.0)
    house = CarBox(10.0, 40.0, 0.0, 12.0, 6.0, 8.0, 0.0)
    post = CarBox(20.0, -9.0, 0.0, 0.15, 0.15, 3.0, 0.0)
    points, _ = cast_rays([barrier, house, post], noise_m=NOISE_M)
    found = measure_by_lidar(np.vstack([points, [[15.0, -3.0, 1.0]]]), predict([]))
    assert found.measured.row.size == 0
    assert found.clusters["cluster"].size >= 4


def test_truck_of_unknown_length_leaves_the_returns_of_the_car_behind_it() -> None:
    """Only the front of the truck is uncertain: it takes no returns before its rear, 3 m ahead of a car's front."""
    boxes = [CarBox(25.0, -3.75), truck(37.0, -3.7)]
    points, hit = cast_rays(boxes, noise_m=NOISE_M)
    guess = predict(boxes, 0.2, 0.5)
    guess.vehicle_id[1], guess.size_m[1] = FIRST_LIDAR_ID, np.nan
    found = measure_by_lidar(points, guess)
    assert found.measured.row.tolist() == [0, 1]
    returns = found.clusters["returns"][found.measured.cluster]
    assert returns.tolist() == np.bincount(hit).tolist()


@pytest.mark.parametrize(("box", "lean"), [(truck(50.0, 0.0), 1.0), (truck(-50.0, 0.0), -1.0)])
def test_centre_leans_on_the_end_that_is_seen(box: CarBox, lean: float) -> None:
    """A longer truck whose rear is seen has its centre farther ahead, one whose front is seen farther back."""
    points, _ = cast_rays([box], noise_m=NOISE_M)
    measured = measure_by_lidar(points, predict([box], sends=False)).measured
    assert measured.lean[0] == pytest.approx(lean, abs=0.01)
    end = measured.centre_m[0, 0] - lean * measured.size_m[0, 0] / 2
    assert end == pytest.approx(box.x_m - lean * box.length_m / 2, abs=0.15)


def test_strip_of_a_rear_that_a_truck_leaves_free_tells_where_the_rear_is() -> None:
    """Two returns are 0.2 m apart across and as deep; on the car's side, beams that far apart would be 5 m apart."""
    boxes = [CarBox(66.0, -3.6), truck(30.0, -3.0)]
    points, hit = cast_rays(boxes, noise_m=NOISE_M)
    rear = (hit == 0) & (points[:, 0] < 64.0)
    assert rear.sum() == 2
    assert 0.1 < np.ptp(points[rear, 1]) < 0.3
    found = measure_by_lidar(points[rear | (hit == 1)], predict(boxes, 0.5)).measured
    assert found.row.tolist() == [0, 1]
    assert abs(found.centre_m[0, 0] - 66.0) < 0.3


def test_certain_vehicle_keeps_its_returns_from_an_uncertain_one_in_its_cluster() -> None:
    """Two trucks in the next lanes, 0.7 m between them, give one cluster; of one, neither length nor place is known."""
    boxes = [truck(-49.2, 3.6), truck(-49.4, 0.38)]
    points, _ = cast_rays(boxes, noise_m=NOISE_M)
    guess = predict(boxes, 0.0, 0.15)
    guess.vehicle_id[1], guess.size_m[1], guess.covariance_m2[1] = FIRST_LIDAR_ID, np.nan, np.diag([14.0, 0.3])
    guess.centre_m[1] += (-0.6, -0.02)
    found = measure_by_lidar(points, guess)
    own = found.clusters["least_y_m"][found.measured.cluster[found.measured.row == 0]]
    assert own.min() > 2.0
    other = found.clusters["most_y_m"][found.measured.cluster[found.measured.row == 1]]
    assert other.max() < 2.0


def test_two_cars_in_one_cluster_are_parted() -> None:
    """Bumper to bumper with 0.6 m between, and side by side with 0.5 m."""
    queue = [CarBox(10.0, 3.6), CarBox(15.2, 3.6)]
    pair = [CarBox(18.0, -1.2), CarBox(18.0, 1.15)]
    for boxes in (queue, pair):
        points, hit = cast_rays(boxes, noise_m=NOISE_M)
        assert set(hit) == {0, 1}
        found = measure_by_lidar(points, predict(boxes, 0.3, 0.5)).measured
        assert found.row.tolist() == [0, 1]
        assert np.hypot(*(found.centre_m - [(box.x_m, box.y_m) for box in boxes]).T).max() < 0.3


@pytest.mark.parametrize("hidden", [False, True])
def test_beams_that_pass_between_two_vehicles_part_their_cluster(hidden: bool) -> None:
    """One return of a car 0.7 m beside a truck's front; a car before the gap that is as high would hide it."""
    boxes = [CarBox(-60.4, 0.5), truck(-65.0, 3.4)]
    points, hit = cast_rays(boxes, noise_m=NOISE_M)
    corner = np.flatnonzero(hit == 0)[points[hit == 0][:, 1].argmax()]
    kept = points[(hit == 1) | (np.arange(hit.size) == corner)]
    nearer = [[x, -0.031 * x, 3.5] for x in np.arange(-30.0, -29.0, 0.1)] if hidden else np.empty((0, 3))
    found = measure_by_lidar(np.vstack([kept, nearer]), predict([]))
    together = np.isin(found.clusters["returns"], len(kept))
    assert together.any() == hidden


def test_truck_hidden_in_the_middle_is_one_vehicle() -> None:
    """A van between hides the middle of a truck beside: cab and trailer are two clusters and one measurement."""
    boxes = [truck(10.0, 7.2), CarBox(5.0, 3.6, 0.0, 2.0, 1.0, 4.5)]
    points, hit = cast_rays(boxes, noise_m=NOISE_M)
    seen = np.sort(points[hit == 0][:, 0])
    assert np.diff(seen).max() > 1.2
    found = measure_by_lidar(points, predict(boxes, 0.2, 0.5)).measured
    assert found.row.tolist() == [0, 1]
    assert np.hypot(*(found.centre_m[0] - (10.0, 7.2))) < 0.5


def test_hidden_half_of_a_rear_does_not_shift_the_centre() -> None:
    """A nearer truck covers the left half of a car: its right edge and its width tell where it is."""
    boxes = [CarBox(40.0, 0.5), truck(15.0, -1.15)]
    points, hit = cast_rays(boxes, noise_m=NOISE_M)
    assert np.ptp(points[hit == 0][:, 1]) < 1.5
    found = measure_by_lidar(points, predict(boxes, 0.3, 0.5)).measured
    assert abs(found.centre_m[0, 1] - 0.5) < 0.15


@pytest.mark.parametrize("accelerates", [True, False])
@pytest.mark.parametrize("changes", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_no_vehicle_is_swapped_in_the_four_scenarios(accelerates: bool, changes: bool, seed: int) -> None:
    """Five vehicles side by side and behind one another over 4 s, each expected where it was 0.1 s before.

    Scenarios of Choi et al. (2021): the vehicle ahead accelerates or brakes, and keeps its lane or changes it.
    """
    random = np.random.default_rng(seed)
    others = [CarBox(22.0, 3.6), CarBox(24.0, -3.6), CarBox(8.0, 3.6), truck(38.0, 0.3)]
    place = np.array([(box.x_m, box.y_m) for box in [CarBox(18.0, 0.0), *others]])
    speed = np.array([0.0, 1.0, -1.0, 0.5, 2.0])
    expected = place.copy()
    for tick in range(40):
        share = min(tick / 30, 1.0) if changes else 0.0
        way = np.array([0, 0, 0, 0, 0], np.float64)
        way[0] = (0.8 if accelerates else -0.5) * (tick * 0.1) ** 2 / 2
        now = place + np.column_stack([speed * 0.1 * tick + way, np.zeros(5)])
        now[0, 1] = 3.6 * (1 - math.cos(math.pi * share)) / 2
        now[3, 0] -= 6.0 * share
        now[1, 0] += 12.0 * share
        boxes = [replace(box, x_m=x, y_m=y) for box, (x, y) in zip([CarBox(0, 0), *others], now, strict=True)]
        points, hit = cast_rays(boxes, noise_m=NOISE_M, seed=100 * seed + tick)
        guess = predict(boxes, expected - now + random.normal(0, 0.1, (5, 2)), 0.5)
        found = measure_by_lidar(points, guess).measured
        returns = np.bincount(hit, minlength=5)
        assert set(np.flatnonzero(returns >= 6)) <= set(found.row.tolist())
        known = found.row >= 0
        away = found.centre_m[known] - now[found.row[known]]
        every = found.centre_m[known][:, None] - now
        assert (np.hypot(every[..., 0], every[..., 1]).argmin(1) == found.row[known]).all(), tick
        assert (np.abs(away) < 3.5 * np.sqrt(np.diagonal(found.covariance_m2[known], axis1=1, axis2=2))).all(), tick
        expected = now.copy()
        expected[found.row[known]] = found.centre_m[known]


def compare(first: LidarMeasurement, second: LidarMeasurement, mirror: float = 1.0) -> None:
    """Check that two measurements are equal, or mirrored."""
    assert first.measured.row.tolist() == second.measured.row.tolist()
    sign = np.array([1.0, mirror])
    assert np.allclose(first.measured.centre_m, second.measured.centre_m * sign, atol=1e-6)
    turned = second.measured.covariance_m2 * np.outer(sign, sign)
    assert np.allclose(first.measured.covariance_m2, turned, atol=1e-6)


SCENE = [CarBox(20.0, 3.4, 2.0), CarBox(26.0, -3.8), truck(45.0, 3.5, -1.0), CarBox(-15.0, 0.2), CarBox(60.0, 0.4)]


@settings(max_examples=20, deadline=None)
@given(st.randoms(use_true_random=False))
def test_order_of_returns_and_of_vehicles_does_not_matter(random: object) -> None:
    """Shuffled returns give the same measurements, shuffled vehicles the same for each."""
    points, _ = cast_rays(SCENE, noise_m=NOISE_M)
    first = measure_by_lidar(points, predict(SCENE, 0.4))
    order = np.random.default_rng(random.getrandbits(32)).permutation(len(points))  # type: ignore[attr-defined]  # a Random
    compare(first, measure_by_lidar(points[order], predict(SCENE, 0.4)))
    turned = measure_by_lidar(points, predict(SCENE[::-1], 0.4)).measured
    found = dict(zip((len(SCENE) - 1 - turned.row).tolist(), turned.centre_m.tolist(), strict=True))
    for row, centre in zip(first.measured.row, first.measured.centre_m, strict=True):
        assert found[row] == pytest.approx(centre.tolist(), abs=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.booleans())
def test_mirrored_scene_gives_mirrored_measurements(seed: int, sends: bool) -> None:
    """Left and right are treated alike."""
    points, _ = cast_rays(SCENE, noise_m=NOISE_M, seed=seed, phase=0.37)
    mirrored = [replace(box, y_m=-box.y_m, heading_deg=-box.heading_deg) for box in SCENE]
    error = np.array([0.3, 0.4])
    first = measure_by_lidar(points, predict(SCENE, error, sends=sends))
    second = measure_by_lidar(points * (1, -1, 1), predict(mirrored, error * (1, -1), sends=sends))
    compare(first, second, mirror=-1.0)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        st.tuples(*[st.floats(-150, 150, width=32) | st.sampled_from([0.0, math.nan, math.inf])] * 3), max_size=12
    ),
    st.integers(0, 3),
)
def test_any_returns_give_finite_measurements(points: list[tuple[float, float, float]], repeat: int) -> None:
    """No returns, one, coincident ones, and values that are no numbers."""
    cloud = np.array(points, np.float64).reshape(-1, 3)
    cloud = np.vstack([cloud] + [cloud[:1]] * repeat)
    found = measure_by_lidar(cloud, predict(SCENE))
    assert np.isfinite(found.measured.centre_m).all()
    assert (np.linalg.eigvalsh(found.measured.covariance_m2) > 0).all()
    assert found.clusters["returns"].sum() <= len(cloud)
    rows = found.measured.row[found.measured.row >= 0]
    assert len(np.unique(rows)) == len(rows)
    assert np.isin(found.measured.cluster, found.clusters["cluster"]).all()


def test_scan_without_returns_and_without_vehicles_is_empty() -> None:
    """Nothing in, nothing out, with the columns of the tables."""
    found = measure_by_lidar(np.empty((0, 3)), predict([]))
    assert found.measured.row.size == found.clusters["cluster"].size == found.association["cluster"].size == 0
    assert set(found.association) == {"cluster", "side", "distance_m", "gate", "candidates"}


def test_clusters_describe_all_returns_that_were_used() -> None:
    """Counts, extents and nearest returns are those of the points themselves."""
    points, hit = cast_rays([CarBox(20.0, 3.6), CarBox(40.0, -3.6)])
    clusters = measure_by_lidar(points, predict([])).clusters
    near = points[hit == 0]
    assert clusters["returns"].tolist() == np.bincount(hit).tolist()
    nearest = near[np.hypot(near[:, 0], near[:, 1]).argmin()]
    assert clusters["nearest_x_m"][0] == pytest.approx(nearest[0])
    assert clusters["nearest_y_m"][0] == pytest.approx(nearest[1])
    assert clusters["least_x_m"][0] == pytest.approx(near[:, 0].min())
    assert clusters["most_y_m"][0] == pytest.approx(near[:, 1].max())
    assert clusters["height_m"][0] == pytest.approx(near[:, 2].max())
    assert near[:, 2].max() < SCANNER_Z_M
