"""Boxes, ellipses, errors and labels, held against numbers derived by hand."""

import math
from itertools import pairwise

import numpy as np
import pytest
from drawn_moment import FAR, NEAR, OWN, OWN_SAMPLE, open_moment, sure
from hypothesis import given
from hypothesis import strategies as st

from tracklake.training.plots.picture import forecast_scene, take_picture
from tracklake.training.plots.picture_rows import (
    choose_view,
    list_boxes,
    list_ellipses,
    list_errors,
    list_lanes,
    list_markings,
    list_paths,
    list_probabilities,
    separate_labels,
    trace_ellipses,
)


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    folder = open_moment(tmp_path_factory.mktemp("moment"))
    return take_picture(folder, OWN_SAMPLE, forecast_scene(folder, OWN_SAMPLE, [sure()]))


def test_edges_differ_from_the_lines_between_lanes(picture):
    assert [(row["y_m"], row["edge"]) for row in list_markings(picture)] == [(0, True), (4, False), (8, True)]
    assert [(row["lane"], row["y_m"]) for row in list_lanes(picture)] == [("lane 1", 2), ("lane 2", 6)]


def test_boxes_reach_from_the_front_back_and_half_their_width_to_both_sides(picture):
    boxes = {row["vehicle_id"]: row for row in list_boxes(picture, choose_view(picture))}
    assert (boxes[OWN]["front_m"], boxes[OWN]["role"], boxes[OWN]["known"]) == (20, "own", True)
    assert boxes[OWN]["back_m"] == pytest.approx(20 - 4.1)
    assert boxes[OWN]["left_m"] == pytest.approx(6 - 1.51 / 2)
    assert boxes[OWN]["right_m"] == pytest.approx(6 + 1.51 / 2)
    assert boxes[NEAR]["role"] == "neighbor"
    far = boxes[FAR]
    assert (far["known"], far["front_m"], far["back_m"]) == (False, 100, 95.5)
    assert (far["left_m"], far["right_m"]) == (pytest.approx(1.1), pytest.approx(2.9))


def test_histories_truths_and_predictions_are_the_pictures(picture):
    paths = {}
    for row in list_paths(picture, choose_view(picture)):
        paths.setdefault(row["kind"], []).append(row)
    assert list(paths) == ["history", "truth", "alternative", "prediction"]
    histories = [(row["vehicle_id"], row["role"], row["marked"]) for row in paths["history"]]
    assert histories == [(OWN, "own", True)] * 3 + [(NEAR, "neighbor", False)] * 2 + [(FAR, "other", False)] * 3
    truths = [(row["vehicle_id"], row["tick"], row["x_m"], row["y_m"], row["marked"]) for row in paths["truth"]]
    assert truths == [
        (OWN, 0, 20, 6, False),
        (OWN, 1, 30, 5.5, False),
        (OWN, 2, 40, 4.5, True),
        (OWN, 3, 53, 3, False),
        (OWN, 4, 60, 2, True),
        (FAR, 0, 100, 2, False),
        (FAR, 1, 120, 2, False),
    ]
    predictions = [(row["series"], row["vehicle_id"], row["x_m"], row["marked"]) for row in paths["prediction"]]
    assert predictions[:5] == [("sure", OWN, 20 + 11 * tick, tick in (2, 4)) for tick in range(5)]
    assert predictions[5:] == [("sure", FAR, 100 + 11 * tick, False) for tick in range(5)]
    others = [(row["series"], row["vehicle_id"], row["tick"], row["x_m"]) for row in paths["alternative"]]
    assert others == [("sure", OWN, tick, 20) for tick in range(5)]
    assert len({row["path"] for rows in paths.values() for row in rows}) == 3 + 2 + 1 + 2


def test_errors_are_predicted_less_true(picture):
    """Predicted (31, 6), (42, 6), (53, 6), (64, 6), true (30, 5.5), (40, 4.5), (53, 3), (60, 2); and 111, true 120."""
    rows = [(row["vehicle_id"], row["seconds"], row["along_m"], row["across_m"]) for row in list_errors(picture)]
    assert rows == [(OWN, 0.5, 1, 0.5), (OWN, 1.0, 2, 1.5), (OWN, 1.5, 0, 3), (OWN, 2.0, 4, 4), (FAR, 0.5, -9, 0)]
    assert [row["distance_m"] for row in list_errors(picture)][1:4] == pytest.approx([2.5, 3, 4 * math.sqrt(2)])
    assert {(row["along_sigma_m"], row["across_sigma_m"]) for row in list_errors(picture)} == {(2, 1)}


