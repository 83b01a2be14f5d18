import numpy as np
import pytest

from tracklake.pipeline.synthetic.onboard import gnss, radio
from tracklake.pipeline.synthetic.onboard.camera import Camera, compute_hidden, project_boxes, take_image
from tracklake.pipeline.synthetic.onboard.lidar import Boxes, Lidar, cast_rays

EXACT = Lidar(noise_m=0.0)


def make_boxes(*rows):
    """Boxes of (x, y, heading in degrees, length, width, height)."""
    table = np.array(rows, float).reshape(-1, 6)
    return Boxes(table[:, 0], table[:, 1], np.radians(table[:, 2]), table[:, 3:])


def cast(lidar, *rows):
    return cast_rays(lidar, make_boxes(*rows), np.random.default_rng(1))


def test_a_ray_ahead_meets_the_rear_of_the_car_ahead():
    """The rear is 10 m away: the beam at -3 degrees meets it 52 cm below the scanner, which is 1.9 m high."""
    scan = cast(EXACT, (12.0, 0.0, 0.0, 4.0, 2.0, 1.5))
    ahead = scan.points_m[np.abs(scan.points_m[:, 1]) < 1e-6]
    # The beam at -1 degree is at 1.73 m there, above the roof, and that at -11 has met the ground.
    assert ahead[:, 0] == pytest.approx(10.0)
    assert ahead[:, 2] == pytest.approx(-10 * np.tan(np.radians([9, 7, 5, 3])), abs=1e-5)
    assert scan.points_m[:, 0] == pytest.approx(10.0)
    assert scan.visible == pytest.approx([1.0])


def test_a_car_behind_a_truck_gives_no_returns_and_one_behind_a_car_is_seen_above_it():
    truck, car, hidden = (20.0, 0, 0, 12.0, 2.5, 3.5), (20.0, 0, 0, 4.0, 2.5, 1.5), (40.0, 0, 0, 4.0, 1.8, 1.5)
    assert cast(EXACT, truck, hidden).visible == pytest.approx([1, 0])
    assert cast(EXACT, car, (40.0, 0, 0, 12.0, 2.5, 3.5)).visible == pytest.approx([1, 1])
    assert cast(EXACT, (150.0, 0, 0, 4.0, 2.0, 1.5)).visible == pytest.approx([0])
    assert len(cast(EXACT).points_m) == 0


def cast_slowly(lidar, boxes):
    """Ranges by (beam, azimuth, box), one ray and one box after the other, by slabs in three dimensions."""
    found = {}
    azimuths = round(360 / lidar.step_deg)
    for beam, elevation_deg in enumerate(lidar.elevations_deg):
        for azimuth in range(azimuths):
            angle, elevation = np.radians(azimuth * lidar.step_deg), np.radians(elevation_deg)
            best = (np.inf, -1)
            for number in range(len(boxes.x_m)):
                yaw = boxes.yaw_rad[number]
                turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
                origin = [*(turn @ (-boxes.x_m[number] + lidar.x_m, -boxes.y_m[number] + lidar.y_m)), lidar.z_m]
                flat = np.cos(elevation)
                ray = [*(turn @ (flat * np.cos(angle), flat * np.sin(angle))), np.sin(elevation)]
                length, width, height = boxes.size_m[number]
                enter, leave = -np.inf, np.inf
                for axis, (low, high) in enumerate(((-length / 2, length / 2), (-width / 2, width / 2), (0, height))):
                    first, second = sorted(((low - origin[axis]) / ray[axis], (high - origin[axis]) / ray[axis]))
                    enter, leave = max(enter, first), min(leave, second)
                if lidar.least_m <= enter <= min(leave, lidar.range_m):
                    best = min(best, (enter, number))
            if best[1] >= 0:
                found[beam, azimuth] = best
    return found


