"""I-24 MOTION by hand: documents in blocks, frames, lanes, both directions, and lists that are damaged."""

import gzip
import json
from itertools import pairwise
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_texts import raw_file, write

from tracklake.pipeline.sources import i24_documents
from tracklake.pipeline.sources.i24 import I24, count_strips, detect, find_lanes
from tracklake.pipeline.sources.i24_frames import PERIOD_S, put_on_frames
from tracklake.pipeline.sources.source import Part, RawFile, SourceError
from tracklake.schemas import SUBSETS, TRACKS, VEHICLES

FILE = "637c399add50d54aa5af0cf4__post2.json"
START = 1_669_118_400.0
"""22 November 2022, 06:00 in Nashville, a period's beginning, in s since 1970."""
EAST, WEST = 60 * 5280, 62 * 5280


def document(*, first=0, frames=50, late=0.0, x=EAST, y=18.0, direction=1, feet=4.0, number=1, **values):
    """A trajectory that advances `feet` a frame from frame `first`, `late` frames late."""
    steps = range(frames)
    return {
        "_id": {"$oid": f"{number:024x}"},
        "timestamp": [START + (first + late + step) / 25 for step in steps],
        "x_position": [x + direction * feet * (step + late) for step in steps],
        "y_position": [y] * frames,
        "flags": ["Lost"],
        "length": 15.0,
        "width": [6.0, 7.0, 6.5],
        "height": 5.0,
        "merged_ids": [[{"$oid": "638bb843e38fd878abf4f6fe"}]],
        "coarse_vehicle_class": 0,
        "direction": direction,
    } | values


def read(folder, text, name=FILE):
    """{recording: Canonical} and Spilled of one file."""
    file = raw_file(write(folder / name, text if isinstance(text, bytes) else text.encode()), I24)
    spilled = I24.spill(file, folder / "spilled")
    made = {}
    for recording in spilled.recordings:
        rejects = spilled.rejects if len(spilled.recordings) == 1 else None
        rows = pl.scan_ipc(folder / "spilled" / recording / "*.arrow")
        made[recording] = I24.to_canonical([Part(file, rows, rejects, spilled.totals)], recording)
        for subset in made[recording].subsets:
            TRACKS.validate(subset.tracks, where=subset.name)
            VEHICLES.validate(subset.vehicles, where=subset.name)
            SUBSETS.validate(subset.facts, where=subset.name)
    return made, spilled


def read_blocks(text):
    """Documents of a list, by block."""
    with TemporaryDirectory() as folder:
        return list(i24_documents.read_documents(RawFile(write(f"{folder}/list.json", text.encode()), "list.json")))


def as_list(documents):
    lines = ",\n".join(map(json.dumps, documents))
    return f"[{lines}]\n"


