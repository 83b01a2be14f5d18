"""Expected findings of every rule of DESIGN section 5 in the written files, by a slow, plain loop.

The module shares no code with the pipeline, its sources or its rules, so that equal counts prove something.
"""

import math
from collections.abc import Callable, Iterator
from itertools import pairwise

from tracklake.pipeline.synthetic.expected_tracking import TRACKING_TESTS
from tracklake.pipeline.synthetic.scenery import Entry, Key, Scenery, Surface

HIGH_ACCELERATION_MPS2 = 3.05
HARD_DECELERATION_MPS2 = 8.0
ACCELERATION_BOUNDS = {"car": (5.0, 0.09, 2.0), "truck": (2.7, 0.06, 1.0), "motorcycle": (7.2, 0.1, 3.0)}
"""Acceleration at rest in m/s2, its fall per m/s, and the least bound in m/s2."""
LATERAL_ACCELERATION_MPS2 = 3.0
HEADING_ERROR_RAD = 0.1
HEADING_SPEED_MPS = 5.0
LOW_SPEED_MPS = 1.524
JUMP_M = 2.0
SPEED_DIFFERENCE_MPS = 1.0
HIGH_JERK_MPS3 = 15.0
FLICKER_S = 2.0
LEADER_WITHIN_M = 100.0
HEADWAY_DIFFERENCE_M = 1.0
NO_CHANGE_MPS2 = 0.00005
LONGEST_M = 40.0
"""No vehicle of the sample is longer."""
SIZES_M = {"car": (2.4, 8.0, 1.2, 2.7), "truck": (4.0, 26.0, 1.4, 3.2), "motorcycle": (1.0, 3.2, 0.3, 1.6)}
"""Least and greatest length, least and greatest width."""


def _breaks_acceleration_bound(scene: Scenery, key: Key) -> bool:
    entry = scene.entries[key]
    at_rest, fall, least = ACCELERATION_BOUNDS[entry.kind]
    return round(entry.accel - max(at_rest - fall * max(entry.speed, 0), least), 3) > 0


def _breaks_lateral_acceleration(scene: Scenery, key: Key) -> bool:
    now, before = scene.past_lateral_speed(key, 0), scene.past_lateral_speed(key, 1)
    if now is None or before is None:
        return False
    return round(abs(now - before) * 10, 3) > LATERAL_ACCELERATION_MPS2


def _breaks_heading_motion_mismatch(scene: Scenery, key: Key) -> bool:
    entry, aside = scene.entries[key], scene.lateral_speed(key)
    if not scene.surface.has_headings or aside is None or entry.speed < HEADING_SPEED_MPS:
        return False
    return round(abs(entry.heading - math.atan2(aside, entry.speed)), 4) > HEADING_ERROR_RAD


def _breaks_low_constant_speed(scene: Scenery, key: Key) -> bool:
    entry = scene.entries[key]
    return 0 < entry.speed <= LOW_SPEED_MPS and entry.accel == 0


def _breaks_position_jump(scene: Scenery, key: Key) -> bool:
    before, now = scene.near(key, -1), scene.entries[key]
    if before is None:
        return False
    way = (before.speed + now.speed) / 2 / scene.surface.rate_hz
    return round(abs(now.front - before.front - way), 6) > JUMP_M


def _breaks_overlap(scene: Scenery, key: Key) -> bool:
    """Test whether an entry breaks overlap: no side of a box parts the two; they meet by half a millimetre or more."""
    own, keys = scene.entries[key], scene.in_frame[key[1]]
    for step in (-1, 1):
        place = scene.frame_place[key] + step
        while 0 <= place < len(keys):
            other = scene.entries[keys[place]]
            if abs(other.front - own.front) > LONGEST_M:
                break
            is_near = math.dist(own.middle, other.middle) < own.radius + other.radius  # spares most of the comparisons
            if is_near and own.meets(other):
                return True
            place += step
    return False


def _breaks_speed_mismatch(scene: Scenery, key: Key) -> bool:
    """Test whether an entry breaks speed_mismatch: against the positions 0.1 s before and after."""
    steps = (1,) if scene.surface.rate_hz == 10 else (2, 3)
    if any(scene.near(key, step) is None for step in range(-steps[-1], steps[-1] + 1)):
        return False
    ahead = sum(scene.entries[key[0], key[1] + step].front for step in steps) / len(steps)
    behind = sum(scene.entries[key[0], key[1] - step].front for step in steps) / len(steps)
    return round(abs(scene.entries[key].speed - (ahead - behind) / 0.2), 4) > SPEED_DIFFERENCE_MPS


def _breaks_high_jerk(scene: Scenery, key: Key) -> bool:
    before = scene.past_accel(key, 1)
    return before is not None and round(abs(scene.entries[key].accel - before) / 0.1, 3) > HIGH_JERK_MPS3


def _breaks_jerk_flicker(scene: Scenery, key: Key) -> bool:
    """Test whether an entry breaks jerk_flicker: more than one change of sign among the jerks of the last second."""
    accels = [scene.past_accel(key, tenths) for tenths in range(10, -1, -1)]
    signs = []
    for before, now in pairwise(accels):
        if before is not None and now is not None and abs(now - before) > NO_CHANGE_MPS2:
            signs.append(now > before)
    return sum(before != now for before, now in pairwise(signs)) > 1


