"""Bags that are damaged, cut short or made to harm are refused in bounded time and memory, or accounted for in full."""

import bz2
import sqlite3
import struct
from pathlib import Path

import pytest
from drive_bags import list_files, write_small_bag
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tracklake.pipeline.sources.source import RawFile, SourceError
from tracklake.pipeline.sources.v2v import bag_records
from tracklake.pipeline.sources.v2v.bag_records import list_bag_files, unpack_data
from tracklake.pipeline.sources.v2v.bags import read_bag

FORMATS = {"a.bag": {}, "b.bag": {"compressed": True}, "c": {}, "d": {"storage": "mcap", "compressed": True}}
"""Names of whole bags, and how they are written."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Bytes of the file with messages of a small bag in each format."""
    folder = tmp_path_factory.mktemp("whole")
    found = {}
    for name, options in FORMATS.items():
        path = write_small_bag(folder / name, 1 if name.endswith("bag") else 2, **options)
        file = next(each for each in list_files(path) if each.path.suffix != ".yaml")
        found[file.name] = file.path.read_bytes()
    return found


@pytest.mark.parametrize("name", ["a.bag", "b.bag", "c.db3", "d.mcap"])
@settings(max_examples=40, deadline=5000, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_or_missing_bytes_are_refused_or_accounted_for(
    tmp_path: Path, whole: dict[str, bytes], name: str, data: st.DataObject
) -> None:
    content = bytearray(whole[name])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(16, len(content)))]
    path = tmp_path / name
    path.write_bytes(content)
    try:
        bag = read_bag([RawFile(path, name)])
        scans = list(bag.scans)
    except SourceError:
        return
    assert len(scans) == len(bag.scans)
    assert bag.rejects.height <= bag.rows_read[0] <= 100
    assert bag.rejects["line"].is_between(1, max(bag.rows_read[0], 1)).all()


@pytest.mark.parametrize(("name", "advice"), [("a.bag", "rosbag reindex"), ("d.mcap", "mcap recover"), ("c.db3", "")])
def test_a_bag_cut_in_half_is_refused_with_advice(
    tmp_path: Path, whole: dict[str, bytes], name: str, advice: str
) -> None:
    path = tmp_path / name
    path.write_bytes(whole[name][: len(whole[name]) // 2])
    with pytest.raises(SourceError, match=rf"{name}: damaged or cut short.*Expected a whole ROS bag.*{advice}"):
        read_bag([RawFile(path, name)])


def test_a_bag_without_index_is_refused(tmp_path: Path, whole: dict[str, bytes]) -> None:
    """A recorder that was killed leaves the place of the index at 0."""
    path = tmp_path / "a.bag"
    content = bytearray(whole["a.bag"])
    at = content.index(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = bytes(8)
    path.write_bytes(content)
    with pytest.raises(SourceError, match=r"not indexed.*rosbag reindex a\.bag"):
        read_bag([RawFile(path, "a.bag")])


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    for content in (b"", b"plain text", b"SQLite format 3\0" + bytes(200), b"\x28\xb5\x2f\xfd" + bytes(50)):
        path = tmp_path / "a.db3"
        path.write_bytes(content)
        with pytest.raises(SourceError, match=r"a\.db3: "):
            read_bag([RawFile(path, "a.db3")])


def test_a_chunk_that_unpacks_to_gigabytes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_records, "MAX_CHUNK_BYTES", 1000)
    packed = bz2.compress(bytes(100_000))
    assert unpack_data(bz2.compress(b"ab"), 1000) == b"ab"
    with pytest.raises(ValueError, match="more than 1,000 bytes"):
        unpack_data(packed, 1000)


def test_a_file_may_not_unpack_to_many_times_its_size(
    tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bag_records, "MIN_BUDGET_BYTES", 0)
    monkeypatch.setattr(bag_records, "MAX_GROWTH", 0.01)
    for name, content in whole.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(SourceError, match="times its size"):
            read_bag([RawFile(path, name)])


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE VIEW schema AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT 1 FROM n) SELECT * FROM n",
        "ALTER TABLE messages ADD COLUMN huge BLOB AS (zeroblob(1000000000))",
    ],
)  # fmt: skip
def test_a_database_that_computes_its_rows_is_refused(tmp_path: Path, whole: dict[str, bytes], statement: str) -> None:
    path = tmp_path / "c.db3"
    path.write_bytes(whole["c.db3"])
    database = sqlite3.connect(path)
    database.execute("DROP TABLE schema")
    database.execute(statement)
    database.commit()
    database.close()
    with pytest.raises(SourceError, match="is computed, which no recorder makes"):
        read_bag([RawFile(path, "c.db3")])


def test_an_array_of_gigabytes_in_a_message_is_rejected(tmp_path: Path, whole: dict[str, bytes]) -> None:
    """The length of the data of a cloud is declared as 4 GiB."""
    content = whole["a.bag"]
    length = struct.pack("<I", 66)  # three points of 22 bytes
    at = content.index(length + struct.pack("<f", 10.0))
    path = tmp_path / "a.bag"
    path.write_bytes(content[:at] + b"\xff\xff\xff\xff" + content[at + 4 :])
    bag = read_bag([RawFile(path, "a.bag")])
    assert (len(bag.scans), len(list(bag.scans)), bag.rows_read) == (1, 1, (17,))
    assert bag.rejects["reason"].str.starts_with("no sensor_msgs/msg/PointCloud2: ").to_list() == [True]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("  relative_file_paths:\n    - a_0.db3\n    - a_1.db3\n  duration:\n", ["a_0.db3", "a_1.db3"]),
        ("  relative_file_paths: [a_0.db3, 'a_1.db3']\n", ["a_0.db3", "a_1.db3"]),
        ("  relative_file_paths:\n  - bag/a_0.db3\n", ["a_0.db3"]),
        ("  relative_file_paths:\n  - ../a_0.db3\n", "lists '../a_0.db3', outside its folder"),
        ("  relative_file_paths:\n  - /etc/passwd\n", "lists '/etc/passwd', outside its folder"),
        ("  relative_file_paths:\n  - gone.db3\n", "lists 'gone.db3', which is not beside it"),
        ("a: &a [x, x]\nb: &b [*a, *a]\n", "lists no files with messages"),
        ("  relative_file_paths: []\n", "lists no files with messages"),
    ],
)
def test_metadata_lists_files_of_its_own_folder_alone(tmp_path: Path, text: str, expected: list[str] | str) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    for name in ("a_0.db3", "a_1.db3"):
        (folder / name).touch()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n" + text)
    metadata = RawFile(folder / "metadata.yaml", "bag/metadata.yaml")
    if isinstance(expected, list):
        assert list_bag_files(metadata) == expected
        return
    with pytest.raises(SourceError, match="bag/metadata.yaml: " + expected.replace(".", r"\.")):
        list_bag_files(metadata)
