"""Rows of the chart of a picture: vehicles, paths, ellipses, labels and errors; positions in m on the carriageway."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tracklake.schemas.arrays import Floats
from tracklake.schemas.drawings import Row
from tracklake.training.plots.picture import Alternative, Forecast, Picture, Vehicle

UNKNOWN_SIZE_M = (4.5, 1.8)
"""Length and width drawn, as an outline, where a vehicle's size is unknown."""
LEAST_PROBABILITY, MOST_ALTERNATIVES = 0.05, 3
"""Least probability and most number of alternatives that are drawn beside the most probable one."""
SIGMAS, ELLIPSE_POINTS = (3, 1), 48
"""Standard deviations at which ellipses are drawn, outer one first, and points of an outline."""
VIEW_BACK_M, VIEW_AHEAD_M = 30.0, 40.0
"""Least road drawn behind and ahead of the sample: the reach of its grid."""
MOST_BACK_M, MOST_AHEAD_M = 130.0, 260.0
"""Most road drawn behind and ahead of the sample, unless its own lines are longer; cars would be specks."""
MARGIN_M, VERGE_M = 5.0, 1.5
"""Margins of the view along and across the road."""


@dataclass(frozen=True)
class View:
    """The stretch of road that is drawn, in m on the carriageway."""

    first_x_m: float
    last_x_m: float
    first_y_m: float
    last_y_m: float


def choose_view(picture: Picture) -> View:
    """Choose a stretch that shows the sample's own lines whole, and of other vehicles what is near."""
    x_m, y_m = picture.own.history_m[-1]
    forecasts = picture.own.forecasts
    own = np.concatenate([picture.own.history_m, picture.own.future_m, *(one.position_m for one in forecasts)])
    best = [one.alternatives[0] for one in forecasts if one.alternatives]
    ellipses = [one.mean_m + one.sigma_m * [way * SIGMAS[0], 0] for one in best for way in (-1, 1)]
    others = [one.position_m for vehicle in picture.vehicles[1:] for one in vehicle.forecasts]
    along = np.concatenate([own, *ellipses, *others])[:, 0].clip(x_m - MOST_BACK_M, x_m + MOST_AHEAD_M)
    across = own[:, 1].clip(y_m - 20, y_m + 20)
    return View(
        first_x_m=float(min(along.min(), own[:, 0].min(), x_m - VIEW_BACK_M)) - MARGIN_M,
        last_x_m=float(max(along.max(), own[:, 0].max(), x_m + VIEW_AHEAD_M)) + MARGIN_M,
        first_y_m=float(min(picture.markings_m[0], across.min())) - VERGE_M,
        last_y_m=float(max(picture.markings_m[-1], across.max())) + VERGE_M,
    )


def list_markings(picture: Picture) -> list[Row]:
    """List lane borders: y_m, and whether it is an edge of the carriageway."""
    edges = picture.markings_m[0], picture.markings_m[-1]
    return [{"y_m": y_m, "edge": y_m in edges} for y_m in picture.markings_m]


def list_lanes(picture: Picture) -> list[Row]:
    """List lanes: the name, and the y_m of the middle."""
    borders = pairwise(picture.markings_m)
    return [{"lane": f"lane {number}", "y_m": (left + right) / 2} for number, (left, right) in enumerate(borders, 1)]


def list_boxes(picture: Picture, view: View) -> list[Row]:
    """List vehicles within the view: the box from back to front, the role, and whether the size is known."""
    boxes: list[Row] = [
        {"vehicle_id": one.vehicle_id, "role": one.role} | outline_vehicle(one.history_m[-1], one.length_m, one.width_m)
        for one in picture.vehicles
    ]
    return [box for box in boxes if box["front_m"] > view.first_x_m and box["back_m"] < view.last_x_m]


