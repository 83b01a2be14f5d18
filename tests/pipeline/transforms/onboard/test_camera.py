"""Camera boxes matched to vehicles: pictures made corner by corner, with every bearing known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ray_caster import CarBox, truck

from tracklake.pipeline.transforms.onboard.camera import match_boxes
from tracklake.pipeline.transforms.onboard.measurements import Camera, Predicted
from tracklake.schemas.arrays import Floats

CAMERA = Camera(1000.0, 1000.0, 640.0, 360.0, 0.5, 0.0, 1.4)


def take_picture(box: CarBox) -> list[float]:
    """Project the eight corners of a box one by one: left, top, width, height."""
    columns, lines = [], []
    turn = math.radians(box.heading_deg)
    for end in (-0.5, 0.5):
        for side in (-0.5, 0.5):
            along, across = end * box.length_m, side * box.width_m
            ahead = box.x_m + along * math.cos(turn) - across * math.sin(turn) - CAMERA.x_m
            aside = box.y_m + along * math.sin(turn) + across * math.cos(turn)
            for height in (0.0, box.height_m):
                columns.append(640 + 1000 * aside / ahead)
                lines.append(360 + 1000 * (1.4 - height) / ahead)
    left, top = max(min(columns), 0.0), max(min(lines), 0.0)
    return [left, top, min(max(columns), 1280.0) - left, min(max(lines), 720.0) - top]


def predict(boxes: list[CarBox], error_m: Floats | float = 0.0, sd_m: float = 0.5) -> Predicted:
    """Predict boxes of known size."""
    count = len(boxes)
    return Predicted(
        np.arange(count),
        np.array([(box.x_m, box.y_m) for box in boxes]).reshape(-1, 2) + error_m,
        np.tile(np.eye(2) * sd_m**2, (count, 1, 1)),
        np.radians([box.heading_deg for box in boxes]),
        np.array([(box.length_m, box.width_m) for box in boxes]).reshape(-1, 2),
    )


ROAD = [CarBox(20.0, 0.0), CarBox(30.0, 3.6), CarBox(45.0, -3.6), truck(60.0, 3.4), CarBox(-20.0, 0.0)]


def test_boxes_find_their_vehicles_and_give_their_bearing() -> None:
    """Shuffled boxes of four vehicles ahead, predicted 0.3 m off; that behind has none."""
    boxes = np.array([take_picture(box) for box in ROAD[:4]])[[2, 0, 3, 1]]
    found = match_boxes(boxes, CAMERA, predict(ROAD, 0.3))
    assert found.row.tolist() == [2, 0, 3, 1]
    for row, bearing, variance, distance, spread in zip(
        found.row,
        found.bearing_rad,
        found.bearing_variance_rad2,
        found.range_m,
        found.range_variance_m2,
        strict=True,
    ):
        true = ROAD[row]
        assert bearing == pytest.approx(math.atan2(true.y_m, true.x_m - 0.5), abs=0.003)
        assert abs(bearing - math.atan2(true.y_m, true.x_m - 0.5)) < 3 * math.sqrt(variance)
        assert distance == pytest.approx(math.hypot(true.x_m - 0.5, true.y_m), abs=3 * math.sqrt(spread))


def test_false_boxes_and_missed_vehicles_stay_alone() -> None:
    """A box in the sky, one of another size, and a vehicle without a box."""
    sky = [600.0, 20.0, 90.0, 60.0]
    wrong_size = [400.0, 300.0, 20.0, 15.0]
    found = match_boxes(np.array([sky, take_picture(ROAD[0]), wrong_size]), CAMERA, predict(ROAD))
    assert found.row.tolist() == [-1, 0, -1]
    assert np.isnan(found.bearing_rad).tolist() == [True, False, True]


def test_box_between_two_vehicles_is_not_used() -> None:
    """Two cars one behind the other, loosely predicted, and one box: it may be either's."""
    cars = [CarBox(30.0, 0.2), CarBox(33.0, -0.2)]
    found = match_boxes(np.array([take_picture(cars[0])]), CAMERA, predict(cars, sd_m=3.0))
    assert found.row.tolist() == [-1]


def test_box_cut_by_the_border_gives_a_weak_bearing_and_no_range() -> None:
    """The left half of a passing car is in the image."""
    car = CarBox(8.0, 4.6)
    found = match_boxes(np.array([take_picture(car)]), CAMERA, predict([car], 0.1))
    assert found.row.tolist() == [0]
    assert found.bearing_variance_rad2[0] > 0.01
    assert np.isnan(found.range_m[0])


@settings(max_examples=30, deadline=None)
@given(st.permutations(range(4)), st.booleans())
def test_order_and_mirror_do_not_matter(order: list[int], mirror: bool) -> None:
    """Boxes in any order give the same pairs; a mirrored picture gives the mirrored bearings."""
    boxes = np.array([take_picture(box) for box in ROAD[:4]])
    guess, sign = predict(ROAD, 0.2), 1.0
    first = match_boxes(boxes, CAMERA, guess)
    if mirror:
        sign, flip = -1.0, np.array([1.0, -1.0])
        boxes[:, 0] = 1280 - boxes[:, 0] - boxes[:, 2]
        guess = Predicted(
            guess.vehicle_id, guess.centre_m * flip, guess.covariance_m2, -guess.heading_rad, guess.size_m
        )
    second = match_boxes(boxes[order], CAMERA, guess)
    assert second.row.tolist() == first.row[order].tolist()
    assert second.bearing_rad == pytest.approx(sign * first.bearing_rad[order])
    assert second.range_m == pytest.approx(first.range_m[order])


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        st.tuples(st.floats(-100, 1400), st.floats(-100, 800), st.floats(0.5, 900), st.floats(0.5, 900)), max_size=6
    ),
    st.integers(0, 5),
)
def test_any_boxes_are_matched_at_most_once(boxes: list[tuple[float, ...]], vehicles: int) -> None:
    """No box, no vehicle, false boxes, the same box twice."""
    found = match_boxes(np.array(boxes + boxes[:1]).reshape(-1, 4), CAMERA, predict(ROAD[:vehicles]))
    rows = found.row[found.row >= 0]
    assert len(set(rows.tolist())) == len(rows)
    assert (np.isfinite(found.bearing_rad) == (found.row >= 0)).all()
    assert (found.bearing_variance_rad2[found.row >= 0] > 0).all()