def test_golden_numbers_of_both_carriageways(tmp_path):
    documents = [
        document(),
        document(x=EAST + 120, length=[30.0, 31.0, 29.0], coarse_vehicle_class=4, number=2),
        document(y=30.0, number=3),
        document(x=WEST, y=18.0, direction=-1, number=4),
    ]
    made, spilled = read(tmp_path, as_list(documents))
    assert spilled.rows_read == 4
    assert spilled.recordings == {"i-24-20221122-0600": 200}
    east, west = made["i-24-20221122-0600"].subsets
    assert (east.name, west.name) == ("i-24-20221122-0600-east", "i-24-20221122-0600-west")
    first = east.tracks.filter(frame=0)
    # Backs are 2 miles beyond mile post 58, 120 ft further, and as the first; fronts 15, 30 and 15 ft ahead of them.
    assert first["x_m"].to_list() == pytest.approx(
        [(10560 + 15) * 0.3048, (10560 + 150) * 0.3048, 10575 * 0.3048], abs=1e-3
    )
    # The first strip of 12 ft with traffic begins at 12 ft: lane 1.
    assert first["y_m"].to_list() == pytest.approx([6 * 0.3048, 6 * 0.3048, 18 * 0.3048], abs=1e-3)
    assert first["lane"].to_list() == [1, 1, 2]
    assert first["leader_id"].to_list() == [2, None, None]
    assert first["follower_id"].to_list() == [None, 1, None]
    # From front to front 135 ft, less the leader's 30 ft.
    assert first["gap_m"].to_list() == [pytest.approx(105 * 0.3048, abs=1e-3), None, None]
    assert east.tracks["speed_mps"].to_numpy() == pytest.approx(4 * 25 * 0.3048, abs=1e-3)
    assert east.tracks["accel_mps2"].null_count() == east.tracks.height
    assert east.vehicles["class"].to_list() == ["car", "truck", "car"]
    assert east.vehicles["length_m"].to_list() == pytest.approx([15 * 0.3048, 30 * 0.3048, 15 * 0.3048], rel=1e-6)
    assert east.vehicles["width_m"].to_list() == pytest.approx([6.5 * 0.3048] * 3, rel=1e-6)
    facts = east.facts.row(0, named=True)
    assert (facts["lanes"], facts["lane_markings_m"], facts["seconds"]) == (2, [0.0, 3.6576, 7.3152], 2.0)
    assert (facts["site"], facts["origin"], facts["direction"]) == ("i-24", "recorded", "east")
    # Westbound x falls, and x_m counts from mile post 64.
    assert west.tracks["x_m"][0] == pytest.approx((2 * 5280 + 15) * 0.3048, abs=1e-3)
    assert west.tracks["speed_mps"].to_numpy() == pytest.approx(4 * 25 * 0.3048, abs=1e-3)


def test_a_vehicle_on_the_road_at_a_periods_border_is_in_both_and_shares_its_source_id(tmp_path):
    step = [*range(20), *range(21, 51)]  # the speed at the border is that of the whole trajectory
    cut = document(first=PERIOD_S * 25 - 20, number=2, x_position=[EAST + 4.0 * place for place in step])
    made, spilled = read(tmp_path, as_list([document(), cut]))
    assert spilled.recordings == {"i-24-20221122-0600": 50 + 20, "i-24-20221122-0605": 30}
    later = made["i-24-20221122-0605"].subsets[0]
    assert later.vehicles.select("source_vehicle_id", "first_frame", "last_frame").rows() == [(2, 0, 29)]
    assert later.tracks["time_s"][0] == 0
    assert later.tracks["speed_mps"].head(2).to_list() == pytest.approx([6 * 25 * 0.3048, 4 * 25 * 0.3048], rel=1e-6)


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([0.0, 0.004, 0.25, 0.5, 0.8, 0.97, 0.996]),
            st.dictionaries(st.integers(0, 12), st.sampled_from([0.0, 0.03, 0.3]), min_size=2, max_size=13),
        ),
        min_size=1,
        max_size=4,
    )
)
def test_positions_on_frames_are_those_of_a_loop(tracks):
    """The true position at a frame between two successive times, also uneven; nothing over a gap or at the ends."""
    documents, expected = [], []
    for number, (late, steps) in enumerate(tracks, start=1):
        times = [step + late + steps[step] for step in sorted(steps)]
        documents.append(
            {"line": number, "timestamp": [START + time / 25 for time in times], "x_position": [7 * t for t in times]}
        )
        for frame in range(14):
            near = [time for time in times if abs(time - frame) <= 0.011]
            around = [(a, b) for a, b in pairwise(times) if a < frame < b and b - a < 1.4]
            if near or around:
                expected.append((number, frame, 7 * (near[0] if near else frame)))
    numbers = [each[0] for each in expected]
    expected = [each for each in expected if numbers.count(each[0]) > 1]
    lists = pl.DataFrame(documents).with_columns(
        y_position="x_position", direction=1.0, length=pl.lit([1.0]), width=pl.lit([1.0]), coarse_vehicle_class=0.0,
        _id=pl.struct(pl.lit("").alias("$oid")),
    )  # fmt: skip
    points, _, _ = put_on_frames(lists)
    assert points["period"].unique().to_list() in ([], [int(START / PERIOD_S)])
    assert points.select("vehicle", "frame").rows() == [each[:2] for each in expected]
    assert np.allclose(points["x_ft"].to_numpy(), [each[2] for each in expected], atol=1e-4)


