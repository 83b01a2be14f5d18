"""Scores of one way to perceive: both views of the same moments, and what differs from another way, with intervals."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Floats, Integers, Singles
from tracklake.training.onboard.collisions import NEVER, find_overlaps
from tracklake.training.onboard.feeds import FEEDS, Feeds
from tracklake.training.onboard.models import Forecaster, predict_places
from tracklake.training.onboard.samples import Samples
from tracklake.training.onboard.scores import INTERVAL, RESAMPLES, bootstrap_mean, measure_samples

LEAST_VEHICLES = 6
"""Fewest vehicles of which a difference is stated: five that all differ the same way do so by chance in 1 of 16."""

Row = dict[str, float | None]


class Figure(NamedTuple):
    """Values (B,) whose mean is the figure, and the vehicle of each.

    `at` numbers samples that two views may lack, so that both are compared on those that both have; None: compare all.
    """

    values: Floats
    vehicles: npt.NDArray[np.str_]
    at: Integers | None = None


class Judged(NamedTuple):
    """Figures of one condition by name: of the vehicles, and of each model's predictions from what is perceived."""

    vehicles: dict[str, Figure]
    models: dict[str, dict[str, Figure]]


def judge_vehicles(feeds: Feeds) -> dict[str, Figure]:
    """Find which true vehicles were missed, and which of the perceived are false."""
    overhead, perceived = feeds.overhead, feeds.perceived
    missed = np.ones(len(overhead))
    missed[feeds.shared] = 0.0
    false = np.repeat((0.0, 1.0), (len(perceived), len(feeds.ghosts)))
    perceived_or_false = np.append(perceived.vehicle, _name_ghosts(feeds))
    return {"missed_share": Figure(missed, overhead.vehicle), "false_share": Figure(false, perceived_or_false)}


def judge_model(model: Forecaster, feeds: Feeds, seen: dict[tuple[str, bytes], Singles]) -> list[dict[str, Figure]]:
    """Measure a model's predictions from both views, in the order of FEEDS; `seen` keeps those from overhead."""
    overhead, perceived, ghosts = feeds.overhead, feeds.perceived, feeds.ghosts
    key = model.name, overhead.feature.tobytes()
    if key not in seen:
        seen[key] = predict_places(model.name, model.predict, overhead)
    place_m = model.predict(perceived) if len(perceived) else perceived.place_m
    warned = np.zeros(len(overhead), bool)
    warned[feeds.shared] = find_overlaps(perceived, place_m) > NEVER
    ghosts_warned = find_overlaps(ghosts, model.predict(ghosts)) > NEVER if len(ghosts) else np.zeros(0, bool)
    both = (
        (
            overhead.select(feeds.shared),
            seen[key][feeds.shared],
            find_overlaps(overhead, seen[key]) > NEVER,
            ghosts_warned[:0],
        ),
        (perceived, place_m, warned, ghosts_warned),
    )
    return [
        _measure_errors(model, samples, own_m, feeds.shared) | _judge_warnings(feeds, warns, strange)
        for samples, own_m, warns, strange in both
    ]


def _measure_errors(model: Forecaster, samples: Samples, place_m: Singles, at: Integers) -> dict[str, Figure]:
    measured = measure_samples(model, samples, place_m)
    return {name: Figure(measured[name][:, -1], samples.vehicle, at) for name in ("rmse_m", "nll_nats")}


def _judge_warnings(feeds: Feeds, warned: Flags, ghosts_warned: Flags) -> dict[str, Figure]:
    overhead = feeds.overhead
    due = find_overlaps(overhead, overhead.place_m) > NEVER
    others = np.append(overhead.vehicle[~due], _name_ghosts(feeds)[: len(ghosts_warned)])
    return {
        "missed_warnings": Figure((~warned[due]).astype(np.float64), overhead.vehicle[due]),
        "false_warnings": Figure(np.append(warned[~due], ghosts_warned).astype(np.float64), others),
    }


