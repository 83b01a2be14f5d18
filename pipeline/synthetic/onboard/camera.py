"""A forward pinhole camera and its detector: boxes in the image, with occlusion, missed and false ones."""

from dataclasses import dataclass

import numpy as np

from tracklake.pipeline.synthetic.onboard.lidar import Boxes
from tracklake.schemas.arrays import Flags, Floats, Integers


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks along the ego's axis, and the quality of its detector.

    Args:
        width_px: width of the image; with fx_px it gives a field of view of 65 degrees.
        height_px: height of the image.
        fx_px: focal length, horizontal.
        fy_px: focal length, vertical.
        cx_px: principal point, from the left.
        cy_px: principal point, from the top.
        x_m: ahead of the ego's centre, behind the windscreen.
        y_m: to the right of the ego's centre.
        z_m: above the ground.
        noise_px: standard deviation of each edge of a box.
        missed: share of boxes in free sight that the detector misses.
        false_per_image: boxes without a vehicle, on average.
        most_hidden: hidden share of a box up to which it is detected.
        least_px: height below which a vehicle is not detected.
    """

    width_px: int = 1280
    height_px: int = 720
    fx_px: float = 1000.0
    fy_px: float = 1000.0
    cx_px: float = 640.0
    cy_px: float = 360.0
    x_m: float = 0.5
    y_m: float = 0.0
    z_m: float = 1.4
    noise_px: float = 1.5
    missed: float = 0.03
    false_per_image: float = 0.05
    most_hidden: float = 0.6
    least_px: float = 12.0


LEAST_AHEAD_M = 1.0
"""Distance from the image plane's camera within which no corner of a detected vehicle lies, in m."""
SAMPLES = (np.arange(8) + 0.5) / 8
"""Places in a box, as shares of its sides, at which its occlusion is judged."""


@dataclass(frozen=True)
class Image:
    """The detector's boxes in one image."""

    boxes_px: Floats
    """(D, 4) left, top, width, height."""
    score: Floats
    """(D,)."""
    box: Integers
    """(D,) vehicle of each, or -1 for a false one."""


def project_boxes(camera: Camera, boxes: Boxes) -> tuple[Floats, Flags]:
    """Return the edges left, top, right, bottom in px of each vehicle, (B, 4), cut at the image, and who is in it."""
    ends = np.array([(a, b) for a in (-0.5, 0.5) for b in (-0.5, 0.5)])
    along, across = ends[:, 0] * boxes.size_m[:, [0]], ends[:, 1] * boxes.size_m[:, [1]]  # (B, 4)
    cosine, sine = np.cos(boxes.yaw_rad)[:, None], np.sin(boxes.yaw_rad)[:, None]
    ahead_m = boxes.x_m[:, None] + along * cosine - across * sine - camera.x_m
    aside_m = boxes.y_m[:, None] + along * sine + across * cosine - camera.y_m
    before = (ahead_m >= LEAST_AHEAD_M).all(axis=1)
    depth_m = np.maximum(ahead_m, LEAST_AHEAD_M)
    column = camera.cx_px + camera.fx_px * aside_m / depth_m
    foot = camera.cy_px + camera.fy_px * camera.z_m / depth_m
    head = camera.cy_px + camera.fy_px * (camera.z_m - boxes.size_m[:, [2]]) / depth_m
    edges = np.stack((column.min(axis=1), head.min(axis=1), column.max(axis=1), foot.max(axis=1)), axis=1)
    cut = np.clip(edges, 0, (camera.width_px, camera.height_px) * 2)
    shown = before & (cut[:, 2] - cut[:, 0] >= camera.least_px / 2) & (cut[:, 3] - cut[:, 1] >= camera.least_px)
    return cut, shown


def compute_hidden(edges_px: Floats, distance_m: Floats, shown: Flags) -> Floats:
    """Return the share of each vehicle's box in the image that boxes of nearer vehicles cover, (B,)."""
    left, top, right, bottom = edges_px.T
    column = left[:, None] + SAMPLES * (right - left)[:, None]
    row = top[:, None] + SAMPLES * (bottom - top)[:, None]
    across = (column[:, None, :] >= left[None, :, None]) & (column[:, None, :] <= right[None, :, None])
    down = (row[:, None, :] >= top[None, :, None]) & (row[:, None, :] <= bottom[None, :, None])
    nearer = (distance_m[None, :] < distance_m[:, None]) & shown[None, :]
    covered = (across & nearer[:, :, None])[:, :, :, None] & down[:, :, None, :]  # (B, B, columns, rows)
    hidden: Floats = covered.any(axis=1).mean(axis=(1, 2))
    return hidden


def take_image(camera: Camera, boxes: Boxes, random: np.random.Generator) -> Image:
    """Detect the vehicles ahead in one image."""
    edges_px, shown = project_boxes(camera, boxes)
    hidden = compute_hidden(edges_px, np.hypot(boxes.x_m, boxes.y_m), shown)
    noisy = edges_px + camera.noise_px * random.standard_normal(edges_px.shape)
    found = shown & (hidden <= camera.most_hidden) & (random.random(len(hidden)) >= camera.missed)
    found &= (noisy[:, 2] > noisy[:, 0]) & (noisy[:, 3] > noisy[:, 1])
    true_px = np.concatenate((noisy[:, :2], noisy[:, 2:] - noisy[:, :2]), axis=1)[found]
    false = int(random.poisson(camera.false_per_image))
    size_px = random.uniform(20, 120, (false, 2))
    corner_px = random.uniform(0, 1, (false, 2)) * (camera.width_px, camera.height_px / 2) + (0, camera.cy_px / 2)
    true_score = np.clip(0.95 - 0.5 * hidden[found] + 0.05 * random.standard_normal(len(true_px)), 0.3, 1)
    return Image(
        np.concatenate((true_px, np.concatenate((corner_px, size_px), axis=1))),
        np.concatenate((true_score, random.uniform(0.3, 0.6, false))),
        np.concatenate((np.flatnonzero(found), np.full(false, -1))),
    )
