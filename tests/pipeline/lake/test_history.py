"""Earlier generations: each can be queried until its files are deleted, and no longer."""

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import duckdb
import pytest
from small_lake import commit_round, make_status, put, write_round

import tracklake
from tracklake.pipeline.lake import LakeError, Manifest, Retention, connect, is_intact, load, open_for_writing
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.history import find_superseded, list_generations, load_as_of

QUESTION = "SELECT sum(backward_vehicles) FROM subset_status"
NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def set_time(root: Path, time: datetime) -> None:
    """Let the present generation have been written at a time."""
    path = root / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "written": time.isoformat()}))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five sessions, at noon and on the hours after; the sum of two subsets is twice the session's number."""
    root = tmp_path_factory.mktemp("made") / "lake"
    for number in range(5):
        write_round(root, number)
        set_time(root, NOON + timedelta(hours=number))
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made, tmp_path / "lake")


def ask(root: Path, as_of: str | None) -> int:
    with connect(root, as_of) as lake:
        ((found,),) = lake.sql(QUESTION).fetchall()
    return found


def test_the_last_generations_are_queried_by_number_and_time(made: Path):
    assert [(each.number, each.commits) for each in list_generations(made)] == [(3, 2), (4, 2), (5, 2)]
    assert [ask(made, str(number)) for number in (3, 4, 5)] == [4, 6, 8]
    assert ask(made, None) == 8
    times = ("2026-03-01T14:00:00Z", "2026-03-01T14:59:59+00:00", "2026-03-01 16:00:00+01:00", "2027-01-01")
    assert [ask(made, time) for time in times] == [4, 4, 6, 8]
    with tracklake.open(made, as_of="3") as lake:
        assert lake.sql(QUESTION).fetchone() == (4,)
        assert lake.table("subset_status").collect()["backward_vehicles"].to_list() == [2, 2]


@pytest.mark.parametrize("asked", ["0", "2", "6", "2026-03-01T13:59:59Z", "1999-12-31"])
def test_what_is_not_kept_is_answered_with_what_is(made: Path, asked: str):
    kept = ", ".join(f"{each.number} ({each.show_time()})" for each in list_generations(made))
    with pytest.raises(LakeError, match=f"nothing is kept of {asked}") as refused:
        load_as_of(made, asked)
    assert str(refused.value).endswith(f"by generation and time: {kept}.")
    with pytest.raises(LakeError, match="nothing is kept"):
        tracklake.open(made, as_of=asked)


@pytest.mark.parametrize("asked", ["", "yesterday", "3.5", "2026-13-01"])
def test_what_is_neither_a_number_nor_a_time_is_refused(made: Path, asked: str):
    with pytest.raises(LakeError, match="expected the number of a generation, or a time"):
        load_as_of(made, asked)


def test_files_of_every_generation_that_is_listed_are_there_and_others_are_not(made: Path):
    for each in list_generations(made):
        manifest = load_as_of(made, str(each.number))
        assert is_intact(made, (file for commit in manifest.commits.values() for file in commit.all_files))
    shards = {path.stem for path in (made / "manifest").glob("*.json")}
    roots = [made / "manifest.json", *(made / "manifest" / "roots").iterdir()]
    listed = [{shard["sha256"] for shard in json.loads(path.read_text())["shards"]} for path in roots]
    assert len(roots) == 3
    assert shards == set.union(*listed)


def test_what_changes_no_rows_leaves_a_generation_its_time(root: Path):
    with open_for_writing(root, retention=Retention(5)) as writer:
        writer.remember_origin("/elsewhere")
        writer.mark_damaged(["validate/highd/01-upper"])
    assert list_generations(root)[-1].written == NOON + timedelta(hours=4)
    assert ask(root, "2026-03-01T16:00:00Z") == 8


def test_a_rebuild_leaves_what_was_before_to_be_queried(root: Path):
    with open_for_writing(root, rebuild=True) as writer:
        assert ask(root, "5") == 8
        assert list_generations(root)[-1].commits == 0
        writer.commit(put(root, "validate/highd/01", 9, make_status("a", 9), dataset="highd", subset="a"))
    assert [(each.number, each.commits) for each in list_generations(root)] == [(4, 2), (5, 2), (6, 1)]
    assert [ask(root, str(number)) for number in (4, 5, 6)] == [6, 8, 9]
    assert load_as_of(root, "5").lake_id != load(root).lake_id


