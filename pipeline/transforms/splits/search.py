"""The search behind the flow-balanced allocation: which of all allocations of n subsets is the best.

All of them are scored where they are few; else a local search takes the best flip or swap until none improves.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

TOLERANCE = 5
"""How far a part's share of the vehicles may lie from its target, in thousandths."""

EXHAUSTIVE_STATES = 2**18
"""Up to so many allocations all of them are tried: 18 subsets in two parts, 11 in three."""

MAX_SWAPS = 50_000
"""Swaps looked at in one step of the search; more (beyond about 500 subsets) are sampled."""

KICKS, KICKED = 2, 12
"""After the random starts: descents from the best allocation with the parts of so many subsets exchanged."""

TIE = 1e-8
"""Differences of flow (veh/lane/s) closer than this are equal; sums of squares carry no more digits."""

VEHICLES, FILLED, WEIGHT, FLOW, FLOW2 = range(5)
"""Columns of `Problem.facts`."""

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Problem:
    """One dataset's subsets as arrays, in an order that does not depend on the rows' order.

    Args:
        shares: (P,) thousandths of the vehicles; the first part trains, the last evaluates.
        facts: (n, 5) vehicles, filled (1 = has samples), weight, weight * flow, weight * flow^2; flow is centred.
        group: (n,) which (site, direction) a subset belongs to.
        paired: (G,) whether that (site, direction) has at least two subsets.
    """

    shares: Floats
    facts: Floats
    group: Indices
    paired: npt.NDArray[np.bool_]

    @property
    def parts(self) -> int:
        """P: how many parts there are."""
        return len(self.shares)

    @property
    def subsets(self) -> int:
        """n: how many subsets are to be allocated."""
        return len(self.group)


@dataclass(frozen=True)
class Scores:
    """How good M allocations are, in the order in which it counts; all arrays are (M,).

    Args:
        broken: constraints broken: an empty training or evaluation part counts most, then each (site, direction)
            without a subset in one of the two, then an empty validation part.
        share: vehicles (in thousandths) by which the parts' shares miss their bands, together.
        difference: sum of the absolute differences of flow's mean and standard deviation; infinite where undefined.
        eval_std: standard deviation of flow in the evaluation part, which decides ties.
    """

    broken: Floats
    share: Floats
    difference: Floats
    eval_std: Floats

    def best(self) -> int:
        """Position of the best one; the first of those that are equal in everything."""
        among = np.flatnonzero(self.broken == self.broken.min())
        among = among[self.share[among] == self.share[among].min()]
        among = among[self.difference[among] <= self.difference[among].min() + TIE]
        return int(among[np.argmax(self.eval_std[among])])

    def steepest(self) -> int:
        """Position of the best one, ties apart."""
        among = np.flatnonzero(self.broken == self.broken.min())
        among = among[self.share[among] == self.share[among].min()]
        return int(among[np.argmin(self.difference[among])])

    def key(self, position: int) -> tuple[float, float, float]:
        """What counts before ties, to compare as tuples."""
        return (float(self.broken[position]), float(self.share[position]), float(self.difference[position]))


def allocate(problem: Problem, random: np.random.Generator, restarts: int) -> Indices:
    """Find the best allocation: (n,) positions of parts.

    Args:
        problem: what is allocated.
        random: draws the search's starts; not used where all allocations are tried.
        restarts: descents of the search.
    """
    if problem.parts**problem.subsets <= EXHAUSTIVE_STATES:
        return _try_all(problem)
    return _search(problem, random, restarts)


def _score(problem: Problem, sums: Floats, uncovered: Floats) -> Scores:
    """Score M allocations.

    Args:
        problem: what is allocated.
        sums: (M, P, 5) the facts summed over each part's subsets.
        uncovered: (M,) how many (site, direction, train or eval) lack a subset.
    """
    filled = sums[:, :, FILLED]
    available = problem.facts[:, FILLED].sum()
    empty = (filled[:, 0] == 0) | (filled[:, -1] == 0) if available > 1 else filled[:, 0] == 0
    broken = 1e6 * empty + 10.0 * uncovered
    if problem.parts > 2 and available > 2:
        broken = broken + (filled[:, 1] == 0)

    total = problem.facts[:, VEHICLES].sum()
    miss = np.abs(1000.0 * sums[:, :, VEHICLES] - problem.shares * total) - TOLERANCE * total
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
        share=np.maximum(miss, 0.0).sum(axis=1),
        difference=np.where(np.isnan(difference), np.inf, difference),
        eval_std=np.nan_to_num(std[:, -1]),
    )


