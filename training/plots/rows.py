"""A picture as rows for a chart: boxes, lines, ellipses, errors. Positions in m on the carriageway."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from tracklake.training.plots.forecasts import Alternative, Forecast
from tracklake.training.plots.picture import Picture, Vehicle

Row = dict[str, Any]
Doubles = npt.NDArray[np.float64]

UNKNOWN_SIZE_M = (4.5, 1.8)
"""Length and width that are drawn, as an outline, where a vehicle's are not known."""
LEAST_PROBABILITY = 0.05
MOST_ALTERNATIVES = 3
"""Of a forecast's other alternatives, those at least so probable are drawn, and so many at most."""
SIGMAS = (1, 3)
OUTLINE_POINTS = 48

VIEW_BACK_M, VIEW_AHEAD_M = 30.0, 40.0
"""The road is drawn from so far behind the sample to so far ahead of it, at least: what its grid reaches."""
MOST_BACK_M, MOST_AHEAD_M = 130.0, 260.0
"""No further than this, except for what is drawn of the sample itself: cars would be specks."""
MARGIN_M = 5.0
VERGE_M = 1.5
"""Drawn beside the carriageway."""


@dataclass(frozen=True)
class View:
    """The stretch of road that is drawn, in m on the carriageway."""

    first_x_m: float
    last_x_m: float
    first_y_m: float
    last_y_m: float


def choose_view(picture: Picture) -> View:
    """A stretch that shows the sample's history, truth and forecasts whole, and of the others what is near."""
    own = picture.own
    x_m, y_m = own.history_m[-1]
    said = [forecast.position_m for forecast in own.forecasts]
    whole = np.concatenate([own.history_m, own.future_m, *said])
    spread = [_reach(forecast) for forecast in own.forecasts if forecast.alternatives]
    others = [forecast.position_m for vehicle in picture.vehicles[1:] for forecast in vehicle.forecasts]
    near = np.concatenate([whole, *spread, *others])
    along = np.clip(near[:, 0], x_m - MOST_BACK_M, x_m + MOST_AHEAD_M)
    across = np.clip(whole[:, 1], y_m - 20, y_m + 20)
    return View(
        first_x_m=float(min(along.min(), whole[:, 0].min(), x_m - VIEW_BACK_M)) - MARGIN_M,
        last_x_m=float(max(along.max(), whole[:, 0].max(), x_m + VIEW_AHEAD_M)) + MARGIN_M,
        first_y_m=float(min(picture.markings_m[0], across.min())) - VERGE_M,
        last_y_m=float(max(picture.markings_m[-1], across.max())) + VERGE_M,
    )


def _reach(forecast: Forecast) -> Doubles:
    """(2 F, 2) where the 3-sigma ellipses of the most probable alternative end along the road."""
    best = forecast.alternatives[0]
    away = best.sigma_m * [SIGMAS[-1], 0]
    return np.concatenate([best.mean_m - away, best.mean_m + away])


def list_markings(picture: Picture) -> list[Row]:
    """One row per lane border: y_m, and whether it is the carriageway's edge."""
    last = len(picture.markings_m) - 1
    return [{"y_m": y_m, "edge": number in (0, last)} for number, y_m in enumerate(picture.markings_m)]


def list_lanes(picture: Picture) -> list[Row]:
    """One row per lane: its name, and the y of its middle."""
    borders = pairwise(picture.markings_m)
    return [{"lane": f"lane {number}", "y_m": (left + right) / 2} for number, (left, right) in enumerate(borders, 1)]


def list_boxes(picture: Picture, view: View) -> list[Row]:
    """One row per vehicle that is seen: its box from front to back, its role, and whether its size is known."""
    return [
        box
        for box in map(_make_box, picture.vehicles)
        if box["front_m"] > view.first_x_m and box["back_m"] < view.last_x_m
    ]


def _make_box(vehicle: Vehicle) -> Row:
    known = not (np.isnan(vehicle.length_m) or np.isnan(vehicle.width_m))
    length_m, width_m = (vehicle.length_m, vehicle.width_m) if known else UNKNOWN_SIZE_M
    front_m, middle_m = (float(value) for value in vehicle.history_m[-1])
    return {
        "vehicle_id": vehicle.vehicle_id,
        "role": vehicle.role,
        "known": known,
        "front_m": front_m,
        "back_m": front_m - length_m,
        "left_m": middle_m - width_m / 2,
        "right_m": middle_m + width_m / 2,
    }


def list_histories(picture: Picture, view: View) -> list[Row]:
    """One row per vehicle that is seen and tick of its history."""
    seen = {box["vehicle_id"] for box in list_boxes(picture, view)}
    return [
        {"vehicle_id": vehicle.vehicle_id, "role": vehicle.role, **point}
        for vehicle in picture.vehicles
        if vehicle.vehicle_id in seen
        for point in _points(vehicle.history_m)
    ]


def list_truths(picture: Picture) -> list[Row]:
    """What came: one row per tick, from the sample's own position on, of every vehicle with a forecast."""
    return [
        {
            "vehicle_id": vehicle.vehicle_id,
            "own": vehicle.role == "own",
            "second": _is_second(point["tick"], picture.rate_hz),
            **point,
        }
        for vehicle in picture.vehicles
        if vehicle.forecasts and len(vehicle.future_m)
        for point in _points(np.concatenate([vehicle.history_m[-1:], vehicle.future_m]))
    ]


