"""How alike flow-balanced makes the parts of a lake like highD, and how long the search takes.

    python benchmarks/split.py [--seeds N]

117 subsets of six sites with 0.12 to 0.50 vehicles per lane and second, as highD has, and entries (78 k to 0.77 M);
the numbers themselves are drawn. Beside them stands what Hamalainen (2020) published of its own split.
"""

import argparse
import random
import time
from itertools import combinations

import polars as pl

from tracklake.pipeline.transforms.splits.allocation import allocate_flow_balanced
from tracklake.pipeline.transforms.splits.tables import COLUMNS, Allocation
from tracklake.schemas.split_recipes import FLOW_BALANCED, SplitRecipe

SUBSETS = 117
SITES = {"1": 60, "2": 10, "3": 10, "4": 8, "5": 7, "6": 5}
"""Weights: most of highD was recorded at one of its sites."""
LOW, HIGH = 0.12, 0.50
FEWEST, MOST = 78e3, 770e3
STUDY_MEAN, STUDY_STD = 2e-3, 1e-3
"""Published: 0.349 and 0.351 veh/lane/s, standard deviations 0.076 and 0.075."""


def draw_subsets(seed: int) -> pl.DataFrame:
    """Subsets in highD's proportions: two carriageways per recording, with traffic and entries of their own."""
    draw = random.Random(seed)
    rows = []
    for position in range(SUBSETS):
        if position % 2 == 0:
            site = draw.choices(list(SITES), weights=list(SITES.values()))[0]
        rate = draw.uniform(LOW, HIGH)
        entries = round(FEWEST + (rate - LOW) / (HIGH - LOW) * (MOST - FEWEST) * draw.uniform(0.7, 1.0))
        vehicles = round(rate * 2.4 * 900 * draw.uniform(0.7, 1.2))
        side = ("upper", "lower")[position % 2]
        rows.append(("highd", f"{position // 2 + 1:02d}-{side}", site, side, vehicles, entries, rate, 1, 22_500))
    return pl.DataFrame(rows, schema=COLUMNS, orient="row")


def differ(allocation: Allocation) -> tuple[float, float]:
    """Sums over the pairs of parts of the differences of vehicles_per_lane_s in mean and standard deviation."""
    parts = allocation.balance.select("vehicles_per_lane_s_mean", "vehicles_per_lane_s_std").rows()
    pairs = list(combinations(parts, 2))
    return sum(abs(a[0] - b[0]) for a, b in pairs), sum(abs(a[1] - b[1]) for a, b in pairs)


def main() -> None:
    """Print differences and seconds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="how many lakes to draw")
    seeds = parser.parse_args().seeds
    print(f"{'':<18}{'difference of':>15}{'difference of':>15}{'together':>11}{'processor':>11}{'shares':>9}")
    print(f"{'':<18}{'mean':>15}{'deviation':>15}{'':>11}{'time, s':>11}{'met':>9}")
    print(f"{'study (two parts)':<18}{STUDY_MEAN:>15.1e}{STUDY_STD:>15.1e}{STUDY_MEAN + STUDY_STD:>11.1e}")
    worst = 0.0
    for validation in (False, True):
        for seed in range(seeds):
            subsets = draw_subsets(seed)
            begun = time.process_time()
            allocation = allocate_flow_balanced(subsets, SplitRecipe(FLOW_BALANCED, validation=validation))
            seconds = time.process_time() - begun
            mean, std = differ(allocation)
            worst = max(worst, mean + std)
            name = f"{'three' if validation else 'two'} parts, {seed}"
            met = "no" if allocation.relaxations else "yes"
            print(f"{name:<18}{mean:>15.1e}{std:>15.1e}{mean + std:>11.1e}{seconds:>11.1f}{met:>9}")
    print(f"worst: {worst:.1e} veh/lane/s together; no allocation can be below 0")


if __name__ == "__main__":
    main()