def _name_ghosts(feeds: Feeds) -> npt.NDArray[np.str_]:
    named = zip(feeds.ghosts.subset, feeds.ghosts.vehicle_id, strict=True)
    return np.array([f"{drive}:{vehicle}" for drive, vehicle in named], dtype=np.str_)


def score_condition(
    feeds: Feeds,
    models: Sequence[Forecaster],
    seen: dict[tuple[str, bytes], Singles],
    others: Mapping[str, Judged],
) -> tuple[Judged, Iterator[Row]]:
    """Score all models on both views, with what differs from the `others`, conditions by how this one is unlike them.

    Columns of differences are `added_` (perceived minus overhead) and the names of the others (this minus that one).
    """
    vehicles = judge_vehicles(feeds)
    judged = {model.name: judge_model(model, feeds, seen) for model in models}
    perceived = {name: figures[1] for name, figures in judged.items()}
    shares = _bound_all("", vehicles)
    for unlike, other in others.items():
        shares |= _compare_all(unlike, other.vehicles, vehicles)

    def list_rows() -> Iterator[Row]:
        for name, figures in judged.items():
            row = {**shares, "model": name, **_compare_all("added", *figures)}
            for feed, own in zip(FEEDS, figures, strict=True):
                row |= _bound_all(f"{feed}_", own)
            for unlike, other in others.items():
                row |= _compare_all(unlike, other.models[name], perceived[name])
            yield row

    return Judged(vehicles, perceived), list_rows()


def _bound_all(prefix: str, figures: Mapping[str, Figure]) -> Row:
    return {name: value for key, own in figures.items() for name, value in bound(f"{prefix}{key}", own).items()}


def _compare_all(unlike: str, before: Mapping[str, Figure], after: Mapping[str, Figure]) -> Row:
    return {
        name: value
        for key, own in after.items()
        for name, value in bound_difference(f"{unlike}_{key}", before[key], own).items()
    }


def bound(name: str, figure: Figure) -> Row:
    """Return the mean of a figure with its 95 % interval over vehicles; the root of all three for an RMSE."""
    names = (name, f"{name}_low", f"{name}_high")
    if not len(figure.values):
        return dict.fromkeys(names)
    low, high = bootstrap_mean(figure.values[:, None], np.unique(figure.vehicles, return_inverse=True)[1])
    found = (float(figure.values.mean()), float(low[0]), float(high[0]))
    return dict(zip(names, (value**0.5 if name.endswith("rmse_m") else value for value in found), strict=True))


def bound_difference(name: str, before: Figure, after: Figure) -> Row:
    """Return how much `after` is more than `before`, with its 95 % interval: the same vehicles are drawn for both.

    All three are None for fewer than LEAST_VEHICLES.
    """
    names = (name, f"{name}_low", f"{name}_high")
    both = [before, after]
    if before.at is not None and after.at is not None:
        chosen = np.intersect1d(before.at, after.at, return_indices=True)[1:]
        both = [Figure(own.values[at], own.vehicles[at]) for own, at in zip(both, chosen, strict=True)]
    drawn_from, number = np.unique(np.concatenate([own.vehicles for own in both]), return_inverse=True)
    if min(len(np.unique(own.vehicles)) for own in both) < LEAST_VEHICLES:
        return dict.fromkeys(names)
    count = len(drawn_from)
    draws = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), size=RESAMPLES)
    draws = np.concatenate((np.ones((1, count)), draws))  # first, every vehicle once: the figure itself
    means = []
    for own, at in zip(both, np.split(number, [len(both[0].values)]), strict=True):
        of = draws @ np.bincount(at, minlength=count)
        mean = draws @ np.bincount(at, own.values, count) / np.where(of > 0, of, np.nan)  # of none: left out below
        means.append(mean**0.5 if name.endswith("rmse_m") else mean)
    differences = means[1] - means[0]
    low, high = np.nanpercentile(differences[1:], INTERVAL)
    return dict(zip(names, (float(differences[0]), float(low), float(high)), strict=True))
