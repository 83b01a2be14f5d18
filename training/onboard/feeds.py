"""What perceiving costs: the same models on the same origins and futures, fed from overhead and by the ego.

    feeds = pair_feeds(surrounding, truth, drives)          # tables of one or more synthetic drives, as frames
    parts = split_samples(feeds.overhead, seed=0)           # or keep the models that were trained on other drives
    models = [make_forecaster("ctrv", predict_turns, parts.train)]
    rows = score_feeds(models, feeds)                       # two FeedScores per model and horizon: overhead, perceived

`select_feeds(feeds, np.isin(feeds.overhead.vehicle, np.unique(parts.eval.vehicle)))` keeps the vehicles to score on. To
compare ways to perceive (penetration, with and without LiDAR, DGPS and plain GPS), call `pair_feeds` with the
`surrounding` of each and the same truth: `overhead` is the same each time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import polars as pl

from tracklake.schemas.arrays import Flags, Integers
from tracklake.schemas.protocols import V2V, DriveProtocol
from tracklake.training.onboard.collisions import NEVER, find_overlaps
from tracklake.training.onboard.models import Forecaster, predict_places
from tracklake.training.onboard.samples import Samples, build_samples, describe_truth
from tracklake.training.onboard.scores import measure_samples

FEEDS = ("overhead", "perceived")


class Feeds(NamedTuple):
    """Samples of the true vehicles, and what the ego perceives of them at the same moments.

    Args:
        overhead: A samples: every true vehicle with a whole history and future, at every step.
        perceived: P of them as the ego perceives them: its features and sizes, the same futures.
        shared: (P,) the position of each perceived sample in `overhead`.
        ghosts: samples that the ego perceives and that are no true vehicle, or one that it has already; their futures
            are unknown (NaN).
    """

    overhead: Samples
    perceived: Samples
    shared: Integers
    ghosts: Samples


@dataclass(frozen=True)
class FeedScore:
    """Figures of one model, feed and horizon over the n samples that both feeds have.

    `vehicles` are the true vehicles at all moments, `missed_vehicles` those without a perceived sample and
    `false_vehicles` the ghosts. Warnings are those of the whole horizon, against the true overlaps by true positions:
    of all vehicles, so that one that is not perceived is a missed warning, and that of a ghost a false one.
    """

    model: str
    feed: str
    seconds: float
    n: int
    rmse_m: float | None
    mae_m: float | None
    nll_nats: float | None
    vehicles: int
    missed_vehicles: int
    false_vehicles: int
    true_warnings: int
    hits: int
    missed_warnings: int
    false_warnings: int


def pair_feeds(
    surrounding: pl.DataFrame, truth: pl.DataFrame, drives: pl.DataFrame, protocol: DriveProtocol = V2V
) -> Feeds:
    """Build the samples of both feeds from `surrounding`, `surrounding_truth` and `drives` of synthetic drives."""
    within = surrounding.filter(pl.col("subset").is_in(truth["subset"].unique().implode()))
    by_truth_id = truth.with_columns(pl.col("truth_id").alias("vehicle_id"))
    overhead = build_samples(describe_truth(truth), by_truth_id, drives, protocol).samples
    perceived = build_samples(within, truth, drives, protocol, without_future=True).samples
    pairs = _list_keys(perceived, "own").join(_list_keys(overhead, "at"), on=("subset", "track", "tick"))
    chosen = pairs.sort("own").unique("at", keep="first").sort("at")
    own, at = (chosen[name].to_numpy() for name in ("own", "at"))
    is_ghost = perceived.track < 0
    is_ghost[pairs["own"].to_numpy()] = True  # one that is perceived twice
    is_ghost[own] = False
    return Feeds(overhead, perceived.select(own), at, perceived.select(is_ghost))


def _list_keys(samples: Samples, number: str) -> pl.DataFrame:
    """List drive, true vehicle and tick of samples, with their numbers in a column of this name."""
    keys = {"subset": samples.subset, "track": samples.track, "tick": samples.tick, number: np.arange(len(samples))}
    return pl.DataFrame(keys)


def select_feeds(feeds: Feeds, which: Flags) -> Feeds:
    """Select some of the overhead samples (A,) and those perceived of them; ghosts stay."""
    number = np.cumsum(which) - 1
    kept = which[feeds.shared]
    shared = number[feeds.shared[kept]]
    return Feeds(feeds.overhead.select(which), feeds.perceived.select(kept), shared, feeds.ghosts)


def score_feeds(models: Sequence[Forecaster], feeds: Feeds) -> list[FeedScore]:
    """Score models on both feeds: errors on the samples that both have, vehicles and warnings on all."""
    overhead, perceived = feeds.overhead, feeds.perceived
    comes = find_overlaps(overhead, overhead.place_m) > NEVER
    shared = overhead.select(feeds.shared)
    rows = []
    for model in models:
        warned, ghosts_warned = (_find_warned(model, samples) for samples in (overhead, feeds.ghosts))
        perceived_warned = np.zeros(len(overhead), dtype=np.bool_)
        perceived_warned[feeds.shared] = _find_warned(model, perceived)
        for feed, samples, own, ghosts in (
            (FEEDS[0], shared, warned, ghosts_warned[:0]),
            (FEEDS[1], perceived, perceived_warned, ghosts_warned),
        ):
            figures = measure_samples(model, samples, predict_places(model.name, model.predict, samples))
            for at, seconds in enumerate(V2V.scored_s):
                means = {name: float(values[:, at].mean()) for name, values in figures.items() if len(samples)}
                squared = means.get("rmse_m")
                rows.append(
                    FeedScore(
                        model=model.name,
                        feed=feed,
                        seconds=seconds,
                        n=len(samples),
                        rmse_m=None if squared is None else squared**0.5,
                        mae_m=means.get("mae_m"),
                        nll_nats=means.get("nll_nats"),
                        vehicles=len(overhead),
                        missed_vehicles=0 if feed == FEEDS[0] else len(overhead) - len(perceived),
                        false_vehicles=len(ghosts),
                        true_warnings=int(comes.sum()),
                        hits=int((own & comes).sum()),
                        missed_warnings=int((comes & ~own).sum()),
                        false_warnings=int((own & ~comes).sum() + ghosts.sum()),
                    )
                )
    return rows


def _find_warned(model: Forecaster, samples: Samples) -> Flags:
    """Find samples that a model warns of."""
    return find_overlaps(samples, predict_places(model.name, model.predict, samples)) > NEVER
