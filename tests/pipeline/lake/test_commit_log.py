"""Commits as shards and a root: equal to a plain dict, flat in bytes, safe after a death, joined with others."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from math import log
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from manifests import read_unsharded, write_unsharded
from small_lake import make_status, put

from tracklake.pipeline.lake import Commit, LakeError, LakeFile, Manifest, connect, load, load_recent, open_for_writing
from tracklake.pipeline.lake.commit_log import CommitLog
from tracklake.pipeline.lake.errors import DamagedShardError, SwapConflictError
from tracklake.pipeline.lake.history import find_superseded, list_generations, load_as_of
from tracklake.pipeline.lake.manifest import read_root
from tracklake.pipeline.lake.shards import FAN_OUT, find_merge, parse_shards
from tracklake.pipeline.lake.store import LocalStore

KEYS = st.sampled_from([f"{stage}/highd/{number:02}" for stage in ("ingest", "validate") for number in range(6)])
STEPS = st.one_of(
    st.tuples(st.just("commit"), KEYS, st.integers(0, 3)),
    st.tuples(st.just("remove"), st.sets(KEYS, max_size=3)),
    st.tuples(st.just("damage"), st.sets(KEYS, max_size=3)),
    st.tuples(st.just("source"), st.integers(0, 4)),
    st.tuples(st.just("open")),  # the next coordinator
)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing synced: only contents are looked at."""
    monkeypatch.setattr(os, "fsync", lambda _descriptor: None)


def make_commit(key: str, number: int) -> Commit:
    files = [LakeFile(f".files/tracks/{key}/part-{number}.parquet", 1, 10 + number, f"{number:064x}")]
    return Commit(key, f"{number:016x}", {"tracks": files}, {"settings": {"n": number}}, {"notes": [key]})


def check_equal(manifest: Manifest, model: Manifest) -> None:
    """Equal but for the order of what is retired, which has no meaning."""
    assert {**asdict(manifest), "retired": None} == {**asdict(model), "retired": None}
    assert sorted(map(repr, manifest.retired)) == sorted(map(repr, model.retired))


@settings(max_examples=40, deadline=None)
@given(st.lists(STEPS, max_size=40))
def test_any_sequence_of_changes_is_read_back_as_a_plain_dict_has_it(steps):
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        log, manifest = CommitLog(root), Manifest()
        log.replace(manifest)
        commits: dict[str, tuple[str, int]] = {}  # the plain model: fingerprint and number by key
        for generation, (kind, *values) in enumerate(steps, start=1):
            if kind == "commit":
                key, number = values
                manifest = manifest.add_commit(make_commit(key, number), generation)
                commits[key] = (f"{number:016x}", number)
            elif kind == "remove":
                manifest = manifest.remove_commits(values[0], generation)
                commits = {key: held for key, held in commits.items() if key not in values[0]}
            elif kind == "damage":
                manifest = manifest.mark_damaged(values[0])
                commits |= {key: ("", commits[key][1]) for key in values[0] & commits.keys()}
            elif kind == "source":
                sources = {**manifest.sources, f"{values[0]:064x}": {"dataset": "highd"}}
                manifest = Manifest(**{**vars(manifest), "sources": sources})
            else:
                log = CommitLog(root)
                check_equal(log.manifest, manifest)
            assert log.replace(manifest) is manifest
            found = load(root)
            check_equal(found, manifest)
            made = {
                key: (commit.fingerprint, commit.files["tracks"][0].bytes - 10) for key, commit in found.commits.items()
            }
            assert made == commits
            items = sum(shard.items for shard in parse_shards(read_root(root)))
            live = len(found.commits) + len(found.sources) + len(found.retired)
            assert items <= 2 * live + FAN_OUT**2, "what was replaced is let go of"
        write_unsharded(root, read_unsharded(root))
        check_equal(load(root), manifest)


