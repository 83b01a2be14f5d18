"""Rows of the chart of a picture: vehicles, paths, ellipses, labels and errors; positions in m on the carriageway."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tracklake.training.plots.charts import Row
from tracklake.training.plots.forecasts import Alternative, Doubles, Forecast
from tracklake.training.plots.picture import Picture, Vehicle

UNKNOWN_SIZE_M = (4.5, 1.8)
"""Length and width drawn, as an outline, where a vehicle's size is unknown."""
LEAST_PROBABILITY = 0.05
"""Least probability of an alternative that is drawn beside the most probable one."""
MOST_ALTERNATIVES = 3
"""Most alternatives drawn beside the most probable one."""
SIGMAS = (3, 1)
"""Standard deviations at which ellipses are drawn, outer one first."""
ELLIPSE_POINTS = 48
"""Points of an ellipse's outline."""
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
    last = len(picture.markings_m) - 1
    return [{"y_m": y_m, "edge": number in (0, last)} for number, y_m in enumerate(picture.markings_m)]


def list_lanes(picture: Picture) -> list[Row]:
    """List lanes: the name, and the y_m of the middle."""
    borders = pairwise(picture.markings_m)
    return [{"lane": f"lane {number}", "y_m": (left + right) / 2} for number, (left, right) in enumerate(borders, 1)]


def list_boxes(picture: Picture, view: View) -> list[Row]:
    """List vehicles within the view: the box from back to front, the role, and whether the size is known."""
    boxes = map(_make_box, picture.vehicles)
    return [box for box in boxes if box["front_m"] > view.first_x_m and box["back_m"] < view.last_x_m]


def _make_box(vehicle: Vehicle) -> Row:
    known = not (np.isnan(vehicle.length_m) or np.isnan(vehicle.width_m))
    length_m, width_m = (vehicle.length_m, vehicle.width_m) if known else UNKNOWN_SIZE_M
    front_m, middle_m = vehicle.history_m[-1].tolist()
    return {
        "vehicle_id": vehicle.vehicle_id,
        "role": vehicle.role,
        "known": known,
        "front_m": front_m,
        "back_m": front_m - length_m,
        "left_m": middle_m - width_m / 2,
        "right_m": middle_m + width_m / 2,
    }


def list_paths(picture: Picture, view: View) -> list[Row]:
    """List the points of lines: histories, truths, the own vehicle's other alternatives, and predictions.

    Histories are of vehicles within the view, truths of vehicles with forecasts. All but histories begin at the
    vehicle's last position.

    Returns:
        Rows of path (a line's name), kind, series (the legend's name: history, truth or a model), vehicle_id, role,
        tick, x_m, y_m, and marked: points of the own vehicle that get a marker.
    """
    rate, own = picture.rate_hz, picture.own
    in_view = {box["vehicle_id"] for box in list_boxes(picture, view)}
    predicted = [vehicle for vehicle in picture.vehicles if vehicle.forecasts]
    paths = [
        *(_Path(one, "history", "history", one.history_m) for one in picture.vehicles if one.vehicle_id in in_view),
        *(_Path(one, "truth", "truth", one.future_m) for one in predicted if len(one.future_m)),
        *(
            _Path(own, "alternative", forecast.model, one.mean_m, number)
            for forecast in own.forecasts
            for number, one in enumerate(find_likely(forecast), 1)
        ),
        *(_Path(one, "prediction", each.model, each.position_m) for one in predicted for each in one.forecasts),
    ]
    return [row for path in paths for row in path.list_points(rate)]


@dataclass(frozen=True)
class _Path:
    """One line of a vehicle; `number` distinguishes a model's alternatives."""

    vehicle: Vehicle
    kind: str
    series: str
    position_m: Doubles
    number: int = 0

    def list_points(self, rate_hz: int) -> Iterator[Row]:
        """List the points; a future begins at the vehicle's last position."""
        past, own = self.kind == "history", self.vehicle.role == "own"
        points = self.position_m if past else np.concatenate([self.vehicle.history_m[-1:], self.position_m])
        named = {
            "path": f"{self.kind} {self.series} {self.vehicle.vehicle_id} {self.number}",
            "kind": self.kind,
            "series": self.series,
            "vehicle_id": self.vehicle.vehicle_id,
            "role": self.vehicle.role,
        }
        for tick, (x_m, y_m) in enumerate(points.tolist()):
            second = tick > 0 and tick % rate_hz == 0 and self.kind != "alternative"
            yield {**named, "tick": tick, "x_m": x_m, "y_m": y_m, "marked": own and (past or second)}


