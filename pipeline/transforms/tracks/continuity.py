"""Continuity of tracks: entries that share an id, linked from frame to frame by position and speed.

Entries are linked in two steps. Within an id, entries of one frame are matched with those of its next frame: each with
the one nearest to its predicted position. The remaining pieces (one of two vehicles was missing for a while, or an id
came back) are then linked: ends of pieces are matched with later beginnings that they can have reached.
"""

from dataclasses import dataclass

import numpy as np

from tracklake.schemas.arrays import Flags, Floats, Integers, expand_ranges, find_run_starts

NEAR_M = 2.0
"""Largest distance of an entry from its predicted position in the next frame if several vehicles share an id, in m:
less than a lane's width, since it may be another vehicle. Entries farther away are left to the second step."""
FASTEST_MPS = 60.0
"""Highest speed at which a vehicle may have moved while it was not seen, in m/s."""
SLACK_M = 20.0
"""Tolerance of reachable positions, and of positions farther back, in m: far more than positions err by."""
RANKS = 8
"""Entries of the next frame ahead of and behind an entry that it is compared with: all of them if up to nine vehicles
share an id in a frame, and more than any vehicle overtakes within one frame."""
DOUBT_MPS = 1.0
"""Cost of each second of absence in m, so that a track continues at its first reappearance."""
RETURNS = 64
"""Later pieces that are tested as the continuation of a piece."""


@dataclass(frozen=True)
class Moves:
    """Entries that share ids, as arrays sorted by group, frame, then along the road.

    Args:
        group: number of the group; entries of different groups are never one vehicle.
        announced: number of frames that the vehicle announces; 0 = unknown.
        one_way: whether no vehicle drives against x_m, so that an entry farther back is another vehicle's. On streets
            vehicles leave the subset and come back: there this holds only after an absence longer than announced.
    """

    group: Integers
    frame: Integers
    x_m: Floats
    y_m: Floats
    speed_mps: Floats
    announced: Integers
    frame_rate_hz: float
    one_way: bool

    def measure_seconds(self, before: Integers, after: Integers) -> Floats:
        """Measure the time between entries, given by their rows."""
        return np.asarray((self.frame[after] - self.frame[before]) / self.frame_rate_hz, np.float64)

    def are_reachable(self, before: Integers, after: Integers) -> Flags:
        """Test whether a vehicle at one entry can reach the other: not far back, not faster than FASTEST_MPS."""
        along = self.x_m[after] - self.x_m[before]
        far = np.hypot(along, self.y_m[after] - self.y_m[before])
        absent = self.frame[after] - self.frame[before] - 1
        announced = self.announced[before]
        may_return = np.full(len(before), not self.one_way) & ((announced == 0) | (absent <= announced))
        within = far <= FASTEST_MPS * self.measure_seconds(before, after) + SLACK_M
        return np.asarray(within & ((along >= -SLACK_M) | may_return), np.bool_)

    def measure_errors_m(self, before: Integers, after: Integers) -> Floats:
        """Measure the distance of entries from the positions that earlier ones predict."""
        along = self.x_m[after] - self.x_m[before]
        expected = self.speed_mps[before] * self.measure_seconds(before, after)
        off = along - expected if self.one_way else np.abs(along) - np.abs(expected)
        return np.asarray(np.hypot(off, self.y_m[after] - self.y_m[before]), np.float64)


def link_tracks(moves: Moves) -> Integers:
    """Number the tracks of entries that share ids; a track lies in one group and has each frame at most once.

    A group without two entries in any frame is one track, unless its vehicle cannot have moved so far during an
    absence. (A jump from one frame to the next is an error of the recording: the track continues.)
    """
    size = len(moves.frame)
    if not size:
        return np.zeros(0, np.int64)
    predecessors = np.full(size, -1, np.int64)
    before, after, cost = _pair_next_frames(moves)
    _link_pairs(predecessors, before, after, cost)
    before, after = _pair_pieces(moves, predecessors)
    possible = moves.are_reachable(before, after)
    before, after = before[possible], after[possible]
    cost = moves.measure_errors_m(before, after) + DOUBT_MPS * moves.measure_seconds(before, after)
    _link_pairs(predecessors, before, after, cost)
    return split_long_tracks(moves, _find_roots(predecessors))