def outline_vehicle(place_m: Floats, length_m: float, width_m: float) -> Row:
    """Make the box of a vehicle whose front centre is here, and whether its size is known: above 0."""
    front_m, middle_m = place_m.tolist()
    known = length_m > 0 and width_m > 0
    length_m, width_m = (length_m, width_m) if known else UNKNOWN_SIZE_M
    return {
        "known": known,
        "front_m": front_m,
        "back_m": front_m - length_m,
        "left_m": middle_m - width_m / 2,
        "right_m": middle_m + width_m / 2,
    }


def list_paths(picture: Picture, view: View) -> list[Row]:
    """List the points of lines: histories, truths, the own vehicle's other alternatives, and predictions.

    Histories are of vehicles within the view, truths of vehicles with forecasts. `series` is the legend's name:
    history, truth or a model. Points of the own vehicle that get a marker are `marked`.
    """
    own, in_view = picture.own, {box["vehicle_id"] for box in list_boxes(picture, view)}
    predicted = [vehicle for vehicle in picture.vehicles if vehicle.forecasts]
    lines = [
        *((one, "history", "history", one.history_m, 0) for one in picture.vehicles if one.vehicle_id in in_view),
        *((one, "truth", "truth", one.future_m, 0) for one in predicted if len(one.future_m)),
        *(
            (own, "alternative", forecast.model, one.mean_m, number)
            for forecast in own.forecasts
            for number, one in enumerate(find_likely(forecast), 1)
        ),
        *((one, "prediction", each.model, each.position_m, 0) for one in predicted for each in one.forecasts),
    ]
    return [row for line in lines for row in _list_points(picture.rate_hz, *line)]


def _list_points(
    rate_hz: int, vehicle: Vehicle, kind: str, series: str, points_m: Floats, number: int
) -> Iterator[Row]:
    """List the points of one line, all but histories from the vehicle's last position."""
    past, own = kind == "history", vehicle.role == "own"
    if not past:
        points_m = np.concatenate([vehicle.history_m[-1:], points_m])
    for tick, (x_m, y_m) in enumerate(points_m.tolist()):
        second = tick > 0 and tick % rate_hz == 0 and kind != "alternative"
        yield {
            "path": f"{kind} {series} {vehicle.vehicle_id} {number}",
            "kind": kind,
            "series": series,
            "vehicle_id": vehicle.vehicle_id,
            "role": vehicle.role,
            "tick": tick,
            "x_m": x_m,
            "y_m": y_m,
            "marked": own and (past or second),
        }


def find_likely(forecast: Forecast) -> tuple[Alternative, ...]:
    """Find the alternatives worth drawing beside the most probable one."""
    likely = [one for one in forecast.alternatives[1:] if one.probability >= LEAST_PROBABILITY]
    return tuple(likely[:MOST_ALTERNATIVES])


def list_ellipses(picture: Picture) -> list[Row]:
    """List outlines of the most probable alternatives at whole seconds, ELLIPSE_POINTS rows each.

    The own vehicle's come last, at 3 and 1 sigma. Others have one each, at 3 sigma of the last second: with all of them
    a scene is one coloured fog. The view's border cuts them.
    """
    seconds = slice(picture.rate_hz - 1, None, picture.rate_hz)
    return [
        {
            "ellipse": f"{forecast.model} {vehicle.vehicle_id} {second} s {sigmas} sigma",
            "series": forecast.model,
            "own": vehicle is picture.own,
            "sigmas": sigmas,
            "order": order,
            "x_m": x_m,
            "y_m": y_m,
        }
        for vehicle in [*picture.vehicles[1:], picture.own]
        for sigmas in (SIGMAS if vehicle is picture.own else SIGMAS[:1])
        for forecast in vehicle.forecasts
        for best in forecast.alternatives[:1]
        for second, outline in list(
            enumerate(
                trace_ellipses(best.mean_m[seconds], best.sigma_m[seconds], best.correlation[seconds], sigmas).tolist(),
                1,
            )
        )[0 if vehicle is picture.own else -1 :]
        for order, (x_m, y_m) in enumerate(outline)
    ]