@pytest.mark.parametrize(
    ("times", "frames", "unused"),
    [
        # Frame 2 lies between the second and the third position.
        ([0, 1, 2.02, 3], [0, 1, 2, 3], 0),
        # Frames 2 and 4 lie between two positions; of frame 1, 0.98 is nearer than 0.02.
        ([0.02, 0.98, 2.015, 2.985, 4.02, 5], [1, 2, 3, 4, 5], 1),
        # 0.2 ms apart: the second is taken.
        ([0, 1, 1.005, 2], [0, 1, 2], 1),
        # 10 Hz: every second position is on a frame.
        ([0, 2.5, 5, 7.5, 10], [0, 5, 10], 2),
        # The first and the last are ends of interpolations.
        ([0.5, 1.5, 2.5, 3.5], [1, 2, 3], 0),
        # 20 Hz.
        ([0, 1.25, 2.5, 3.75, 5], [0, 1, 2, 3, 4, 5], 0),
    ],
)
def test_no_position_that_is_off_the_frames_is_lost_unseen(tmp_path, times, frames, unused):
    text = as_list(
        [
            document(
                timestamp=[START + time / 25 for time in times],
                x_position=[EAST + 4 * time for time in times],
                y_position=[18.0] * len(times),
            )
        ]
    )
    made, spilled = read(tmp_path, text)
    tracks = made["i-24-20221122-0600"].subsets[0].tracks
    assert tracks["frame"].to_list() == frames
    ways = [(10_560 + 4 * frame + 15) * 0.3048 for frame in frames]
    assert tracks["x_m"].to_numpy() == pytest.approx(ways, abs=0.007)  # 0.005 frames are 0.02 ft
    noted = [note for note in spilled.notes if "not used" in note]
    assert [note.split(": ")[1] for note in noted] == [f"{unused} positions are not used"] * bool(unused)


@settings(max_examples=30)
@given(st.integers(1, 400), st.sampled_from(["[%s]", " [\n%s\n]\n", "\ufeff[%s]"]), st.booleans())
def test_documents_are_the_same_however_the_file_is_cut_into_blocks(size, shape, indented):
    made = [document(frames=3, number=number, x_score=float("nan")) for number in (1, 2, 3)]
    made[1]["_id"] = "some-text"
    text = shape % ",\n".join(json.dumps(each, indent=2 if indented else None) for each in made)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(i24_documents, "BLOCK_BYTES", max(size, 30))
        blocks = read_blocks(text)
    frame = pl.concat([block.frame for block in blocks])
    assert frame["line"].to_list() == [1, 2, 3]
    assert frame["timestamp"].to_list() == [each["timestamp"] for each in made]
    assert frame["length"].to_list() == [[15.0]] * 3
    assert frame["_id"].struct.field("$oid")[1] == "some-text"
    assert not any(block.rejects.height for block in blocks)


def test_broken_documents_are_rejected_with_their_number_and_spoil_no_other(tmp_path):
    texts = [json.dumps(document(number=number)) for number in range(1, 8)]
    texts[1] = texts[1].replace('"x_position": [', '"x_position": [["')
    texts[2] = texts[2][:300]
    broken = (
        document(direction=0),
        document(frames=1),
        document(y_position=[1.0]),
        document(timestamp=[None] * 50),
        document(timestamp=[START] * 50),
        document(x=10_000.0),
        {"_id": {"$oid": "x"}, "flags": []},
        document(late=0.5, timestamp=[START + 0.1 * step + 0.01 for step in range(50)]),
    )
    made, spilled = read(tmp_path, f"[{','.join([*texts, *map(json.dumps, broken), texts[0][:400]])}")
    assert spilled.rows_read == 16
    assert spilled.rejects["line"].to_list() == [2, 3, *range(8, 17)]
    reasons = spilled.rejects["reason"].to_list()
    assert reasons[0] == "no trajectory's document: not JSON, or a value of another type"
    assert reasons[1] == reasons[-1] == "cut short"
    assert reasons[2:8] == [
        "direction is neither 1 nor -1",
        "fewer than two times",
        "arrays of positions are not as long as that of times",
        "a time or position is no number",
        "times do not increase",
        "x_position beyond 300,960 to 343,200",
    ]
    assert reasons[9] == "fewer than two positions on frames"
    assert spilled.notes == (f"{FILE}: ends within document 16: probably TRUNCATED. Download the file again.",)
    (canonical,) = made.values()
    assert canonical.subsets[0].vehicles["source_vehicle_id"].to_list() == [1, 4, 5, 6, 7]
    (row,) = canonical.log.to_dicts()
    assert (row["rows_kept"], row["rows_dropped"], row["rows_read"]) == (250, 11, 261)