def test_a_lake_that_replaces_another_goes_on_with_its_numbers(root: Path):
    for _ in range(2):
        log = CommitLog(root)
        log.replace(Manifest(generation=1))
        assert log.replace(replace(log.manifest, sources={"0": {}}, generation=log.manifest.generation + 1)).sources
    assert [(each.number, each.commits) for each in list_generations(root)] == [(7, 0), (8, 0), (9, 0)]
    assert len({load_as_of(root, str(number)).lake_id for number in (7, 8, 9)}) == 2


def test_a_death_between_both_roots_leaves_each_generation_once(root: Path):
    kept = root / "manifest" / "roots" / "5.json"
    shutil.copy(root / "manifest.json", kept)
    assert [each.number for each in list_generations(root)] == [3, 4, 5]
    kept.write_text(kept.read_text().replace('"commits": 2', '"commits": 1'))  # and then went on with the session
    write_round(root, 5)
    assert [(each.number, each.commits) for each in list_generations(root)] == [(4, 2), (5, 2), (6, 2)]


@pytest.mark.parametrize("content", [b"", b"{}", b"[]", b'{"shards": [{}]}'])
def test_an_earlier_root_that_is_damaged_is_no_generation_and_is_to_be_swept(root: Path, content: bytes):
    (root / "manifest" / "roots" / "4.json").write_bytes(content)
    assert [each.number for each in list_generations(root)] == [3, 5]
    assert "manifest/roots/4.json" in find_superseded(root)


def test_a_lake_keeps_as_many_generations_as_it_is_told_to(tmp_path: Path):
    for number in range(6):
        with open_for_writing(tmp_path, retention=Retention(generations=4)) as writer:
            commit_round(writer, number)
    assert [each.number for each in list_generations(tmp_path)] == [2, 3, 4, 5, 6]
    assert [ask(tmp_path, str(number)) for number in range(2, 7)] == [2, 4, 6, 8, 10]
    write_round(tmp_path, 6)  # a session that says nothing
    assert [each.number for each in list_generations(tmp_path)] == [3, 4, 5, 6, 7]
    with open_for_writing(tmp_path, retention=Retention(generations=1)):
        pass
    assert [each.number for each in list_generations(tmp_path)] == [6, 7]
    assert {item.generation for item in load(tmp_path).retired} == {7}


def test_files_are_kept_for_as_many_hours_as_the_lake_is_told_to(tmp_path: Path):
    now = datetime.now(UTC)
    for number, hours in enumerate((9, 8, 3, 1, 0, 0)):
        with open_for_writing(tmp_path, retention=Retention(hours=4)) as writer:
            commit_round(writer, number)
        set_time(tmp_path, now - timedelta(hours=hours))
    # Generation 2, of 8 hours ago, was replaced 3 hours ago: 1 was replaced more than 4 hours ago.
    assert [each.number for each in list_generations(tmp_path)] == [2, 3, 4, 5, 6]
    assert [ask(tmp_path, str(number)) for number in range(2, 7)] == [2, 4, 6, 8, 10]
    assert {item.generation for item in load(tmp_path).retired} == {3, 4, 5, 6}
    assert not find_superseded(tmp_path)


def test_the_command_queries_what_info_lists(command, made: Path, tmp_path: Path):
    said = json.loads(command.here("info", "--lake", made, "--json").out)["generations"]
    assert [(each["number"], each["commits"]) for each in said] == [(3, 2), (4, 2), (5, 2)]
    for asked, expected in ((said[0]["written"], "4"), (said[1]["number"], "6")):
        done = command.here("sql", QUESTION, "--lake", made, "--as-of", asked, "--format", "csv")
        assert done.out.split()[1] == expected, done.err
    shown = command.here("info", "--lake", made).out
    assert list_generations(made)[0].show_time() in shown
    assert command.here("sql", "--lake", made, "--as-of", "3", "--out", tmp_path / "x.duckdb").code == 0
    with duckdb.connect(str(tmp_path / "x.duckdb"), read_only=True) as client:
        assert client.sql(QUESTION).fetchall() == [(4,)]
    refused = command.here("sql", QUESTION, "--lake", made, "--as-of", "7")
    assert (refused.code, refused.out) == (1, "")
    assert "nothing is kept of 7. What can be asked for, by generation and time: 3 (2026-03-01T" in refused.err
