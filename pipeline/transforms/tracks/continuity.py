"""Who moved on to where: entries that share an id, followed from frame to frame by position and speed.

Entries are joined in two steps. Within an id, entries of one frame are matched with those of its next frame: each goes
to the one nearest to where position and speed say it would be. What that leaves apart (where one of two was missing for
a while, or an id came back) are pieces, whose ends are then matched with later beginnings that they can have reached.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Booleans = npt.NDArray[np.bool_]

NEAR_M = 2.0
"""How far from where it was expected an entry may be in the next frame, where several vehicles share an id: less than
from lane to lane, since the next entry may be another vehicle's. What is further off is left to the second step."""

FASTEST_MPS = 60.0
SLACK_M = 20.0
"""What a vehicle may be off on top of that, and how far back it may be seen again: far more than positions err by."""

RANKS = 8
"""An entry is compared with those of the next frame up to so many places ahead or behind it along the road: with all
where nine vehicles or fewer share an id in a frame, and nobody passes more within one."""

DOUBT_MPS = 1.0
"""By how much a longer absence makes a continuation dearer, so that a track goes on where it is seen first."""

RETURNS = 64
"""Of each piece of a track, as many later ones are looked at as its continuation."""


@dataclass(frozen=True)
class Moves:
    """Entries that share ids, as arrays sorted by group, frame, then along the road.

    Args:
        group: whole numbers; entries of different groups are never one vehicle.
        frame: number of the frame.
        x_m: along the road.
        y_m: across it.
        speed_mps: along the road.
        announced: frames in which the vehicle says it appears; 0 = unknown.
        frame_rate_hz: frames per second.
        one_way: nobody drives against x_m, so that who is back further up the road is somebody else. On streets
            vehicles turn, out of the subset and into it again: there this holds only after an absence longer than
            announced.
    """

    group: Integers
    frame: Integers
    x_m: Floats
    y_m: Floats
    speed_mps: Floats
    announced: Integers
    frame_rate_hz: float
    one_way: bool

    def seconds(self, before: Integers, after: Integers) -> Floats:
        """Time between entries, given by their places."""
        return np.asarray((self.frame[after] - self.frame[before]) / self.frame_rate_hz, np.float64)

    def reachable(self, before: Integers, after: Integers) -> Booleans:
        """Whether a vehicle at one entry can be at the other later: not far back, not beyond all speed."""
        along = self.x_m[after] - self.x_m[before]
        far = np.hypot(along, self.y_m[after] - self.y_m[before])
        absent = self.frame[after] - self.frame[before] - 1
        announced = self.announced[before]
        may_return = np.full(len(before), not self.one_way) & ((announced == 0) | (absent <= announced))
        within = far <= FASTEST_MPS * self.seconds(before, after) + SLACK_M
        return np.asarray(within & ((along >= -SLACK_M) | may_return), np.bool_)

    def surprise_m(self, before: Integers, after: Integers) -> Floats:
        """Distance of entries from where earlier ones were heading."""
        along = self.x_m[after] - self.x_m[before]
        expected = self.speed_mps[before] * self.seconds(before, after)
        off = along - expected if self.one_way else np.abs(along) - np.abs(expected)
        return np.asarray(np.hypot(off, self.y_m[after] - self.y_m[before]), np.float64)


def follow(moves: Moves) -> Integers:
    """Number the tracks of entries that share ids.

    A group without two entries in any frame is one track, but where its vehicle cannot have got from before an absence
    to after it. (A jump from one frame to the very next is an error of the recording: the track goes on.)

    Returns:
        the track of each entry: a number per vehicle, each frame at most once in it. A track has one group.
    """
    size = len(moves.frame)
    if not size:
        return np.zeros(0, np.int64)
    predecessors = np.full(size, -1, np.int64)
    before, after, cost = _next_frames(moves)
    _link(predecessors, before, after, cost)
    before, after = _pieces(moves, predecessors)
    possible = moves.reachable(before, after)
    before, after = before[possible], after[possible]
    cost = moves.surprise_m(before, after) + DOUBT_MPS * moves.seconds(before, after)
    _link(predecessors, before, after, cost)
    return part_where_announced(moves, _roots(predecessors))


def part_where_announced(moves: Moves, track: Integers) -> Integers:
    """Part tracks with as many entries as several vehicles announced, at their longest absences.

    A track with 2.1 times the entries that its vehicle announces is two; one with 1.4 times is left as it is, and so is
    one that goes on without a gap for longer than announced: what it announces is wrong.
    """
    order = np.lexsort((moves.frame, track))
    track, frame = track[order], moves.frame[order]
    begins = np.flatnonzero(np.diff(track, prepend=-1))
    entries = np.diff(begins, append=len(track))
    number = np.repeat(np.arange(len(begins)), entries)
    announced = moves.announced[order][begins]
    vehicles = np.where(announced > 0, np.floor(entries / np.maximum(announced, 1) + 0.5), 1)
    step = np.diff(frame, prepend=0)
    step[begins] = 0
    gap = np.flatnonzero(step > 1)
    run_begins = np.flatnonzero(step != 1)
    longest = np.maximum.reduceat(np.diff(run_begins, append=len(track)), np.searchsorted(run_begins, begins))
    gaps = np.bincount(number[gap], minlength=len(begins))
    parted = (vehicles > 1) & (longest <= announced) & (gaps >= vehicles - 1)
    by_length = gap[np.lexsort((gap, -step[gap], number[gap]))]
    rank = np.arange(len(gap)) - (np.cumsum(gaps) - gaps)[number[by_length]]
    owner = number[by_length]
    cut = np.zeros(len(track), bool)
    cut[begins] = True
    cut[by_length[parted[owner] & (rank < vehicles[owner] - 1)]] = True
    numbered = np.empty(len(track), np.int64)
    numbered[order] = np.cumsum(cut) - 1
    return numbered