def split_long_tracks(moves: Moves, track: Integers) -> Integers:
    """Split tracks that have the entries of several announced vehicles, at their longest absences.

    A track with 2.1 times the announced entries is two vehicles; one with 1.4 times is left as it is, and so is one
    with a run without gaps longer than announced, since its announcement is wrong.
    """
    order = np.lexsort((moves.frame, track))
    track, frame = track[order], moves.frame[order]
    begins = find_run_starts(track)
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
    divided = (vehicles > 1) & (longest <= announced) & (gaps >= vehicles - 1)
    by_length = gap[np.lexsort((gap, -step[gap], number[gap]))]
    rank = np.arange(len(gap)) - (np.cumsum(gaps) - gaps)[number[by_length]]
    owner = number[by_length]
    cut = np.zeros(len(track), bool)
    cut[begins] = True
    cut[by_length[divided[owner] & (rank < vehicles[owner] - 1)]] = True
    numbered = np.empty(len(track), np.int64)
    numbered[order] = np.cumsum(cut) - 1
    return numbered


def _pair_next_frames(moves: Moves) -> tuple[Integers, Integers, Floats]:
    """Pair entries in consecutive frames of a group that may be one vehicle: before, after, cost."""
    size = len(moves.frame)
    new_group = np.diff(moves.group, prepend=moves.group[0] - 1) != 0
    new_set = new_group | (np.diff(moves.frame, prepend=moves.frame[0] - 1) != 0)
    number = np.cumsum(new_set) - 1
    first = np.flatnonzero(new_set)
    height = np.diff(first, append=size)
    group = np.cumsum(new_group) - 1
    crowded = np.bincount(group, weights=(height > 1)[number]) > 0
    # The set of entries that follows each: those of the group's next frame, or none.
    following = np.minimum(number + 1, len(first) - 1)
    has_next = (number + 1 < len(first)) & (group[first[following]] == group)
    rank = np.arange(size) - first[number]
    low = np.maximum(rank - RANKS, 0)
    high = np.minimum(rank + RANKS + 1, height[following])
    after, before = expand_ranges(first[following] + low, np.where(has_next, np.maximum(high - low, 0), 0))
    cost = np.minimum(moves.measure_errors_m(before, after), NEAR_M)
    kept = ~_find_crossed(cost, (height[number] == 2)[before] & (height[following] == 2)[before])
    alone = ~crowded[group[before]]
    adjacent = moves.frame[after] - moves.frame[before] == 1
    kept &= np.where(alone, adjacent | moves.are_reachable(before, after), cost < NEAR_M)
    return before[kept], after[kept], cost[kept]


def _find_crossed(cost: Floats, of_two: Flags) -> Flags:
    """Find, among the four pairs of two entries with two, the assignment that costs more in total."""
    crossed = np.zeros(len(cost), bool)
    four = cost[of_two].reshape(-1, 4)
    straight = four[:, 0] + four[:, 3] <= four[:, 1] + four[:, 2]
    dearer = np.where(straight[:, None], [False, True, True, False], [True, False, False, True])
    crossed[of_two] = dearer.ravel()
    return crossed


def _pair_pieces(moves: Moves, predecessors: Integers) -> tuple[Integers, Integers]:
    """Pair ends of pieces of tracks with beginnings of later pieces."""
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
    candidate, owner = expand_ranges(later, np.minimum(last - later, RETURNS))
    return ends[owner], begins[candidate]


def _link_pairs(predecessors: Integers, before: Integers, after: Integers, cost: Floats) -> None:
    """Match each entry with at most one later entry, cheapest pairs first, and write it into predecessors.

    Each round matches every pair that is the cheapest of both its entries; the others compete again. The number of
    rounds depends on chains of competing pairs, not on the number of entries.
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
        has_successor, has_predecessor = np.zeros(size, bool), np.zeros(size, bool)
        has_successor[before[taken]] = True
        has_predecessor[after[taken]] = True
        left = ~(has_successor[before] | has_predecessor[after])
        before, after = before[left], after[left]


def _find_roots(predecessors: Integers) -> Integers:
    """Find the first entry of each entry's track, by pointer doubling."""
    roots = np.where(predecessors < 0, np.arange(len(predecessors)), predecessors)
    while not np.array_equal(further := roots[roots], roots):
        roots = further
    return roots