def test_ellipses_stand_at_whole_seconds(picture):
    """The own vehicle at 1 s and 2 s, 1 and 3 sigma; the other at 2 s, 3 sigma. Covariance [[4, 1.2], [1.2, 1]]."""
    outlines = {}
    for row in list_ellipses(picture):
        outlines.setdefault(row["ellipse"], []).append((row["x_m"], row["y_m"]))
    centres = {"1 1 s": (42, 6), "1 2 s": (64, 6), "5 2 s": (144, 2)}
    assert sorted(outlines) == sorted(
        f"sure {at} {sigmas} sigma" for at in centres for sigmas in (1, 3) if sigmas == 3 or at[0] == "1"
    )
    # Eigenvalues of [[a, b], [b, c]] are (a + c)/2 +- sqrt(((a - c)/2)^2 + b^2) = 2.5 +- sqrt(1.5^2 + 1.2^2).
    great, small = 2.5 + math.sqrt(3.69), 2.5 - math.sqrt(3.69)
    for name, outline in outlines.items():
        _, vehicle, second, _, sigmas, _ = name.split()
        x_m, y_m = centres[f"{vehicle} {second} s"]
        ways = [math.hypot(x - x_m, y - y_m) for x, y in outline]
        assert max(ways) == pytest.approx(int(sigmas) * math.sqrt(great), rel=3e-3)
        assert min(ways) == pytest.approx(int(sigmas) * math.sqrt(small), rel=3e-2)


@given(st.floats(0.01, 50), st.floats(0.01, 50), st.floats(-0.99, 0.99), st.sampled_from([1, 3]), st.floats(-1e3, 1e3))
def test_every_point_of_an_ellipse_is_as_many_deviations_away(sigma_x, sigma_y, rho, sigmas, x_m):
    outline = trace_ellipses(np.array([[x_m, 2.0]]), np.array([[sigma_x, sigma_y]]), np.array([rho]), sigmas)
    assert outline.shape == (1, 48, 2)
    for x, y in outline[0]:
        u, v = (x - x_m) / sigma_x, (y - 2.0) / sigma_y
        assert math.sqrt((u * u - 2 * rho * u * v + v * v) / (1 - rho * rho)) == pytest.approx(
            sigmas, rel=1e-6, abs=1e-6
        )


def test_the_view_shows_the_sample_whole(picture):
    """Its history begins at 0 m; its 3-sigma ellipses end 6 m beyond 64 m; vehicle 5 is predicted at 144 m."""
    view = choose_view(picture)
    assert view.first_x_m == -15, "30 m behind the sample, and a margin of 5"
    assert view.last_x_m == 149
    assert (view.first_y_m, view.last_y_m) == (-1.5, 9.5)


def test_probabilities_are_written_beyond_all_lines(picture):
    """They end at (20, 6) and (64, 6), 0 m apart across the road; the truth ends before."""
    rows = list_probabilities(picture, choose_view(picture), step_x_m=3, step_y_m=1)
    assert [(row["series"], row["label"], row["x_m"], row["end_x_m"]) for row in rows] == [
        ("sure", "75%", 67, 64),
        ("sure", "25%", 67, 20),
    ]
    assert [row["y_m"] for row in rows] == [5.5, 6.5]


@given(st.lists(st.floats(-50, 50), max_size=8), st.floats(0.1, 5))
def test_labels_keep_their_order_and_distance(wanted, least):
    wanted = sorted(wanted)
    places = separate_labels(np.array(wanted), least).tolist()
    assert len(places) == len(wanted)
    for one, next_one in pairwise(places):
        assert next_one - one >= least - 1e-9
    if all(b - a >= least for a, b in pairwise(wanted)):
        assert places == pytest.approx(wanted)
    assert sum(places) == pytest.approx(sum(wanted), abs=1e-6), "moved about their middle"
