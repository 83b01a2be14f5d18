"""The real excerpts through the command, where they are at hand (they are not part of the repository)."""

import json

import pytest
from lake_sources import EXCERPTS

pytestmark = [
    pytest.mark.usefixtures("plain_flows"),
    pytest.mark.skipif(not EXCERPTS.is_dir(), reason=f"the NGSIM excerpts are not at {EXCERPTS}"),
]


def test_peachtree_becomes_a_lake_and_says_what_was_left_out(command, tmp_path):
    done = command.here("run", EXCERPTS / "socrata_head_10000.csv", "--lake", tmp_path / "lake")
    assert done.code == 0, done.err
    assert "reconstruct, repair, traffic, samples, split and tensors were left out for peachtree-1245-north" in done.out
    assert "10,000 entries" in done.out
    query = "SELECT recording, direction, sum(entries) AS entries FROM subsets GROUP BY ALL ORDER BY ALL"
    rows = json.loads(command.here("sql", query, "--lake", tmp_path / "lake", "--format", "json").out)
    # Counted over the file with the csv module alone: Global_Time - 100 * Frame_ID and Direction of every row.
    assert [tuple(row.values()) for row in rows] == [
        ("peachtree-1245", "north", 7613),
        ("peachtree-1245", "south", 6),
        ("peachtree-1600", "north", 2320),
        ("peachtree-1600", "south", 61),
    ]
    assert "peachtree-1600-south" in (tmp_path / "lake" / "reports" / "index.html").read_text()


@pytest.mark.thorough
def test_all_excerpts_at_once(command, excerpts_lake):
    said = excerpts_lake.said
    # 1,005 + 1,999 + 10,000 + 38 + 155,604 rows, and 5,000 of the portal's once more in another dialect, which are
    # recognised as repetitions.
    assert said["headline"]["rows_read"] == 173_646
    assert said["headline"]["rows_read"] - said["headline"]["rows_dropped"] == said["headline"]["entries"]
    assert said["headline"]["rows_dropped"] == 5_000
    assert said["headline"]["recordings"] == 7
    query = """SELECT recording, measure, expected, found FROM completeness WHERE authority = 'published'
               AND recording IN ('us-101-0750', 'i-80-1600') ORDER BY ALL"""
    rows = json.loads(command.here("sql", query, "--lake", excerpts_lake.root, "--format", "json").out)
    # Counted over the files with the csv module alone; seven rows of two other vehicles of US-101 07:50 are the API's.
    assert [tuple(row.values()) for row in rows] == [
        ("i-80-1600", "entries", 1_262_678, 1_005),
        ("i-80-1600", "vehicles", 2_052, 1),
        ("us-101-0750", "entries", 1_180_598, 155_611),
        ("us-101-0750", "vehicles", 2_169, 292),
    ]
    about = [note for note in said["notes"] if note.startswith("us-101-0750") and "published" in note]
    assert about == [
        "us-101-0750: 155,611 of 1,180,598 published rows (13.1 %) and 292 of 2,169 vehicles: an excerpt, or incomplete"
    ]
    quality = json.loads((excerpts_lake.root / "reports/quality.json").read_text())
    assert quality["published"]["figures"] == [], "these are excerpts"
    reasons = {row["recording"]: row["reason"] for row in quality["published"]["left_out"]}
    assert reasons["us-101-0750"] == "the lake holds 292 of 2,169 vehicles and 155,611 of 1,180,598 rows"
    assert list(quality["provenance"]["data"]) == ["ngsim"]
    assert {row["origin"] for row in quality["subsets"]} == {"recorded"}
    assert "synthetic" not in said
    assert 'class="banner"' not in (excerpts_lake.root / "reports/index.html").read_text()
