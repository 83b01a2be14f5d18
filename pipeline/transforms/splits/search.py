"""The search for the best flow-balanced allocation of n subsets.

If there are few allocations, all are scored; else a local search takes the best flip or swap until none improves.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tracklake.schemas.arrays import Flags, Floats

TOLERANCE = 5
"""Largest deviation of a part's share of the vehicles from its target, in thousandths."""
EXHAUSTIVE_STATES = 2**18
"""Largest number of allocations that are all tried: 18 subsets in two parts, 11 in three."""
MAX_SWAPS = 50_000
"""Swaps scored in one step of the search; more (beyond about 500 subsets) are sampled."""
KICKS, KICKED = 2, 12
"""Descents per random start from the best allocation so far, and subsets whose parts are exchanged before each."""
TIE = 1e-8
"""Difference of vehicles_per_lane_s below which two are equal; sums of squares carry no more digits."""
VEHICLES, FILLED, WEIGHT, FLOW, FLOW2 = range(5)
"""Columns of `Problem.facts`."""
Indices = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Problem:
    """One dataset's subsets as arrays, in an order that does not depend on the rows' order.

    Args:
        shares: (P,) thousandths of the vehicles; the first part is train, the last eval.
        facts: (n, 5) vehicles, filled (1 = has samples), weight, weight * rate, weight * rate^2; rate is
            vehicles_per_lane_s, centred.
        group: (n,) number of the subset's (site, direction).
        paired: (G,) whether that (site, direction) has at least two subsets.
    """

    shares: Floats
    facts: Floats
    group: Indices
    paired: Flags

    @property
    def parts(self) -> int:
        """P, the number of parts."""
        return len(self.shares)

    @property
    def subsets(self) -> int:
        """n, the number of subsets."""
        return len(self.group)


@dataclass(frozen=True)
class Scores:
    """The scores of M allocations, the most important first; lower is better, but for eval_std. All arrays are (M,).

    Args:
        broken: broken constraints: an empty train or eval part counts most, then each (site, direction) without a
            subset in one of the two, then an empty val part.
        share: vehicles (in thousandths) by which the parts' shares lie outside their bands, in total.
        difference: sum of the absolute differences of vehicles_per_lane_s in mean and deviation; infinite if undefined.
        eval_std: standard deviation of vehicles_per_lane_s in eval, which decides ties.
    """

    broken: Floats
    share: Floats
    difference: Floats
    eval_std: Floats

    def find_best(self) -> int:
        """Return the index of the best allocation; the first of equal ones."""
        among = np.flatnonzero(self.broken == self.broken.min())
        among = among[self.share[among] == self.share[among].min()]
        among = among[self.difference[among] <= self.difference[among].min() + TIE]
        return int(among[np.argmax(self.eval_std[among])])

    def find_steepest(self) -> int:
        """Return the index of the best allocation, without the rule for ties."""
        among = np.flatnonzero(self.broken == self.broken.min())
        among = among[self.share[among] == self.share[among].min()]
        return int(among[np.argmin(self.difference[among])])

    def get_key(self, index: int) -> tuple[float, float, float]:
        """Return an allocation's scores as a tuple that sorts from best to worst, without the rule for ties."""
        return (float(self.broken[index]), float(self.share[index]), float(self.difference[index]))


def find_allocation(problem: Problem, random: np.random.Generator, restarts: int) -> Indices:
    """Find the best (n,) numbers of the subsets' parts, by trying all or by `restarts` random descents."""
    if problem.parts**problem.subsets <= EXHAUSTIVE_STATES:
        return _try_all(problem)
    return _search_locally(problem, random, restarts)


def _score_sums(problem: Problem, sums: Floats, uncovered: Floats) -> Scores:
    """Score M allocations by the (M, P, 5) sums of facts and the (M,) counts of `_count_uncovered`."""
    filled = sums[:, :, FILLED]
    available = problem.facts[:, FILLED].sum()
    empty = (filled[:, 0] == 0) | (filled[:, -1] == 0) if available > 1 else filled[:, 0] == 0
    broken = 1e6 * empty + 10.0 * uncovered
    if problem.parts > 2 and available > 2:
        broken = broken + (filled[:, 1] == 0)

    total = problem.facts[:, VEHICLES].sum()
    excess = np.abs(1000.0 * sums[:, :, VEHICLES] - problem.shares * total) - TOLERANCE * total
    weight = sums[:, :, WEIGHT]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = sums[:, :, FLOW] / weight
        std = np.sqrt(np.maximum(sums[:, :, FLOW2] / weight - mean**2, 0.0))
    difference = np.zeros(len(sums))
    for a in range(problem.parts):
        for b in range(a + 1, problem.parts):
            difference += np.abs(mean[:, a] - mean[:, b]) + np.abs(std[:, a] - std[:, b])
    return Scores(
        broken=broken,
        share=np.maximum(excess, 0.0).sum(axis=1),
        difference=np.where(np.isnan(difference), np.inf, difference),
        eval_std=np.nan_to_num(std[:, -1]),
    )


def sum_facts(problem: Problem, part: Indices) -> Floats:
    """Sum the facts over the parts of M allocations (M, n), to (M, P, 5)."""
    return np.stack([(part == p).astype(np.float64) @ problem.facts for p in range(problem.parts)], axis=1)