def trace_ellipses(mean_m: Floats, sigma_m: Floats, correlation: Floats, sigmas: float) -> Floats:
    """Trace contours of T bivariate normal densities at a Mahalanobis distance: (T, ELLIPSE_POINTS, 2).

    A circle of that radius, stretched by the covariance's Cholesky factor
    [[sx, 0], [rho sy, sqrt(1 - rho^2) sy]].
    """
    turn = np.linspace(0, 2 * np.pi, ELLIPSE_POINTS, endpoint=False)
    cosine, sine = sigmas * np.cos(turn), sigmas * np.sin(turn)
    rest = np.sqrt(1 - correlation**2)
    along = sigma_m[:, :1] * cosine
    across = sigma_m[:, 1:] * (correlation[:, None] * cosine + rest[:, None] * sine)
    return mean_m[:, None, :] + np.stack([along, across], axis=-1)


def list_probabilities(picture: Picture, view: View, *, step_x_m: float, step_y_m: float) -> list[Row]:
    """List labels with the probabilities of the own vehicle's alternatives: a column beyond the ends of all lines.

    Args:
        picture: the sample.
        view: the road drawn.
        step_x_m: distance along the road from the farthest end to the column, and from there to the view's end.
        step_y_m: least distance across the road between labels.
    """
    own, rows = picture.own, list[Row]()
    for forecast in own.forecasts:
        likely = find_likely(forecast)
        for one in (forecast.alternatives[0], *likely) if likely else ():
            end_x_m, end_y_m = one.mean_m[-1].tolist()
            label = f"{one.probability:.0%}"
            rows.append({"series": forecast.model, "label": label, "end_x_m": end_x_m, "end_y_m": end_y_m})
    rows.sort(key=lambda row: row["end_y_m"])
    lines = [own.history_m, own.future_m, *(forecast.position_m for forecast in own.forecasts)]
    ends = [line[-1, 0] for line in lines if len(line)] + [row["end_x_m"] for row in rows]
    x_m = float(min(max(ends), view.last_x_m - 2 * step_x_m)) + step_x_m
    places = separate_labels(np.array([row["end_y_m"] for row in rows]), step_y_m)
    return [{**row, "x_m": x_m, "y_m": y_m} for row, y_m in zip(rows, places.tolist(), strict=True)]


def separate_labels(wanted: Floats, least: float) -> Floats:
    """Move labels (n,), which are in order, at least so far apart; their mean stays."""
    steps = least * np.arange(len(wanted))
    apart: Floats = np.maximum.accumulate(wanted - steps) + steps
    apart -= (apart - wanted).sum() / max(len(wanted), 1)
    return apart


def list_errors(picture: Picture) -> list[Row]:
    """List errors, predicted - true, of every forecast at every known tick; `second`: whether it is a whole one.

    Standard deviations are of the most probable alternative, null where the model gives none. Where lateral positions
    are lane centres, what depends on them is null.
    """
    unknown = dict.fromkeys(("distance_m", "across_m", "across_sigma_m")) if picture.lane_centred else {}
    return [
        {
            "vehicle_id": vehicle.vehicle_id,
            "own": vehicle is picture.own,
            "model": forecast.model,
            "seconds": tick / picture.rate_hz,
            "second": tick % picture.rate_hz == 0,
            "distance_m": float(np.hypot(along, across)),
            "along_m": along,
            "across_m": across,
            "along_sigma_m": along_sigma,
            "across_sigma_m": across_sigma,
            **unknown,
        }
        for vehicle in picture.vehicles
        for forecast in vehicle.forecasts
        for tick, ((along, across), (along_sigma, across_sigma)) in enumerate(_pair_errors(vehicle, forecast), 1)
    ]


def _pair_errors(vehicle: Vehicle, forecast: Forecast) -> Iterator[tuple[list[float], list[float | None]]]:
    """Pair errors and standard deviations, along and across the road, of every known tick."""
    known = len(vehicle.future_m)
    error = (forecast.position_m[:known] - vehicle.future_m).tolist()
    best = forecast.alternatives[:1]
    return zip(error, best[0].sigma_m[:known].tolist() if best else [[None, None]] * known, strict=True)
