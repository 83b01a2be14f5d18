"""Where the probabilities of alternatives are written on a drawing, so that they hide neither each other nor lines."""

from tracklake.training.plots.picture import Picture
from tracklake.training.plots.rows import Row, View, likely_alternatives


def list_odds(picture: Picture, view: View, *, step_x_m: float, step_y_m: float) -> list[Row]:
    """The probabilities of the own vehicle's alternatives: in a column beyond the ends of all lines, in their order.

    Args:
        picture: what is drawn.
        view: of the road.
        step_x_m: along the road, from the furthest end to the column, and from there to the view's end at least.
        step_y_m: across the road, from one label to the next at least.

    Returns:
        Rows of model, told, best, x_m, y_m (of the label), end_x_m, end_y_m (of the alternative).
    """
    own, rows = picture.own, list[Row]()
    for said in own.forecasts:
        others = likely_alternatives(said)
        for number, one in enumerate((said.alternatives[0], *others) if others else ()):
            end_x_m, end_y_m = one.mean_m[-1].tolist()
            told = {"model": said.model, "told": f"{one.probability:.0%}", "best": number == 0}
            rows.append({**told, "end_x_m": end_x_m, "end_y_m": end_y_m})
    rows.sort(key=lambda row: row["end_y_m"])
    lines = [*(said.position_m for said in own.forecasts), own.history_m, own.future_m]
    ends = [float(line[-1, 0]) for line in lines if len(line)] + [row["end_x_m"] for row in rows]
    x_m = min(max(ends), view.last_x_m - 2 * step_x_m) + step_x_m
    places = spread_labels([row["end_y_m"] for row in rows], step_y_m)
    return [{**row, "x_m": x_m, "y_m": y_m} for row, y_m in zip(rows, places, strict=True)]


def spread_labels(wanted: list[float], least: float) -> list[float]:
    """Places at least so far apart, with the smallest sum of squared ways from where they were wanted, in order.

    What must be spread is moved together, about its middle (isotonic regression by pooling neighbours).
    """
    blocks: list[list[float]] = []
    for number, place in enumerate(wanted):
        blocks.append([place - number * least])
        while len(blocks) > 1 and _mean(blocks[-2]) >= _mean(blocks[-1]):
            last = blocks.pop()
            blocks[-1] += last
    flat = [_mean(block) for block in blocks for _ in block]
    return [place + number * least for number, place in enumerate(flat)]


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