@pytest.mark.parametrize("commits", [120, 1_200, 12_000])
def test_merges_write_each_change_once_per_size_class_and_leave_few_shards(commits: int):
    sizes: list[int] = []
    written = longest = 0
    for _ in range(commits):
        start = find_merge([*sizes, 1])
        sizes[start:] = [sum(sizes[start:]) + 1]
        written, longest = written + sizes[-1], max(longest, len(sizes))
    classes = log(commits) / log(FAN_OUT) + 1
    assert sum(sizes) == commits
    assert sizes == sorted(sizes, reverse=True)
    assert written <= classes * commits
    assert longest < FAN_OUT * classes


def measure_commits(root: Path, recordings: int, monkeypatch: pytest.MonkeyPatch) -> float:
    """Mean bytes that a commit writes to a lake of so many recordings, of twelve commits each."""
    log, manifest = CommitLog(root), Manifest()
    first = {key: make_commit(key, 0) for key in (f"s{s}/highd/{n:05}" for n in range(recordings) for s in range(12))}
    log.replace(Manifest(**{**vars(manifest), "commits": first}))
    written = 0

    def count(real):
        def call(store, path, data, *tag):
            nonlocal written
            written += len(data)
            return real(store, path, data, *tag)

        return call

    with monkeypatch.context() as patched:
        for name in ("put_new", "swap"):
            patched.setattr(LocalStore, name, count(getattr(LocalStore, name)))
        for number in range(FAN_OUT**2):
            log.replace(log.manifest.add_commit(make_commit(f"new/highd/{number:05}", 1), 1))
    return written / FAN_OUT**2


def test_a_commit_writes_as_many_bytes_to_a_lake_of_a_thousand_recordings_as_to_one_of_ten(tmp_path, monkeypatch):
    few, many = (measure_commits(tmp_path / str(number), number, monkeypatch) for number in (10, 1_000))
    assert many < 1.1 * few
    assert many < 5_000


def find_shards(root: Path) -> set[str]:
    return {path.stem for path in (root / "manifest").glob("*.json")}


def test_a_death_between_shard_and_root_changes_nothing_and_the_shard_is_swept(tmp_path, monkeypatch):
    with open_for_writing(tmp_path) as writer:
        writer.commit(put(tmp_path, "validate/highd/01", 1, make_status("a", 1), dataset="highd", subset="a"))
    before, shards = (tmp_path / "manifest.json").read_bytes(), find_shards(tmp_path)

    def die(*_arguments):
        raise KeyboardInterrupt

    commit = put(tmp_path, "validate/highd/01", 2, make_status("a", 2), dataset="highd", subset="a")
    with monkeypatch.context() as patched:
        patched.setattr(LocalStore, "swap", die)
        with pytest.raises(KeyboardInterrupt), open_for_writing(tmp_path) as writer:
            writer.commit(commit)
    assert (tmp_path / "manifest.json").read_bytes() == before
    assert len(find_shards(tmp_path) - shards) == 1
    assert find_superseded(tmp_path)
    with connect(tmp_path) as lake:
        assert lake.sql("SELECT backward_vehicles FROM subset_status").fetchall() == [(1,)]
    with open_for_writing(tmp_path):
        pass
    assert find_shards(tmp_path) == shards


def test_a_shard_left_by_another_process_may_be_swept_after_its_content_is_committed(tmp_path):
    start = CommitLog(tmp_path).replace(Manifest())
    after = start.add_commit(make_commit("ingest/highd/01", 0), 1)
    CommitLog(tmp_path).replace(after)
    left = find_shards(tmp_path)
    (tmp_path / "manifest.json").unlink()  # as if it had been killed before the root
    CommitLog(tmp_path).replace(after)
    for name in left:
        (tmp_path / "manifest" / f"{name}.json").unlink()
    check_equal(load(tmp_path), after)


def test_what_two_processes_commit_of_different_recordings_is_joined(tmp_path):
    first = CommitLog(tmp_path)
    start = first.replace(Manifest().add_commit(make_commit("ingest/highd/01", 0), 1))
    second = CommitLog(tmp_path)
    first.replace(start.add_commit(make_commit("ingest/highd/02", 0), 2))
    ours = start.add_commit(make_commit("ingest/highd/03", 0), 2).add_commit(make_commit("ingest/highd/01", 1), 2)
    joined = second.replace(ours)
    check_equal(joined, load(tmp_path))
    assert {key: commit.fingerprint[-1] for key, commit in joined.commits.items()} == {
        "ingest/highd/01": "1",
        "ingest/highd/02": "0",
        "ingest/highd/03": "0",
    }
    assert [item.path for item in joined.retired] == [".files/tracks/ingest/highd/01/part-0.parquet"]
    third = first.replace(first.manifest.remove_commits({"ingest/highd/02"}, 5))
    assert third.commits.keys() == {"ingest/highd/01", "ingest/highd/03"}
    assert third.generation == 5