@pytest.mark.parametrize("seed", range(4))
def test_returns_are_those_of_a_loop_over_rays_and_boxes(seed):
    random = np.random.default_rng(seed)
    boxes = make_boxes(
        *(
            (x, y, random.uniform(-180, 180), random.uniform(2, 15), random.uniform(1, 2.5), random.uniform(1, 4))
            for x, y in random.uniform(-45, 45, (7, 2)) + 12 * np.sign(random.uniform(-1, 1, (7, 2)))
        )
    )
    lidar = Lidar(noise_m=0.0, step_deg=3.0, x_m=0.3, y_m=-0.2)
    scan = cast_rays(lidar, boxes, random)
    expected = cast_slowly(lidar, boxes)
    range_m = np.linalg.norm(scan.points_m, axis=1)
    assert list(zip(range_m, scan.box.tolist(), strict=True)) == [
        (pytest.approx(range_m, abs=1e-4), box) for _, (range_m, box) in sorted(expected.items())
    ]


def test_range_noise_and_ground():
    noise_m = np.linalg.norm(cast(Lidar(), (0, 0, 0, 0.1, 0.1, 0.1)).points_m, axis=1)
    assert len(noise_m) == 0
    car = (12.0, 0.0, 0.0, 4.0, 20.0, 1.8)
    exact, noisy = cast(EXACT, car), cast(Lidar(), car)
    error_m = np.linalg.norm(noisy.points_m, axis=1) - np.linalg.norm(exact.points_m, axis=1)
    assert len(error_m) > 400
    assert (error_m.mean(), error_m.std()) == (pytest.approx(0, abs=0.006), pytest.approx(0.03, rel=0.12))
    ground = cast(Lidar(noise_m=0.0, ground=True))
    assert ground.points_m[:, 2] == pytest.approx(-1.9, abs=1e-5)
    assert len(ground.points_m) == 7 * 1800  # the beam at -1 degree would reach the ground at 109 m


def test_a_box_in_the_image_by_hand():
    """A car whose rear is 20 m before the camera, 2 m to the right: columns 640 + 1000 * (1..3) / 20."""
    edges_px, shown = project_boxes(Camera(x_m=0.0, z_m=1.4), make_boxes((22.0, 2.0, 0.0, 4.0, 2.0, 1.5)))
    assert shown.all()
    # The left edge is that of the front, 24 m away; the top that of the front, too, as the roof is above the camera.
    assert edges_px[0] == pytest.approx((640 + 1000 / 24, 360 - 100 / 20, 640 + 3000 / 20, 360 + 1400 / 20))
    behind = make_boxes((-20.0, 0, 0, 4, 2, 1.5), (2.0, 3.0, 0, 4, 2, 1.5), (300.0, 0, 0, 4, 2, 1.5))
    assert not project_boxes(Camera(), behind)[1].any()


def test_hidden_vehicles_are_missed():
    camera = Camera(missed=0.0, false_per_image=0.0)
    boxes = make_boxes((20.0, 0, 0, 12.0, 2.5, 3.5), (45.0, 0, 0, 4.0, 1.8, 1.5), (45.0, 8.0, 0, 4.0, 1.8, 1.5))
    edges_px, shown = project_boxes(camera, boxes)
    assert compute_hidden(edges_px, np.array([20.0, 45, 45]), shown) == pytest.approx([0, 1, 0])
    image = take_image(camera, boxes, np.random.default_rng(1))
    assert image.box.tolist() == [0, 2]
    random = np.random.default_rng(2)
    images = [take_image(Camera(), boxes, random) for _ in range(2000)]
    assert np.mean([(each.box == 0).sum() for each in images]) == pytest.approx(0.97, abs=0.02)
    assert np.mean([(each.box == -1).sum() for each in images]) == pytest.approx(0.05, abs=0.02)
    assert all((each.boxes_px[:, 2:] > 0).all() for each in images)