def list_predictions(picture: Picture) -> list[Row]:
    """What models say: one row per tick, from the vehicle's own position on."""
    return [
        {
            "vehicle_id": vehicle.vehicle_id,
            "own": vehicle.role == "own",
            "model": said.model,
            "second": _is_second(point["tick"], picture.rate_hz),
            **point,
        }
        for vehicle in picture.vehicles
        for said in vehicle.forecasts
        for point in _points(np.concatenate([vehicle.history_m[-1:], said.position_m]))
    ]


def list_alternatives(picture: Picture) -> list[Row]:
    """The own vehicle's other alternatives: one row per tick, from its own position on.

    `number` is 1 for the second most probable, and so on.
    """
    own = picture.own
    return [
        {"model": said.model, "number": number, "probability": one.probability, **point}
        for said in own.forecasts
        for number, one in enumerate(likely_alternatives(said), 1)
        for point in _points(np.concatenate([own.history_m[-1:], one.mean_m]))
    ]


def likely_alternatives(said: Forecast) -> tuple[Alternative, ...]:
    """Those beside the most probable one that are worth drawing."""
    likely = (one for one in said.alternatives[1:] if one.probability >= LEAST_PROBABILITY)
    return tuple(one for one, _ in zip(likely, range(MOST_ALTERNATIVES), strict=False))


def list_ellipses(picture: Picture) -> list[Row]:
    """Outlines of the most probable alternatives at whole seconds, OUTLINE_POINTS rows each.

    The own vehicle's at 1 and 3 sigma, the others' at 3. Ellipses that no view could hold (beyond MOST_AHEAD_M) are
    drawn like any other, and cut at its border.
    """
    return [
        row for vehicle in picture.vehicles for said in vehicle.forecasts for row in _outline(picture, vehicle, said)
    ]


def _outline(picture: Picture, vehicle: Vehicle, said: Forecast) -> Iterator[Row]:
    if not said.alternatives:
        return
    best, rate = said.alternatives[0], picture.rate_hz
    at = slice(rate - 1, None, rate)
    for sigmas in SIGMAS if vehicle.role == "own" else SIGMAS[-1:]:
        outlines = trace_ellipses(best.mean_m[at], best.sigma_m[at], best.correlation[at], sigmas)
        for second, outline in enumerate(outlines, 1):
            name = f"{said.model} {vehicle.vehicle_id} {second} s {sigmas} sigma"
            for order, (x_m, y_m) in enumerate(outline.tolist()):
                where = {"order": order, "x_m": x_m, "y_m": y_m}
                own = {"own": vehicle.role == "own", "model": said.model}
                yield {"ellipse": name, **own, "second": second, "sigmas": sigmas, **where}


def trace_ellipses(mean_m: Doubles, sigma_m: Doubles, correlation: Doubles, sigmas: float) -> Doubles:
    """Contours of bivariate normal densities at a Mahalanobis distance: (T, OUTLINE_POINTS, 2).

    A circle of that radius, stretched by the covariance's Cholesky factor
    [[sx, 0], [rho sy, sqrt(1 - rho^2) sy]].

    Args:
        mean_m: (T, 2)
        sigma_m: (T, 2)
        correlation: (T,)
        sigmas: the distance.
    """
    turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    cosine, sine = sigmas * np.cos(turn), sigmas * np.sin(turn)
    rest = np.sqrt(1 - correlation**2)
    along = sigma_m[:, :1] * cosine
    across = sigma_m[:, 1:] * (correlation[:, None] * cosine + rest[:, None] * sine)
    return mean_m[:, None, :] + np.stack([along, across], axis=-1)


def list_errors(picture: Picture) -> list[Row]:
    """Errors of every forecast at every tick that is known: predicted less true.

    Keys: vehicle_id, own, model, seconds, distance_m, along_m, across_m; and along_sigma_m and across_sigma_m of the
    most probable alternative, null where the model gives none.
    """
    return [row for vehicle in picture.vehicles for said in vehicle.forecasts for row in _err(picture, vehicle, said)]


def _err(picture: Picture, vehicle: Vehicle, said: Forecast) -> Iterator[Row]:
    known = len(vehicle.future_m)
    error = said.position_m[:known] - vehicle.future_m
    sigma = said.alternatives[0].sigma_m[:known].tolist() if said.alternatives else [(None, None)] * known
    for tick, ((along, across), (along_sigma, across_sigma)) in enumerate(zip(error.tolist(), sigma, strict=True), 1):
        yield {
            "vehicle_id": vehicle.vehicle_id,
            "own": vehicle.role == "own",
            "model": said.model,
            "seconds": tick / picture.rate_hz,
            "distance_m": float(np.hypot(along, across)),
            "along_m": along,
            "across_m": across,
            "along_sigma_m": along_sigma,
            "across_sigma_m": across_sigma,
        }


def _points(places: Doubles) -> Iterator[Row]:
    """Rows of tick (0, 1, ...), x_m, y_m."""
    for tick, (x_m, y_m) in enumerate(places.tolist()):
        yield {"tick": tick, "x_m": x_m, "y_m": y_m}


def _is_second(tick: int, rate_hz: int) -> bool:
    return tick > 0 and tick % rate_hz == 0