def test_each_of_two_states_that_are_joined_has_a_generation_that_can_be_queried(tmp_path):
    first = CommitLog(tmp_path)
    start = first.replace(Manifest().add_commit(make_commit("ingest/highd/01", 0), 1))
    second = CommitLog(tmp_path)
    first.replace(start.add_commit(make_commit("ingest/highd/02", 0), 2))
    joined = second.replace(start.remove_commits({"ingest/highd/01"}, 2))
    assert {item.generation for item in joined.retired} == {3}
    held = {each.number: load_as_of(tmp_path, str(each.number)).commits for each in list_generations(tmp_path)}
    assert {number: sorted(key[-2:] for key in commits) for number, commits in held.items()} == {
        1: ["01"],
        2: ["01", "02"],
        3: ["02"],
    }


def test_a_commit_whose_answer_was_lost_is_no_second_generation(tmp_path, monkeypatch):
    log, real = CommitLog(tmp_path), LocalStore.swap
    start = log.replace(Manifest())

    def swap(store, path, data, tag):
        real(store, path, data, tag)
        monkeypatch.setattr(LocalStore, "swap", real)
        raise SwapConflictError("as a repeated request is answered")

    for after in (start.add_commit(make_commit("ingest/highd/01", 0), 1), Manifest(generation=2)):
        monkeypatch.setattr(LocalStore, "swap", swap)
        assert log.replace(after) == after
        check_equal(load(tmp_path), after)


def test_a_lake_is_not_replaced_by_another_with_what_a_process_commits_meanwhile(tmp_path):
    first = CommitLog(tmp_path)
    start = first.replace(Manifest())
    second = CommitLog(tmp_path)
    first.replace(start.add_commit(make_commit("ingest/highd/01", 0), 1))
    with pytest.raises(LakeError, match="has changed the lake that was to be replaced; its version stays"):
        second.replace(Manifest().add_commit(make_commit("ingest/highd/02", 0), 1))
    assert load(tmp_path).lake_id == start.lake_id
    assert [*load(tmp_path).commits] == ["ingest/highd/01"]


def test_of_two_processes_that_change_the_same_the_later_one_fails_and_the_earlier_one_stays(tmp_path):
    first = CommitLog(tmp_path)
    start = first.replace(Manifest())
    second = CommitLog(tmp_path)
    first.replace(start.add_commit(make_commit("ingest/highd/01", 0), 1))
    with pytest.raises(LakeError, match=r"another process has changed ingest/highd/01 \(commits\).*Run again"):
        second.replace(start.add_commit(make_commit("ingest/highd/01", 1), 1))
    assert load(tmp_path).commits["ingest/highd/01"].fingerprint[-1] == "0"
    same = CommitLog(tmp_path)
    same.replace(same.manifest.add_commit(make_commit("ingest/highd/02", 0), 1))
    kept = first.replace(first.manifest.add_commit(make_commit("ingest/highd/02", 0), 1))  # the same by chance
    assert len(kept.commits) == 2


def test_a_lake_that_another_process_rebuilt_is_left_to_it(tmp_path):
    log = CommitLog(tmp_path)
    start = log.replace(Manifest())
    rebuilt = CommitLog(tmp_path, is_rebuild=True).replace(Manifest())
    with pytest.raises(LakeError, match="another process has made or rebuilt this lake"):
        log.replace(start.add_commit(make_commit("ingest/highd/01", 0), 1))
    assert load(tmp_path).lake_id == rebuilt.lake_id


