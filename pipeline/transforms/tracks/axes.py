"""Road axes: a smooth line along a road, on which positions are a distance along it and one to its right."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Floats

STEP_M = 0.5
"""Distance of two points of an axis, in m; between them it is a straight line, 0.3 mm off at a radius of 100 m."""
COARSE = 10
"""Every so many points of an axis one is compared with a position; ways 5 m apart are kept apart."""
ROWS_AT_ONCE = 50_000
"""Positions that are compared at once with the coarse points."""
STEPS = 4
"""Newton steps of a search; each about squares the error, which is 2.5 m at first."""
LEAST_SPEED_MPS = 0.5
"""Speed below which the way between two entries is noise, in m/s."""
SMOOTHED_M = 6.0
"""Length of a track over which positions are averaged where an axis begins as this track, in m."""
BIN_M = 5.0
"""Length of the pieces of an axis in which the directions of points are compared with its own, in m."""
NEAR_M = 30.0
"""Greatest distance from an axis of points that it is fitted to, in m."""
MAX_TURN_RAD = np.pi / 4
"""Greatest angle between an axis and the directions that it is fitted to, in rad."""
MAX_GROWTH_M = 100.0
"""Greatest length that an axis grows by at either end when it is fitted to points, each time, in m."""
ROUNDS = 3
"""Times that an axis is fitted to points; each begins where the last one ended."""


@dataclass(frozen=True)
class Places:
    """Positions on an axis, (N,) each.

    Args:
        along_m: distance along the axis from its first point, negative before it.
        right_m: distance to the right of the axis.
        angle_rad: direction of the axis there, counterclockwise from the plane's x axis.
        stretch: length of a way at this distance from the axis, per length on the axis: above 1 outside of a bend.
    """

    along_m: Floats
    right_m: Floats
    angle_rad: Floats
    stretch: Floats


@dataclass(frozen=True)
class Axis:
    """A line of points STEP_M apart in a plane whose y points left of x; beyond its ends it goes on straight.

    Args:
        x_m: (N,) positions.
        y_m: (N,) positions.
        angle_rad: (N,) directions, counterclockwise from the x axis, without jumps of a whole turn.
    """

    x_m: Floats
    y_m: Floats
    angle_rad: Floats

    @property
    def length_m(self) -> float:
        """Length of the axis."""
        return STEP_M * (len(self.x_m) - 1)

    def project(self, x_m: Floats, y_m: Floats) -> Places:
        """Find where the axis is square to each position (N,), the nearest such place."""
        along = self._find_nearest(x_m, y_m)
        for _ in range(STEPS):
            ahead, right, angle, stretch = self._measure(along, x_m, y_m)
            along = along + ahead / np.maximum(stretch, 0.2)
        _, right, angle, stretch = self._measure(along, x_m, y_m)
        return Places(along, right, angle, stretch)

    def locate(self, along_m: Floats, right_m: Floats) -> tuple[Floats, Floats]:
        """Return the positions (N,) in the plane of places on the axis."""
        zero = np.zeros_like(along_m)
        ahead, right, angle, _ = self._measure(along_m, zero, zero)
        ahead, right = -ahead, right_m - right
        return ahead * np.cos(angle) + right * np.sin(angle), ahead * np.sin(angle) - right * np.cos(angle)

    def _measure(self, along: Floats, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Measure positions from places on the axis: ahead, to the right; also its direction and stretch there."""
        step = along / STEP_M
        row = np.clip(np.floor(step).astype(np.int64), 0, len(self.x_m) - 2)
        share = step - row
        inside = np.clip(share, 0.0, 1.0)
        turn = self.angle_rad[row + 1] - self.angle_rad[row]
        angle = self.angle_rad[row] + inside * turn
        cosine, sine = np.cos(angle), np.sin(angle)
        beyond = (share - inside) * STEP_M
        on_x = self.x_m[row] + inside * (self.x_m[row + 1] - self.x_m[row]) + beyond * cosine
        on_y = self.y_m[row] + inside * (self.y_m[row + 1] - self.y_m[row]) + beyond * sine
        off_x, off_y = x_m - on_x, y_m - on_y
        right = off_x * sine - off_y * cosine
        bend = np.where(share == inside, turn / STEP_M, 0.0)
        return off_x * cosine + off_y * sine, right, angle, 1 + bend * right

    def _find_nearest(self, x_m: Floats, y_m: Floats) -> Floats:
        """Find the nearest of the coarse points for each position, as a distance along the axis."""
        coarse = np.arange(0, len(self.x_m), COARSE)
        nearest = np.empty(len(x_m))
        for begin in range(0, len(x_m), ROWS_AT_ONCE):
            part = slice(begin, begin + ROWS_AT_ONCE)
            apart = (x_m[part, None] - self.x_m[coarse]) ** 2 + (y_m[part, None] - self.y_m[coarse]) ** 2
            nearest[part] = coarse[apart.argmin(axis=1)] * STEP_M
        return nearest