def test_a_compressed_list_is_read_and_one_that_is_cut_short_is_refused(tmp_path):
    packed = gzip.compress(as_list([document(number=number) for number in range(1, 60)]).encode())
    assert read(tmp_path / "whole", packed, f"{FILE}.gz")[1].rows_read == 59
    with pytest.raises(SourceError, match=r"the compressed file is damaged or cut short.*Download it again"):
        read(tmp_path / "cut", packed[:-400], f"{FILE}.gz")


def test_lists_are_recognised_by_their_beginning_and_other_json_is_not():
    text = as_list([document()]).encode()
    assert detect(text[:70], FILE) == "i24-json"
    assert detect(b"[" + text[1:].replace(b'"_id"', b'"first_timestamp": 1, "_id"', 1), FILE) == "i24-json"
    assert detect(b'{"timestamp": [1]}', FILE) is None
    assert detect(b'[{"metadata": {}}]', FILE) is None
    assert detect(b"", FILE) is None


def test_a_document_without_end_and_no_list_are_refused(monkeypatch):
    monkeypatch.setattr(i24_documents, "BLOCK_BYTES", 50)
    monkeypatch.setattr(i24_documents, "MAX_DOCUMENT_BYTES", 100)
    with pytest.raises(SourceError, match=r"list\.json: a document of more than 0 MiB"):
        read_blocks(as_list([document()]))
    with pytest.raises(SourceError, match=r"list\.json: no list of documents"):
        read_blocks("{}")


@pytest.mark.parametrize(
    ("places", "left", "lanes"),
    [([6, 18, 30], 0, 3), ([18, 30, 42, 54, 66], 12, 5), ([6] + [18] * 30 + [30] * 30, 12, 2), ([18, 42], 12, 1)],
)
@pytest.mark.parametrize("side", [1, -1])
def test_lanes_begin_with_the_first_strip_that_has_traffic(places, left, lanes, side):
    points = pl.DataFrame({"y_ft": [side * float(place) for place in places]}).with_columns(direction=1)
    assert find_lanes(count_strips(points)) == (side, left, lanes)


def test_all_recordings_of_a_file_have_the_same_lanes(tmp_path):
    """The strip at 18 ft has 10 of 300 entries in the first five minutes, and 110 of 600 in all."""
    later = PERIOD_S * 25
    documents = [document(frames=10, y=18.0)]
    documents += [document(frames=145, y=y) for y in (30.0, 42.0)]
    documents += [document(first=later, frames=100, y=y) for y in (18.0, 30.0, 42.0)]
    made, _ = read(tmp_path, as_list(documents))
    found = [canonical.subsets[0] for canonical in made.values()]
    assert [subset.facts["lanes"][0] for subset in found] == [3, 3]
    assert [sorted(subset.tracks["lane"].unique()) for subset in found] == [[1, 2, 3], [1, 2, 3]]
    assert [subset.tracks["y_m"].min() for subset in found] == pytest.approx([6 * 0.3048] * 2, abs=1e-3)


def test_a_document_with_its_keys_in_another_order_is_one_of_its_own(tmp_path):
    changed = document(number=2)
    changed = {"timestamp": changed.pop("timestamp"), **changed}
    made, spilled = read(tmp_path, as_list([document(), changed, document(number=3)]))
    assert (spilled.rows_read, spilled.rejects.height) == (3, 0)
    assert made["i-24-20221122-0600"].subsets[0].vehicles["source_vehicle_id"].to_list() == [1, 2, 3]