def _count_uncovered(problem: Problem, part: Indices) -> Floats:
    """Count the (site, direction, train or eval) without a subset in allocations (M, n), to (M,)."""
    membership = np.eye(len(problem.paired))[problem.group][:, problem.paired]
    uncovered = np.zeros(len(part))
    for end in (0, problem.parts - 1):
        uncovered += ((part == end).astype(np.float64) @ membership == 0).sum(axis=1)
    return uncovered


def _score_parts(problem: Problem, part: Indices) -> Scores:
    """Score allocations (M, n)."""
    return _score_sums(problem, sum_facts(problem, part), _count_uncovered(problem, part))


def _try_all(problem: Problem) -> Indices:
    """Find the best of all allocations, (n,)."""
    codes = np.arange(problem.parts**problem.subsets)
    part = (codes[:, None] // problem.parts ** np.arange(problem.subsets)) % problem.parts
    best: Indices = part[_score_parts(problem, part).find_best()]
    return best


def _search_locally(problem: Problem, random: np.random.Generator, restarts: int) -> Indices:
    """Find the best allocation of many descents, (n,).

    `restarts` descents start at random allocations, and KICKS times as many near the best allocation so far; the
    latter are short.
    """
    ends = np.stack([_descend(problem, _draw_start(problem, random), random) for _ in range(max(1, restarts))])
    best = ends[_score_parts(problem, ends).find_best()]
    for _ in range(KICKS * restarts):
        start = best.copy()
        moved = random.permutation(problem.subsets)[:KICKED]
        start[moved] = best[random.permutation(moved)]
        pair = np.stack([best, _descend(problem, start, random)])
        best = pair[_score_parts(problem, pair).find_best()]
    found: Indices = best
    return found


def _draw_start(problem: Problem, random: np.random.Generator) -> Indices:
    """Deal out subsets in random order by their vehicles: first to eval, then to val, the rest to train."""
    order = random.permutation(problem.subsets)
    vehicles = problem.facts[order, VEHICLES]
    middle = np.cumsum(vehicles) - vehicles / 2
    bounds = np.cumsum(problem.shares[::-1])[:-1] * vehicles.sum() / 1000
    part = np.empty(problem.subsets, dtype=np.intp)
    part[order] = problem.parts - 1 - np.searchsorted(bounds, middle, side="right")
    return part


def _descend(problem: Problem, part: Indices, random: np.random.Generator) -> Indices:
    """Take the best flip or swap until none improves (broken constraints, shares, difference, in this order)."""
    n, parts = problem.subsets, problem.parts
    first, second = np.triu_indices(n, k=1)
    flip_subset = np.repeat(np.arange(n), parts)
    flip_to = np.tile(np.arange(parts), n)
    here = _score_parts(problem, part[None]).get_key(0)
    while True:
        flips = flip_to != part[flip_subset]
        swaps = np.flatnonzero(part[first] != part[second])
        if len(swaps) > MAX_SWAPS:
            swaps = random.choice(swaps, MAX_SWAPS, replace=False)
        # Every move puts subset i into part `to`, and subset j (its swap; i itself in a flip) into i's part.
        i = np.concatenate([flip_subset[flips], first[swaps]])
        j = np.concatenate([flip_subset[flips], second[swaps]])
        to = np.concatenate([flip_to[flips], part[second[swaps]]])
        swapped = i != j

        gain = problem.facts[i] - np.where(swapped[:, None], problem.facts[j], 0.0)
        moves = np.arange(len(i))
        sums = np.repeat(sum_facts(problem, part[None]), len(i), axis=0)
        sums[moves, part[i]] -= gain
        sums[moves, to] += gain

        change = _find_coverage_changes(problem, part)
        apart = swapped & (problem.group[i] != problem.group[j])
        uncovered = _count_uncovered(problem, part[None]) + np.where(
            apart, change[i, to] + change[j, part[i]], np.where(swapped, 0.0, change[i, to])
        )
        scores = _score_sums(problem, sums, uncovered)
        move = scores.find_steepest()
        # The sums are exact for whole numbers but not for rates, so an improvement must exceed rounding errors.
        broken, share, difference = scores.get_key(move)
        if (broken, share, difference + TIE / 100) >= here:
            return part
        here = (broken, share, difference)
        part = part.copy()
        part[j[move]], part[i[move]] = part[i[move]], to[move]


def _find_coverage_changes(problem: Problem, part: Indices) -> Floats:
    """Find the change of `uncovered` when subset i moves to part q, (n, P)."""
    n, parts = problem.subsets, problem.parts
    counts = np.zeros((len(problem.paired), parts))
    np.add.at(counts, (problem.group, part), 1.0)
    before = counts[problem.group]
    after = np.repeat(before[:, None, :], parts, axis=1)
    after[np.arange(n), :, part] -= 1.0
    after[:, np.arange(parts), np.arange(parts)] += 1.0
    ends = [0, parts - 1]
    change: Indices = (after[:, :, ends] == 0).sum(axis=2) - (before[:, None, ends] == 0).sum(axis=2)
    change[~problem.paired[problem.group]] = 0
    return change.astype(np.float64)