def draw_axis(x_m: Floats, y_m: Floats) -> Axis | None:
    """Draw an axis through positions (N,) in the order of travel; None where they span less than two steps."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))]) if len(x_m) else np.zeros(1)
    if way[-1] < 2 * STEP_M:
        return None
    first = np.concatenate([[True], np.diff(way) > 0])
    at = np.arange(0.0, way[-1], STEP_M)
    x, y = np.interp(at, way[first], x_m[first]), np.interp(at, way[first], y_m[first])
    # The direction at a point is that of the chord around it, which a circle has there, too.
    angle = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    return _integrate(angle, x, y)


def trace_track(x_m: Floats, y_m: Floats, speed_mps: Floats) -> Axis | None:
    """Draw an axis along one track (N,), smoothed over SMOOTHED_M; entries of a standing vehicle do not count."""
    moves = speed_mps >= LEAST_SPEED_MPS
    rough = draw_axis(x_m[moves], y_m[moves])
    if rough is None:
        return None
    window = min(round(SMOOTHED_M / STEP_M), len(rough.x_m) // 3)
    if window < 2:
        return rough
    return draw_axis(*(_smooth(values, window // 2) for values in (rough.x_m, rough.y_m)))


def _smooth(values: Floats, reach: int) -> Floats:
    """Average (N,) values over so many before and after each; beyond the ends they go on as they came."""
    before, after = 2 * values[0] - values[reach:0:-1], 2 * values[-1] - values[-2 : -reach - 2 : -1]
    return np.convolve(np.concatenate([before, values, after]), np.ones(2 * reach + 1) / (2 * reach + 1), "valid")


def fit_axis(axis: Axis, x_m: Floats, y_m: Floats, angle_rad: Floats) -> Axis:
    """Turn an axis, piece by piece, into the median direction of the points near it, to whose ends it grows.

    Args:
        axis: line to begin with, such as that of one track.
        x_m: (N,) positions of points, such as entries or the middle of lanes.
        y_m: (N,) positions of points.
        angle_rad: (N,) directions at these points, counterclockwise from the x axis.
    """
    for _ in range(ROUNDS):
        places = axis.project(x_m, y_m)
        turn = wrap_angle(angle_rad - places.angle_rad)
        near = (np.abs(turn) < MAX_TURN_RAD) & (np.abs(places.right_m) < NEAR_M)
        near &= (places.along_m > -MAX_GROWTH_M) & (places.along_m < axis.length_m + MAX_GROWTH_M)
        turns = (
            pl.DataFrame({"piece": np.floor(places.along_m[near] / BIN_M), "turn": turn[near]})
            .group_by("piece")
            .agg(pl.col("turn").median())
            .sort("piece")
        )
        if turns.is_empty():
            return axis
        axis, before_m = _extend(axis, places.along_m[near])
        at = np.arange(len(axis.x_m)) * STEP_M - before_m
        correction = np.interp(at, (turns["piece"].to_numpy() + 0.5) * BIN_M, turns["turn"].to_numpy())
        axis = _integrate(axis.angle_rad + correction, axis.x_m, axis.y_m)
    return axis


def _extend(axis: Axis, along_m: Floats) -> tuple[Axis, float]:
    """Extend an axis straight to the first and the last of places (N,) along it; also return by how much before it."""
    before, after = (max(0, int(np.ceil(way / STEP_M))) for way in (-along_m.min(), along_m.max() - axis.length_m))
    at = STEP_M * np.concatenate([np.arange(-before, 0), np.arange(1, after + 1) + len(axis.x_m) - 1])
    x, y = axis.locate(at, np.zeros(len(at)))
    longer = Axis(
        np.concatenate([x[:before], axis.x_m, x[before:]]),
        np.concatenate([y[:before], axis.y_m, y[before:]]),
        np.pad(axis.angle_rad, (before, after), "edge"),
    )
    return longer, STEP_M * before


def _integrate(angle_rad: Floats, x_m: Floats, y_m: Floats) -> Axis:
    """Build the axis of given directions that agrees with a line in its middle point."""
    between = (angle_rad[1:] + angle_rad[:-1]) / 2
    x = np.concatenate([[0.0], np.cumsum(STEP_M * np.cos(between))])
    y = np.concatenate([[0.0], np.cumsum(STEP_M * np.sin(between))])
    middle = len(x) // 2
    return Axis(x + x_m[middle] - x[middle], y + y_m[middle] - y[middle], angle_rad)


def wrap_angle(angle_rad: Floats) -> Floats:
    """Wrap angles into -pi to pi."""
    wrapped: Floats = np.mod(angle_rad + np.pi, 2 * np.pi) - np.pi
    return wrapped
