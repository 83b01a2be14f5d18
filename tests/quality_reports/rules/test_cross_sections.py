"""Track ends and cross sections against the slow loops and numbers worked out by hand."""

import math

from hypothesis import given, settings
from hypothesis import strategies as st
from rule_scenes import driver, entries_found, scene_of

from tracklake.pipeline.synthetic.expected_findings import find_broken
from tracklake.pipeline.synthetic.scenery import Entry, Scenery, Surface
from tracklake.quality_reports.rules.cross_sections import balance_sections, find_track_ends
from tracklake.quality_reports.rules.derived import prepare
from tracklake.quality_reports.rules.evaluate import judge
from tracklake.quality_reports.rules.registry import RULES

ENDS = tuple(rule for rule in RULES if rule.name in ("track_fragment", "cross_section_flow"))
LARGEST = 2**31 - 1


@st.composite
def random_tracks(draw) -> tuple[dict, Surface]:
    """Tracks over a few hundred metres that begin and end anywhere, also on the ramp and at the recording's ends."""
    rate = draw(st.sampled_from([1.0, 25.0]))
    entries = {}
    for vehicle in draw(st.lists(st.sampled_from([1, 2, 5, 6, 90, LARGEST]), min_size=1, unique=True)):
        frames = draw(st.lists(st.integers(1, 120), min_size=1, max_size=3, unique=True))
        lane = draw(st.sampled_from([1, 1, 1, 2, 7]))
        for frame in frames:
            x = draw(st.sampled_from([0.0, 0.0, 20.0, 20.001, 119.5, 120.0, 120.5, 250.0, 380.0, 400.0, 400.0]))
            entries[vehicle, frame] = Entry(x, 4.0, 20.0, 0.0, 0, None, lane=lane)
    first = draw(st.sampled_from([None, 1, -30]))
    return entries, Surface(rate, lanes=draw(st.sampled_from([1, 2, 7])), first_frame=first)


@settings(max_examples=50, deadline=None)
@given(random_tracks())
def test_ends_and_cross_sections_are_those_of_the_slow_loop(drawn):
    entries, surface = drawn
    scene, slow = scene_of(entries, surface), Scenery(entries, surface)
    begin, end = find_track_ends(scene).section_m
    assert (begin, end) == slow.section or math.isnan(begin + end) == math.isnan(sum(slow.section))
    found = entries_found(judge(scene, rules=ENDS).findings)
    expected = {rule.name: dict(find_broken(entries, surface))[rule.name] for rule in ENDS}
    assert found == {rule: keys for rule, keys in expected.items() if keys}
    balance = balance_sections(scene)
    assert [row["x_m"] for row in balance] == [round(place, 3) for place in slow.cross_sections]
    missed = sum(row["vanished"] + row["appeared"] for row in balance[:-1])
    assert missed >= len(found.get("cross_section_flow", [])), "one that ends at a cross section misses it by 0 m"
    for row, place in zip(balance, slow.cross_sections, strict=True):
        tracks = [[entries[key].front for key in sorted(entries) if key[0] == vehicle] for vehicle in slow.first_frames]
        assert row["crossed"] == sum(xs[0] < place <= xs[-1] for xs in tracks)


def test_what_is_not_known_of_a_recording_leaves_its_ends_unjudged():
    entries = driver(1, range(11, 31), x=0.0) | driver(2, range(12, 20), x=5.0)
    scene = scene_of(entries, Surface(lanes=1, first_frame=1))
    assert prepare(scene, ["fragment_m"])["fragment_m"].drop_nulls().to_list() == [-0.5, 4.5, 0.0]
    arterial = scene_of(entries, Surface(lanes=0, first_frame=1))
    assert prepare(arterial, ["fragment_m", "missed_section_m"])[:, -2:].null_count().row(0) == (28, 28)
    assert balance_sections(arterial) == []