def test_a_lake_of_the_earlier_layout_is_read_and_migrated_by_the_next_session(tmp_path):
    with open_for_writing(tmp_path) as writer:
        for subset in ("a", "b"):
            writer.commit(put(tmp_path, subset, 1, make_status(subset, 1), dataset="highd", subset=subset))
    plain, manifest = read_unsharded(tmp_path), load(tmp_path)
    write_unsharded(tmp_path, plain)
    assert not (tmp_path / "manifest").exists()
    check_equal(load(tmp_path), manifest)
    with connect(tmp_path) as lake:
        assert lake.sql("SELECT count(*) FROM subset_status").fetchall() == [(2,)]
    with open_for_writing(tmp_path):
        pass
    check_equal(load(tmp_path), manifest)
    assert json.loads((tmp_path / "manifest.json").read_text()).keys() == {*plain, "written", "commits", "shards"} - {
        "entries",
        "sources",
        "retired",
    }
    assert len(find_shards(tmp_path)) == 1


def spoil(root: Path) -> Iterator[str]:
    (shard, *_) = (root / "manifest").glob("*.json")
    whole = shard.read_bytes()
    shard.unlink()
    yield "there is no such file"
    shard.write_bytes(whole.replace(b"highd", b"HIGHD"))
    yield "its bytes are not those that were written"
    shard.write_bytes(b"")
    yield "its bytes are not those that were written"


def test_a_shard_that_is_missing_or_damaged_is_named_with_the_way_out(tmp_path):
    with open_for_writing(tmp_path) as writer:
        writer.commit(put(tmp_path, "a", 1, make_status("a", 1), dataset="highd", subset="a"))
        writer.remember_origin(str(tmp_path))
    for reason in spoil(tmp_path):
        for use in (load, connect, lambda root: open_for_writing(root).__enter__()):
            with pytest.raises(DamagedShardError, match=f"{reason}.*`tracklake run {tmp_path} --lake .* --rebuild`"):
                use(tmp_path)
    with open_for_writing(tmp_path, rebuild=True) as writer:
        writer.commit(put(tmp_path, "a", 2, make_status("a", 2), dataset="highd", subset="a"))
    assert load(tmp_path).commits["a"].fingerprint == f"{2:016x}"
    assert not find_superseded(tmp_path)


@pytest.mark.parametrize("shards", ["x", 7, [1], [{}], [{"sha256": "../../x", "bytes": 1, "items": 1}]])
def test_a_root_that_is_none_of_ours_is_named(tmp_path, shards):
    CommitLog(tmp_path).replace(Manifest())
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "shards": shards}))
    with pytest.raises(LakeError, match=r"manifest\.json: not a manifest of tracklake"):
        load(tmp_path)


def test_a_reader_whose_shards_were_swept_reads_the_root_again(tmp_path, monkeypatch):
    CommitLog(tmp_path).replace(Manifest().add_commit(make_commit("ingest/highd/01", 0), 1))
    real, old = LocalStore.get, (tmp_path / "manifest.json").read_bytes()
    CommitLog(tmp_path, is_rebuild=True).replace(Manifest())
    shutil.rmtree(tmp_path / "manifest")
    new, reads = (tmp_path / "manifest.json").read_bytes(), []
    (tmp_path / "manifest.json").write_bytes(old)

    def get(store, path):
        reads.append(path)
        try:
            return real(store, path)
        finally:
            (tmp_path / "manifest.json").write_bytes(new)  # a commit between the reader's two steps

    monkeypatch.setattr(LocalStore, "get", get)
    assert load(tmp_path).commits == {}
    assert [path for path in reads if path != "manifest.json"], "a shard of the old root was asked for"


def test_the_recent_manifest_is_that_of_the_root_and_of_this_lake(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    CommitLog(one).replace(Manifest().add_commit(make_commit("ingest/highd/01", 0), 1))
    CommitLog(other).replace(Manifest().add_commit(make_commit("ingest/highd/02", 0), 1))
    for place in (one, other, one):
        assert load_recent(place) == load(place)
    assert load_recent(one) is load_recent(one)
    CommitLog(one).replace(load(one).add_commit(make_commit("ingest/highd/03", 0), 1))
    assert load_recent(one) == load(one)