def _breaks_lane_flicker(scene: Scenery, key: Key) -> bool:
    """Test whether an entry breaks lane_flicker: the lanes before and after its stay are the same, and it is short."""
    if scene.lane_changes.get(key[0], 0) < 2:
        return False
    lane = scene.entries[key].lane
    around, stay = [], 1
    for direction in (-1, 1):
        step = direction
        while (other := scene.near(key, step)) is not None and other.lane == lane:
            step += direction
            stay += 1
        around.append(None if other is None else other.lane)
    return None not in around and around[0] == around[1] and stay / scene.surface.rate_hz <= FLICKER_S


def _breaks_leader_mismatch(scene: Scenery, key: Key) -> bool:
    """Test whether an entry breaks leader_mismatch, with positions in tenths of a millimetre."""
    own = scene.entries[key]
    place = round(own.front * 10000)
    ahead_of = scene.in_lane[key[1], own.lane][scene.lane_place[key] + 1 :]
    places = (round(scene.entries[other].front * 10000) for other in ahead_of)
    nearest = next((other - place for other in places if other > place), None)
    if own.leader == 0 or own.leader not in scene.lengths:
        return own.leader == 0 and nearest is not None and nearest / 10000 <= LEADER_WITHIN_M
    leader = scene.entries.get((own.leader, key[1]))
    if leader is None:
        return False
    ahead = round(leader.front * 10000) - place
    return leader.lane != own.lane or ahead < 0 or (nearest is not None and ahead > nearest)


def _breaks_headway_mismatch(scene: Scenery, key: Key) -> bool:
    gap, recorded = scene.gap(key), scene.recorded_gap(key)
    return gap is not None and recorded is not None and round(abs(recorded - gap), 3) > HEADWAY_DIFFERENCE_M


def _breaks_implausible_size(scene: Scenery, key: Key) -> bool:
    entry = scene.entries[key]
    shortest, longest, narrowest, widest = SIZES_M[entry.kind]
    inside = shortest <= round(entry.length, 4) <= longest and narrowest <= round(entry.width, 4) <= widest
    return not inside


def _breaks_outside_lane(scene: Scenery, key: Key) -> bool:
    """Test whether an entry breaks outside_lane, where markings are known."""
    entry, markings = scene.entries[key], scene.surface.markings
    if not 1 <= entry.lane < len(markings):
        return False
    left, right = markings[entry.lane - 1], markings[entry.lane]
    across = entry.middle[1]
    return round(left - across, 3) > 0 or round(across - right, 3) > 0


RULE_TESTS: dict[str, Callable[[Scenery, Key], bool]] = {
    "negative_headway": lambda scene, key: (scene.gap(key) or 0) < 0,
    "negative_headway_recorded": lambda scene, key: (scene.recorded_gap(key) or 0) < 0,
    "high_acceleration": lambda scene, key: scene.entries[key].accel > HIGH_ACCELERATION_MPS2,
    "hard_deceleration": lambda scene, key: scene.entries[key].accel < -HARD_DECELERATION_MPS2,
    "acceleration_bound": _breaks_acceleration_bound,
    "lateral_acceleration": _breaks_lateral_acceleration,
    "heading_motion_mismatch": _breaks_heading_motion_mismatch,
    "low_constant_speed": _breaks_low_constant_speed,
    "backward": lambda scene, key: scene.entries[key].speed < 0,
    "position_jump": _breaks_position_jump,
    # The frame before is missing, and there are earlier ones.
    "frame_gap": lambda scene, key: scene.near(key, -1) is None and scene.first_frames[key[0]] < key[1],
    "overlap": _breaks_overlap,
    "speed_mismatch": _breaks_speed_mismatch,
    "high_jerk": _breaks_high_jerk,
    "jerk_flicker": _breaks_jerk_flicker,
    "lane_flicker": _breaks_lane_flicker,
    "leader_mismatch": _breaks_leader_mismatch,
    "headway_mismatch": _breaks_headway_mismatch,
    "implausible_size": _breaks_implausible_size,
    "outside_lane": _breaks_outside_lane,
    **TRACKING_TESTS,
}
"""Functions that test whether an entry breaks a rule, by the rule's name."""


def find_broken(entries: dict[Key, Entry], surface: Surface) -> Iterator[tuple[str, list[Key]]]:
    """Find the entries of one subset that break each rule, sorted."""
    scene, ordered = Scenery(entries, surface), sorted(entries)
    for rule, breaks_rule in RULE_TESTS.items():
        yield rule, [key for key in ordered if breaks_rule(scene, key)]


def count_rules(entries: dict[Key, Entry], surface: Surface) -> dict[str, tuple[int, int, int]]:
    """Count the entries, vehicles and runs of consecutive frames of one subset that break each rule."""
    counts = {}
    for rule, keys in find_broken(entries, surface):
        runs = 0
        for i, (vehicle, frame) in enumerate(keys):
            if i == 0 or keys[i - 1] != (vehicle, frame - 1):
                runs += 1
        counts[rule] = (len(keys), len({vehicle for vehicle, _ in keys}), runs)
    return counts
