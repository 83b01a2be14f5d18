"""Figures of predicted uncertainty: coverage of regions, sigma beside the error by traffic, and conformal radii."""

import math
from collections.abc import Iterator

import numpy as np
import polars as pl
import polars.selectors as cs

from tracklake.schemas.arrays import Floats
from tracklake.schemas.columns import Table
from tracklake.schemas.comparisons import CALIBRATION, CONFORMAL_RADII, DENSITY_ERRORS
from tracklake.training.comparison.bootstrap import estimate_shares
from tracklake.training.comparison.record import SampleRecord
from tracklake.training.comparison.traffic_states import list_classes

LEVELS = (*(round(0.05 * step, 2) for step in range(1, 20)), 0.99)
"""Probabilities of the regions whose coverage is measured."""
RADIUS_LEVELS = (0.5, 0.9, 0.95)
"""Shares of true places that conformal radii are to hold."""


def calibrate(run: str, record: SampleRecord) -> pl.DataFrame:
    """Count how many true places lie in regions of LEVELS: rows of `schemas.comparisons.CALIBRATION`.

    There are none where the model gives no density.
    """
    rows = []
    for at, seconds in enumerate(record.seconds):
        judged = record.known[:, at] & ~np.isnan(record.level[:, at])
        if not judged.any():
            continue
        inside = record.level[judged, at, None] <= np.array(LEVELS)
        share, low, high, n, vehicles = estimate_shares(inside, record.vehicle[judged])
        rows.append(
            pl.DataFrame({"level": LEVELS, "coverage": share, "low": low, "high": high}).with_columns(
                run=pl.lit(run), seconds=pl.lit(seconds), n=pl.lit(n), vehicles=pl.lit(vehicles)
            )
        )
    return _finish(CALIBRATION, rows)


def score_by_density(run: str, record: SampleRecord, density: Floats) -> pl.DataFrame:
    """Compare errors with predicted sigma by traffic density (S,): rows of `schemas.comparisons.DENSITY_ERRORS`."""
    return _finish(DENSITY_ERRORS, list(_score_classes(run, record, density)))


def _score_classes(run: str, record: SampleRecord, density: Floats) -> Iterator[pl.DataFrame]:
    for name, members in list_classes(density).items():
        for at, seconds in enumerate(record.seconds):
            of = members & record.known[:, at]
            if of.any():
                rmse = np.sqrt(np.mean(record.error_m[of, at].astype(np.float64) ** 2, axis=0))
                sigma = np.sqrt(np.mean(record.sigma_m[of, at].astype(np.float64) ** 2, axis=0))
                yield pl.DataFrame(
                    {
                        "run": [run],
                        "density": [name],
                        "seconds": [seconds],
                        "n": [int(of.sum())],
                        "vehicles": [len(np.unique(record.vehicle[of]))],
                        "mean_density_vpkm": [
                            float(np.nanmean(density[of])) if (~np.isnan(density[of])).any() else None
                        ],
                        "rmse_longitudinal_m": [rmse[0]],
                        "sigma_longitudinal_m": [sigma[0]],
                        "rmse_lateral_m": [rmse[1]],
                        "sigma_lateral_m": [sigma[1]],
                    }
                )


def find_radii(run: str, record: SampleRecord, density: Floats, seed: int = 0) -> pl.DataFrame:
    """Find the radii that hold a share of true places, by traffic density: rows of `CONFORMAL_RADII`.

    Split-conformal: half of the vehicles, drawn by a seed, give the radii, the other half the coverage. Of n distances
    in ascending order the radius of a share p is number ceil((n + 1) p), so that it holds a further sample with a
    probability of p or more if samples are exchangeable (Lei et al. 2018, Journal of the American Statistical
    Association 113). Samples of one vehicle are not quite, so whole vehicles are held back to measure the coverage.
    """
    number = int(record.vehicle.max(initial=-1)) + 1
    gives = np.zeros(number, dtype=np.bool_)
    gives[np.random.default_rng(seed).permutation(number)[: number // 2]] = True
    calibrates = gives[record.vehicle]
    distance = np.hypot(record.error_m[..., 0], record.error_m[..., 1]).astype(np.float64)
    rows = []
    for name, members in list_classes(density).items():
        for at, seconds in enumerate(record.seconds):
            of = members & ~np.isnan(distance[:, at])
            known, held_back = distance[of & calibrates, at], of & ~calibrates
            for level in RADIUS_LEVELS:
                radius = find_radius(known, level)
                row = {"run": run, "density": name, "seconds": seconds, "level": level, "radius_m": radius}
                row |= {"calibration_n": len(known), "n": int(held_back.sum()), "vehicles": 0}
                if radius is not None and held_back.any():
                    inside = distance[held_back, at, None] <= radius
                    share, low, high, _, row["vehicles"] = estimate_shares(inside, record.vehicle[held_back])
                    row |= {"coverage": float(share[0]), "low": float(low[0]), "high": float(high[0])}
                rows.append(pl.DataFrame([row], schema=CONFORMAL_RADII.dtypes))
    return _finish(CONFORMAL_RADII, rows)


def find_radius(distance: Floats, level: float) -> float | None:
    """Find the radius that holds a share of further distances like these (n,); None where there are too few."""
    rank = math.ceil(round((len(distance) + 1) * level, 9))
    return None if rank > len(distance) else float(np.partition(distance, rank - 1)[rank - 1])


def _finish(table: Table, rows: list[pl.DataFrame]) -> pl.DataFrame:
    """Join rows of a table in its order; what could not be computed becomes null."""
    joined = pl.concat([table.conform(own.lazy()).collect() for own in rows] or [table.empty()])
    return joined.with_columns(cs.float().fill_nan(None)).sort(table.key)
