"""Expected findings of the rules about whole tracks, by slow, plain loops; see `expected_findings`."""

from collections.abc import Callable
from itertools import pairwise

from tracklake.pipeline.synthetic.scenery import Key, Scenery

FRAGMENT_M = 20.0
DUPLICATE_S = 0.5
SIZE_CHANGE_M = 0.1


def _breaks_track_fragment(scene: Scenery, key: Key) -> bool:
    begin, end = scene.section
    x = scene.entries[key].front
    begins_inside = scene.appears(key) and round(x - begin, 3) > FRAGMENT_M
    return begins_inside or (scene.vanishes(key) and round(end - x, 3) > FRAGMENT_M)


def _breaks_cross_section_flow(scene: Scenery, key: Key) -> bool:
    """Test whether an entry breaks cross_section_flow: its track crosses only one of the two cross sections around."""
    x = scene.entries[key].front
    start = scene.entries[key[0], scene.first_frames[key[0]]].front
    end = scene.entries[key[0], scene.last_frames[key[0]]].front
    for upstream, downstream in pairwise(scene.cross_sections):
        if upstream <= x < downstream:
            vanished = scene.vanishes(key) and start < upstream and round(downstream - x, 3) > 0
            appeared = scene.appears(key) and downstream <= end and round(x - upstream, 3) > 0
            return vanished or appeared
    return False


def _breaks_duplicate_track(scene: Scenery, key: Key) -> bool:
    others = scene.doubles.get(key, set())
    return any(scene.frames_together[key[0], other] / scene.surface.rate_hz >= DUPLICATE_S for other in others)


def _breaks_size_change(scene: Scenery, key: Key) -> bool:
    ranges = [scene.size_range(key[0], side) for side in (0, 1)]
    return any(size is not None and size > SIZE_CHANGE_M for size in ranges)


TRACKING_TESTS: dict[str, Callable[[Scenery, Key], bool]] = {
    "track_fragment": _breaks_track_fragment,
    "cross_section_flow": _breaks_cross_section_flow,
    "duplicate_track": _breaks_duplicate_track,
    "size_change": _breaks_size_change,
}
"""Functions that test whether an entry breaks a rule about tracks, by the rule's name."""