def _next_frames(moves: Moves) -> tuple[Integers, Integers, Floats]:
    """(before, after, cost) of entries in consecutive frames of a group that may be one vehicle."""
    size = len(moves.frame)
    new_group = np.diff(moves.group, prepend=moves.group[0] - 1) != 0
    new_set = new_group | (np.diff(moves.frame, prepend=moves.frame[0] - 1) != 0)
    number = np.cumsum(new_set) - 1
    first = np.flatnonzero(new_set)
    height = np.diff(first, append=size)
    group = np.cumsum(new_group) - 1
    crowded = np.bincount(group, weights=(height > 1)[number]) > 0
    # The set of entries after each: in the same group and its next frame, or none.
    following = np.minimum(number + 1, len(first) - 1)
    has_next = (number + 1 < len(first)) & (group[first[following]] == group)
    rank = np.arange(size) - first[number]
    low = np.maximum(rank - RANKS, 0)
    high = np.minimum(rank + RANKS + 1, height[following])
    before, after = _ranges(first[following] + low, np.where(has_next, np.maximum(high - low, 0), 0))
    cost = np.minimum(moves.surprise_m(before, after), NEAR_M)
    kept = ~_crossed(cost, (height[number] == 2)[before] & (height[following] == 2)[before])
    alone = ~crowded[group[before]]
    at_once = moves.frame[after] - moves.frame[before] == 1
    kept &= np.where(alone, at_once | moves.reachable(before, after), cost < NEAR_M)
    return before[kept], after[kept], cost[kept]


def _crossed(cost: Floats, of_two: Booleans) -> Booleans:
    """Of pairs between two entries and two: those of the way round that costs more in all."""
    crossed = np.zeros(len(cost), bool)
    four = cost[of_two].reshape(-1, 4)
    straight = four[:, 0] + four[:, 3] <= four[:, 1] + four[:, 2]
    dearer = np.where(straight[:, None], [False, True, True, False], [True, False, False, True])
    crossed[of_two] = dearer.ravel()
    return crossed


def _pieces(moves: Moves, predecessors: Integers) -> tuple[Integers, Integers]:
    """(end, beginning) of the pieces of tracks that may follow one another, as far as their frames go."""
    begins = np.flatnonzero(predecessors < 0)
    has_next = np.zeros(len(predecessors), bool)
    has_next[predecessors[predecessors >= 0]] = True
    ends = np.flatnonzero(~has_next)
    group = np.unique(moves.group, return_inverse=True)[1]
    # Group and frame in one sorted number.
    span = np.int64(2**32)
    keys = group[begins] * span + moves.frame[begins]
    later = np.searchsorted(keys, group[ends] * span + moves.frame[ends], side="right")
    last = np.searchsorted(keys, (group[ends] + 1) * span, side="left")
    owner, candidate = _ranges(later, np.minimum(last - later, RETURNS))
    return ends[owner], begins[candidate]


def _ranges(first: Integers, count: Integers) -> tuple[Integers, Integers]:
    """(owner, member) of ranges: owner i has first[i] ... first[i] + count[i] - 1."""
    owner = np.repeat(np.arange(len(count)), count)
    within = np.arange(len(owner)) - (np.cumsum(count) - count)[owner]
    return owner, first[owner] + within


def _link(predecessors: Integers, before: Integers, after: Integers, cost: Floats) -> None:
    """Match each entry with one later one at most, cheapest pairs first, and note it in predecessors.

    Each round takes every pair that is the cheapest of both its ends; what is left competes again. The rounds are as
    few as pairs compete in a chain, whatever the number of entries.
    """
    order = np.lexsort((after, before, cost))
    before, after = before[order], after[order]
    size = len(predecessors)
    while len(before):
        rank = np.arange(len(before))
        cheapest_before, cheapest_after = np.full(size, len(before)), np.full(size, len(before))
        np.minimum.at(cheapest_before, before, rank)
        np.minimum.at(cheapest_after, after, rank)
        taken = (cheapest_before[before] == rank) & (cheapest_after[after] == rank)
        predecessors[after[taken]] = before[taken]
        gone, reached = np.zeros(size, bool), np.zeros(size, bool)
        gone[before[taken]] = True
        reached[after[taken]] = True
        left = ~(gone[before] | reached[after])
        before, after = before[left], after[left]


def _roots(predecessors: Integers) -> Integers:
    """The first entry of each entry's track, by jumps that double."""
    roots = np.where(predecessors < 0, np.arange(len(predecessors)), predecessors)
    while not np.array_equal(further := roots[roots], roots):
        roots = further
    return roots