def sum_facts(problem: Problem, part: Indices) -> Floats:
    """(M, P, 5) sums of the facts over the parts of M allocations (M, n)."""
    return np.stack([(part == p).astype(np.float64) @ problem.facts for p in range(problem.parts)], axis=1)


def _uncovered(problem: Problem, part: Indices) -> Floats:
    """(M,) how many (site, direction, train or eval) lack a subset in allocations (M, n)."""
    membership = np.eye(len(problem.paired))[problem.group][:, problem.paired]
    uncovered = np.zeros(len(part))
    for end in (0, problem.parts - 1):
        uncovered += ((part == end).astype(np.float64) @ membership == 0).sum(axis=1)
    return uncovered


def _try_all(problem: Problem) -> Indices:
    """The best of all allocations: (n,) parts."""
    codes = np.arange(problem.parts**problem.subsets)
    part = (codes[:, None] // problem.parts ** np.arange(problem.subsets)) % problem.parts
    best: Indices = part[_score(problem, sum_facts(problem, part), _uncovered(problem, part)).best()]
    return best


def _search(problem: Problem, random: np.random.Generator, restarts: int) -> Indices:
    """The best allocation that descents find: (n,) parts.

    `restarts` begin at random ones, and KICKS times as many near the best of those. The latter are short, so that many
    fit into the time; each goes on from the best that is known by then.
    """
    ends = np.stack([_descend(problem, _random_start(problem, random), random) for _ in range(max(1, restarts))])
    best = ends[_best_of(problem, ends)]
    for _ in range(KICKS * restarts):
        start = best.copy()
        moved = random.permutation(problem.subsets)[:KICKED]
        start[moved] = best[random.permutation(moved)]
        pair = np.stack([best, _descend(problem, start, random)])
        best = pair[_best_of(problem, pair)]
    found: Indices = best
    return found


def _best_of(problem: Problem, part: Indices) -> int:
    """Position of the best of allocations (M, n)."""
    return _score(problem, sum_facts(problem, part), _uncovered(problem, part)).best()


def _random_start(problem: Problem, random: np.random.Generator) -> Indices:
    """Subsets in random order, dealt out by their vehicles: eval first, then val, and the rest to train."""
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
    here = _score(problem, sum_facts(problem, part[None]), _uncovered(problem, part[None])).key(0)
    while True:
        flips = flip_to != part[flip_subset]
        swaps = np.flatnonzero(part[first] != part[second])
        if len(swaps) > MAX_SWAPS:
            swaps = random.choice(swaps, MAX_SWAPS, replace=False)
        # Every move as: subset i goes to `to`, and subset j (its swap; i itself in a flip) comes to i's part.
        i = np.concatenate([flip_subset[flips], first[swaps]])
        j = np.concatenate([flip_subset[flips], second[swaps]])
        to = np.concatenate([flip_to[flips], part[second[swaps]]])
        swapped = i != j

        gain = problem.facts[i] - np.where(swapped[:, None], problem.facts[j], 0.0)
        moves = np.arange(len(i))
        sums = np.repeat(sum_facts(problem, part[None]), len(i), axis=0)
        sums[moves, part[i]] -= gain
        sums[moves, to] += gain

        change = _coverage_change(problem, part)
        apart = swapped & (problem.group[i] != problem.group[j])
        uncovered = _uncovered(problem, part[None]) + np.where(
            apart, change[i, to] + change[j, part[i]], np.where(swapped, 0.0, change[i, to])
        )
        scores = _score(problem, sums, uncovered)
        move = scores.steepest()
        # The sums above are exact for whole numbers; flow's are not, hence the smallest improvement that counts.
        broken, share, difference = scores.key(move)
        if (broken, share, difference + TIE / 100) >= here:
            return part
        here = (broken, share, difference)
        part = part.copy()
        part[j[move]], part[i[move]] = part[i[move]], to[move]


def _coverage_change(problem: Problem, part: Indices) -> Floats:
    """(n, P): by how much `uncovered` changes when subset i goes to part q."""
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