def test_position_errors_are_gauss_markov():
    """Deviation and correlation after 30 s of 400 receivers: exp(-1) of the own part, nearly all of the common."""
    receiver = gnss.Receiver(common_m=0.0, own_m=2.0, white_m=0.5, speed_mps=0.1)
    error_m = gnss.draw_positions(np.random.default_rng(3), receiver, 600, 400)
    assert error_m.std() == pytest.approx(receiver.accuracy_m, rel=0.05)
    both = np.mean(error_m[:300] * error_m[300:])
    assert both / error_m.var() == pytest.approx(np.exp(-1) * 4 / 4.25, abs=0.05)
    shared = gnss.draw_positions(np.random.default_rng(4), gnss.Receiver(1.0, 0.0, 0.0, 0.1), 50, 3)
    assert shared[:, 0] == pytest.approx(shared[:, 2])
    assert gnss.RECEIVERS["dgps"].accuracy_m < 0.4 < 1.5 < gnss.RECEIVERS["plain"].accuracy_m


def test_headings_are_off_by_the_error_to_either_side():
    error_deg = gnss.draw_headings(np.random.default_rng(5), 1.0, 400, 200)
    bias_deg = error_deg.mean(axis=0)
    assert np.abs(bias_deg) == pytest.approx(1.0, abs=0.05)
    assert 60 < (bias_deg > 0).sum() < 140
    assert (error_deg - bias_deg).std() == pytest.approx(0.2, rel=0.05)


def test_loss_grows_with_distance():
    channel = radio.Radio(bursts_per_min=0.0, loss=0.1)
    sent = radio.draw_transmissions(np.random.default_rng(6), channel, 200, 200, ego=0)
    for distance_m, share in ((0.0, 0.9), (150.0, 0.9 * 15 / 16), (270.0, 0.9 * (1 - 0.9**4)), (300.0, 0.0)):
        arrived = radio.select_received(sent, channel, np.full((200, 200), distance_m))
        assert arrived.mean() == pytest.approx(share, abs=0.01)
    assert not radio.select_received(sent, channel, np.full((200, 200), np.nan)).any()


def test_bursts_last_and_latency_is_positive():
    channel = radio.Radio(bursts_per_min=6.0, burst_s=0.5)
    sent = radio.draw_transmissions(np.random.default_rng(7), channel, 600, 300, ego=0)
    # Bursts begin in 1 of 100 messages and last for 5 on average: about 4.8 % of the time.
    assert sent.burst.mean() == pytest.approx(0.048, abs=0.006)
    late_ms = (sent.arrived_ms - sent.sent_ms)[:, 1:]
    assert late_ms.min() >= 15
    assert late_ms.mean() == pytest.approx(30, rel=0.02)
    assert (sent.arrived_ms == sent.sent_ms)[:, 0].all()


def test_ids_change_and_counters_run():
    channel = radio.Radio(id_change_s=10.0, clock_steps=1.0)
    sent = radio.draw_transmissions(np.random.default_rng(8), channel, 300, 20, ego=3)
    changes = (np.diff(sent.temporary_id, axis=0) != 0).sum(axis=0)
    assert set(changes.tolist()) <= {2, 3}
    same = np.diff(sent.temporary_id, axis=0) == 0
    assert set((np.diff(sent.counter, axis=0) % 128)[same].tolist()) == {1}
    step_ms = np.abs(np.diff(sent.stamped_ms - sent.sent_ms, axis=0)).max(axis=0)
    assert step_ms[3] == 0
    assert ((step_ms >= 100) & (step_ms <= 500))[np.arange(20) != 3].all()


def test_more_penetration_adds_senders():
    ids = np.arange(0, 2000, 2)
    few, many = (radio.draw_connected(np.random.default_rng(9), ids, share) for share in (0.3, 0.6))
    assert (many >= few).all()
    assert (few.mean(), many.mean()) == (pytest.approx(0.3, abs=0.05), pytest.approx(0.6, abs=0.05))
    some = radio.draw_connected(np.random.default_rng(9), ids[5:9], 0.3)
    assert (some == few[5:9]).all()  # who else is near changes nothing
    assert (few == (np.random.default_rng(9).random(2000)[ids] < 0.3)).all()
    greatest = radio.draw_connected(np.random.default_rng(9), np.array([0, 2**31 - 1]), 0.3)
    assert greatest[0] == few[0]  # in the memory of two draws