def find_likely(forecast: Forecast) -> tuple[Alternative, ...]:
    """Find the alternatives worth drawing beside the most probable one."""
    likely = [one for one in forecast.alternatives[1:] if one.probability >= LEAST_PROBABILITY]
    return tuple(likely[:MOST_ALTERNATIVES])


def list_ellipses(picture: Picture) -> list[Row]:
    """List outlines of the most probable alternatives at whole seconds, ELLIPSE_POINTS rows each.

    The own vehicle's come last, at 3 and 1 sigma; those of others are at 3. The view's border cuts them.
    """
    others_first = [*picture.vehicles[1:], picture.own]
    return [row for vehicle in others_first for row in _trace_vehicle(picture.rate_hz, vehicle)]


def _trace_vehicle(rate_hz: int, vehicle: Vehicle) -> Iterator[Row]:
    own, seconds = vehicle.role == "own", slice(rate_hz - 1, None, rate_hz)
    for sigmas in SIGMAS if own else SIGMAS[:1]:
        for forecast in vehicle.forecasts:
            for best in forecast.alternatives[:1]:
                at = best.mean_m[seconds], best.sigma_m[seconds], best.correlation[seconds]
                for second, outline in enumerate(trace_ellipses(*at, sigmas).tolist(), 1):
                    ellipse = f"{forecast.model} {vehicle.vehicle_id} {second} s {sigmas} sigma"
                    named = {"ellipse": ellipse, "series": forecast.model, "own": own, "sigmas": sigmas}
                    for order, (x_m, y_m) in enumerate(outline):
                        yield {**named, "order": order, "x_m": x_m, "y_m": y_m}


def trace_ellipses(mean_m: Doubles, sigma_m: Doubles, correlation: Doubles, sigmas: float) -> Doubles:
    """Trace contours of bivariate normal densities at a Mahalanobis distance: (T, ELLIPSE_POINTS, 2).

    A circle of that radius, stretched by the covariance's Cholesky factor
    [[sx, 0], [rho sy, sqrt(1 - rho^2) sy]].

    Args:
        mean_m: (T, 2)
        sigma_m: (T, 2)
        correlation: (T,)
        sigmas: the distance.
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

    Returns:
        Rows of series (the model), label, x_m, y_m (of the label), end_x_m, end_y_m (of the alternative).
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


def separate_labels(wanted: Doubles, least: float) -> Doubles:
    """Move labels (n,), which are in order, at least so far apart; their mean stays."""
    steps = least * np.arange(len(wanted))
    apart: Doubles = np.maximum.accumulate(wanted - steps) + steps
    apart -= (apart - wanted).sum() / max(len(wanted), 1)
    return apart


def list_errors(picture: Picture) -> list[Row]:
    """List errors, predicted - true, of every forecast at every known tick.

    Keys: vehicle_id, own, model, seconds, second (whether whole), distance_m, along_m, across_m; and along_sigma_m
    and across_sigma_m of the most probable alternative, null where the model gives none.
    """
    rate = picture.rate_hz
    return [row for vehicle in picture.vehicles for one in vehicle.forecasts for row in _subtract(rate, vehicle, one)]


def _subtract(rate_hz: int, vehicle: Vehicle, forecast: Forecast) -> Iterator[Row]:
    known = len(vehicle.future_m)
    error = (forecast.position_m[:known] - vehicle.future_m).tolist()
    best = forecast.alternatives[:1]
    sigma = best[0].sigma_m[:known].tolist() if best else [(None, None)] * known
    for tick, ((along, across), (along_sigma, across_sigma)) in enumerate(zip(error, sigma, strict=True), 1):
        yield {
            "vehicle_id": vehicle.vehicle_id,
            "own": vehicle.role == "own",
            "model": forecast.model,
            "seconds": tick / rate_hz,
            "second": tick % rate_hz == 0,
            "distance_m": float(np.hypot(along, across)),
            "along_m": along,
            "across_m": across,
            "along_sigma_m": along_sigma,
            "across_sigma_m": across_sigma,
        }
