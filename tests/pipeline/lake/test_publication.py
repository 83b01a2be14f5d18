"""A lake on an object store: published, read, fetched, and what is refused or kept on the way."""

from datetime import timedelta
from pathlib import Path

import pytest
from object_stores import HEEDLESS, KEY_ID, SECRET
from small_lake import check_lake, make_status, put, write_round

import tracklake
from tracklake.pipeline.lake import DamagedFileError, LakeError, LakeMissingError, load, open_for_writing, publication
from tracklake.pipeline.lake.errors import QueryError, StoreError
from tracklake.pipeline.lake.manifest import Retention
from tracklake.pipeline.lake.object_access import name_object
from tracklake.pipeline.lake.object_folder import MARKER, sweep_objects
from tracklake.pipeline.lake.object_store import ObjectStore
from tracklake.pipeline.lake.publication import fetch_lake, publish_lake

LAKE = "tracklake.pipeline.lake"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "lake"
    write_round(root, 1)
    return root


def test_a_published_lake_reads_the_same(folder, bucket):
    done = publish_lake(folder, bucket)
    live = [file for commit in load(folder).commits.values() for file in commit.all_files]
    assert (done.files, done.bytes) == (len(live), sum(file.bytes for file in live))
    with tracklake.open(folder) as here, tracklake.open(bucket) as there:
        for table in ("subset_status", "vehicle_starts", "subsets", "findings"):
            expected = here.table(table).collect()
            assert there.table(table).collect().equals(expected)
            assert there.sql(f"FROM {table} ORDER BY ALL").pl().equals(here.sql(f"FROM {table} ORDER BY ALL").pl())
        one = {"subset": "01-upper"}
        statement = "SELECT vehicle_id FROM vehicle_starts WHERE subset = $subset ORDER BY 1"
        assert there.sql(statement, one).fetchall() == here.sql(statement, one).fetchall()
        assert repr(there) == f"Lake({bucket!r})"
        with pytest.raises(LakeError, match=r"has no folder. `tracklake fetch"):
            there.tensors()


def commit_status(root: Path, key: str, number: int) -> None:
    """A writing session with one commit, under a key of its own."""
    with open_for_writing(root) as writer:
        writer.commit(put(root, f"validate/highd/{key}", number, make_status(key, number), dataset="highd", subset=key))


def read_status(lake: Path | str, as_of: str | None = None) -> list[tuple[str, int]]:
    """The subsets and what was found of them, by Polars, which takes a tenth of DuckDB's time for so little."""
    rows = tracklake.open(lake, as_of).table("subset_status").select("subset", "backward_vehicles")
    return sorted(rows.collect().rows())


def test_what_changed_alone_is_sent_and_readers_see_it_at_their_next_call(folder, bucket):
    publish_lake(folder, bucket)
    assert publish_lake(folder, bucket).files == 0
    with tracklake.open(bucket) as there:
        first = there.sql("FROM subset_status").pl()
        commit_status(folder, "02", 4)
        done = publish_lake(folder, bucket)
        assert (done.files, done.generation) == (1, 2)
        assert there.sql("FROM subset_status").pl().height == first.height + 1
    assert read_status(bucket, "1") == [("01-lower", 1), ("01-upper", 1)]


def test_a_recording_that_was_removed_is_removed_there(folder, bucket):
    publish_lake(folder, bucket)
    with open_for_writing(folder) as writer:
        writer.remove(["validate/highd/01-lower"])
    publish_lake(folder, bucket)
    assert [subset for subset, _ in read_status(bucket)] == ["01-upper"]


def test_a_fetched_lake_is_a_whole_one_and_follows(folder, bucket, tmp_path):
    publish_lake(folder, bucket)
    copy = tmp_path / "copy"
    done = fetch_lake(bucket, copy)
    assert done.files == sum(len(commit.all_files) for commit in load(folder).commits.values())
    check_lake(copy)
    assert load(copy).commits == load(folder).commits
    assert load(copy).lake_id == load(folder).lake_id
    write_round(folder, 2)
    publish_lake(folder, bucket)
    assert fetch_lake(bucket, copy).files > 0
    check_lake(copy)
    assert load(copy).commits == load(folder).commits
    before = (copy / "manifest.json").read_bytes()
    assert fetch_lake(bucket, copy).files == 0
    assert (copy / "manifest.json").read_bytes() == before


def test_two_folders_take_turns(folder, bucket, tmp_path):
    """A folder that lacks what another one published must fetch it first, and nothing is lost."""
    copy = tmp_path / "copy"
    publish_lake(folder, bucket)
    fetch_lake(bucket, copy)
    commit_status(copy, "03", 6)
    publish_lake(copy, bucket)
    commit_status(folder, "02", 4)
    for move in (lambda: publish_lake(folder, bucket), lambda: fetch_lake(bucket, folder)):
        with pytest.raises(LakeError, match="each has results that the other lacks"):
            move()
    assert [subset for subset, _ in read_status(bucket)] == ["01-lower", "01-upper", "03"]
    publish_lake(folder, bucket, replace_other=True)
    assert [subset for subset, _ in read_status(bucket)] == ["01-lower", "01-upper", "02"]
    fetch_lake(bucket, folder)
    assert read_status(folder) == read_status(bucket)


def interrupt(monkeypatch, action):
    """Let something happen between the upload of the files and the swap of the root."""
    upload = publication._upload

    def upload_and_act(*arguments):
        monkeypatch.setattr(publication, "_upload", upload)
        sent = upload(*arguments)
        action()
        return sent

    monkeypatch.setattr(publication, "_upload", upload_and_act)


def test_writers_at_once_that_change_different_things_both_count(folder, bucket, tmp_path, monkeypatch):
    copy = tmp_path / "copy"
    publish_lake(folder, bucket)
    fetch_lake(bucket, copy)
    commit_status(copy, "03", 6)
    commit_status(folder, "02", 4)
    interrupt(monkeypatch, lambda: publish_lake(copy, bucket))
    publish_lake(folder, bucket)
    assert [subset for subset, _ in read_status(bucket)] == ["01-lower", "01-upper", "02", "03"]
    with pytest.raises(LakeError, match="published from elsewhere"):  # the folder lacks 03, and must not remove it
        publish_lake(folder, bucket)


def test_of_writers_at_once_that_change_the_same_the_second_is_refused(folder, bucket, tmp_path, monkeypatch):
    copy = tmp_path / "copy"
    publish_lake(folder, bucket)
    fetch_lake(bucket, copy)
    commit_status(copy, "01-upper", 6)
    commit_status(folder, "01-upper", 4)
    interrupt(monkeypatch, lambda: publish_lake(copy, bucket))
    with pytest.raises(LakeError, match=r"another process has changed validate/highd/01-upper .* its version stays"):
        publish_lake(folder, bucket)
    assert dict(read_status(bucket))["01-upper"] == 6


def test_a_publication_that_breaks_off_changes_nothing_and_is_gone_on_with(folder, bucket, monkeypatch):
    publish_lake(folder, bucket)
    before = read_status(bucket)
    write_round(folder, 2)
    with monkeypatch.context() as broken:
        sent = []

        def fail(self, path, file):
            sent.append(path)
            if len(sent) > 2:
                raise StoreError("the cable was cut")
            return upload(self, path, file)

        upload = ObjectStore.upload
        broken.setattr(ObjectStore, "upload", fail)
        broken.setattr(f"{LAKE}.transfers.TRANSFERS", 1)
        with pytest.raises(StoreError, match="cable"):
            publish_lake(folder, bucket)
    assert read_status(bucket) == before
    live = sum(len(commit.all_files) for commit in load(folder).commits.values())
    assert publish_lake(folder, bucket).files == live - 2
    assert read_status(bucket) == read_status(folder)


def test_a_first_publication_that_breaks_off_is_gone_on_with(folder, bucket, monkeypatch):
    def fail(*_arguments):
        raise StoreError("the cable was cut")

    with monkeypatch.context() as broken:
        broken.setattr(publication.CommitLog, "replace", fail)
        with pytest.raises(StoreError, match="cable"):
            publish_lake(folder, bucket)
    with pytest.raises(LakeMissingError, match="no lake here"):
        tracklake.open(bucket)
    assert publish_lake(folder, bucket).files == 0
    assert read_status(bucket) == read_status(folder)


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("holiday.jpg", b"...", "holds other objects, such as holiday.jpg, and no lake"),
        ("manifest.json", b'{"schema_version": 2, "name": "an app"}', "not a manifest of tracklake"),
        ("manifest.json", b"[]", "not a manifest of tracklake"),
        (MARKER, b"0123", "holds another lake"),
    ],
)
def test_a_place_that_holds_something_else_is_refused(folder, bucket, path, content, message):
    ObjectStore(bucket).put_new(path, content)
    with pytest.raises(LakeError, match=message):
        publish_lake(folder, bucket)
    assert [item.path for item in ObjectStore(bucket).list()] == [path]


def test_another_lake_is_replaced_only_by_request(folder, bucket, tmp_path):
    other = tmp_path / "other"
    write_round(other, 5)
    publish_lake(other, bucket)
    with pytest.raises(LakeError, match=r"holds another lake .*--replace"):
        publish_lake(folder, bucket)
    with pytest.raises(LakeError, match="holds another lake than"):
        fetch_lake(bucket, folder)
    assert read_status(bucket) == read_status(other)
    publish_lake(folder, bucket, replace_other=True)
    assert read_status(bucket) == read_status(folder)


@pytest.mark.usefixtures("bucket")
def test_a_store_without_conditional_writes_is_refused_before_anything_is_sent(folder, object_store_server):
    heedless = object_store_server.make_bucket(HEEDLESS)
    with pytest.raises(StoreError, match="ignores the condition"):
        publish_lake(folder, heedless)
    assert [*ObjectStore(heedless).list()] == []


def test_a_damaged_file_is_not_published(folder, bucket):
    file = next(file for commit in load(folder).commits.values() for file in commit.files["subset_status"])
    (folder / file.path).write_bytes(bytes(file.bytes))
    with pytest.raises(DamagedFileError, match="damaged"):
        publish_lake(folder, bucket)
    with pytest.raises(LakeMissingError):
        load(bucket)


def test_a_damaged_object_is_noticed_when_it_is_fetched_and_queried(folder, bucket, tmp_path):
    publish_lake(folder, bucket)
    file = next(file for commit in load(folder).commits.values() for file in commit.files["subset_status"])
    store = ObjectStore(bucket)
    _, tag = store.get(name_object(file))
    store.swap(name_object(file), bytes(file.bytes), tag)
    with pytest.raises(DamagedFileError, match=r"damaged .*Publish the lake again"):
        fetch_lake(bucket, tmp_path / "copy")
    assert not (tmp_path / "copy" / file.path).exists()
    assert not (tmp_path / "copy" / "manifest.json").exists()
    with pytest.raises(LakeError), tracklake.open(bucket) as there:
        there.sql("FROM subset_status").pl()


def test_objects_are_kept_for_states_that_can_be_queried_and_for_a_day(bucket, tmp_path, monkeypatch):
    folder, store, objects = tmp_path / "lake", ObjectStore(bucket), {}
    for number in range(1, 6):
        commit_status(folder, "01-upper", number)
        publish_lake(folder, bucket)
        (objects[number],) = {name_object(file) for each in load(folder).commits.values() for file in each.all_files}
    assert {item.path for item in store.list()} >= {*objects.values()}
    monkeypatch.setattr(f"{LAKE}.object_folder.GRACE", timedelta(seconds=-5))
    store.put_new(".files/left/by/a/killed-process.0123456789abcdef.parquet", b"")
    others = ["v2/manifest.json", "v2/.files/a.0123456789abcdef.parquet", "notes/paper.txt", ".files/mine.txt"]
    for other in others:
        store.put_new(other, b"")
    assert sweep_objects(bucket) > 0
    held = {item.path for item in store.list(".files")}
    assert held == {objects[3], objects[4], objects[5], ".files/mine.txt"}
    assert {item.path for item in store.list()} >= {*others}
    assert read_status(bucket) == [("01-upper", 5)]
    assert read_status(bucket, "3") == [("01-upper", 3)]


def test_credentials_are_written_and_shown_nowhere(folder, bucket, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    publish_lake(folder, bucket)
    store = ObjectStore(bucket)
    for item in store.list():
        content, _ = store.get(item.path)
        assert KEY_ID.encode() not in content
        assert SECRET.encode() not in content
    for file in (file for file in folder.rglob("*") if file.is_file()):
        assert SECRET.encode() not in file.read_bytes(), file
    with tracklake.open(bucket) as there:
        settings = repr(there.sql("FROM duckdb_settings()").fetchall())
        settings += repr(there.sql("SELECT current_setting('s3_secret_access_key')").fetchall())
        assert KEY_ID not in settings
        assert SECRET not in settings
        assert there.sql("SELECT current_setting('enable_server_cert_verification')").fetchone() == (True,)
        with pytest.raises(QueryError, match="not available here"):
            there.sql("FROM duckdb_secrets()")
        with pytest.raises(QueryError, match="disabled by configuration"):
            there.sql(f"FROM read_parquet('{bucket}/manifest.json')").pl()
    assert not (tmp_path / "home").exists()  # no extension is downloaded, and no secret kept


def test_a_machine_s_role_is_used_where_the_environment_has_no_key(folder, bucket, role, monkeypatch):
    """Each of the three clients asks the role's server, as on a cloud's machine."""
    publish_lake(folder, bucket)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    for name, value in role.environment.items():
        monkeypatch.setenv(name, value)
    with tracklake.open(bucket) as there:
        assert there.sql("FROM subset_status").pl().height == there.table("subset_status").collect().height == 2
    assert len(role.asked) >= 3
    assert any("aws-sdk" in agent for agent in role.asked)


def test_what_is_published_during_a_fetch_is_not_taken_for_known(folder, bucket, tmp_path, monkeypatch):
    """Otherwise the next publication of the copy would remove it without a word."""
    copy, download = tmp_path / "copy", publication._download
    publish_lake(folder, bucket)

    def download_late(*arguments):
        received = download(*arguments)
        monkeypatch.setattr(publication, "_download", download)
        commit_status(folder, "03", 6)
        publish_lake(folder, bucket)
        return received

    monkeypatch.setattr(publication, "_download", download_late)
    fetch_lake(bucket, copy)
    commit_status(copy, "04", 7)
    with pytest.raises(LakeError, match="each has results that the other lacks"):
        publish_lake(copy, bucket)
    assert [subset for subset, _ in read_status(bucket)] == ["01-lower", "01-upper", "03"]


def test_what_is_committed_during_a_publication_is_not_taken_for_published(folder, bucket, tmp_path, monkeypatch):
    """Otherwise a fetch into the folder would remove it."""
    interrupt(monkeypatch, lambda: commit_status(folder, "03", 6))
    publish_lake(folder, bucket)
    copy = tmp_path / "copy"
    fetch_lake(bucket, copy)
    commit_status(copy, "04", 7)
    publish_lake(copy, bucket)
    with pytest.raises(LakeError, match="each has results that the other lacks"):
        fetch_lake(bucket, folder)
    assert [subset for subset, _ in read_status(folder)] == ["01-lower", "01-upper", "03"]


def test_a_lake_in_the_place_of_another_goes_on_with_its_generations(folder, bucket, tmp_path):
    """Numbers that were used would name two states."""
    for number in range(1, 4):
        commit_status(folder, "01-upper", number)
        last = publish_lake(folder, bucket).generation
    other = tmp_path / "other"
    commit_status(other, "05", 9)
    assert publish_lake(other, bucket, replace_other=True).generation == last + 1
    assert read_status(bucket) == [("05", 9)]


def test_a_rebuilt_lake_replaces_only_the_state_that_it_was_made_from(folder, bucket, tmp_path):
    publish_lake(folder, bucket)
    seen = publication.hash_root(bucket)
    commit_status(folder, "03", 6)
    publish_lake(folder, bucket)
    other = tmp_path / "other"
    commit_status(other, "05", 9)
    with pytest.raises(LakeError, match="another process has published meanwhile"):
        publish_lake(other, bucket, replace_other=True, expected=seen)
    assert "03" in [subset for subset, _ in read_status(bucket)]


def test_the_store_keeps_as_many_states_as_the_folder(bucket, tmp_path, monkeypatch):
    folder = tmp_path / "lake"
    monkeypatch.setattr(f"{LAKE}.object_folder.GRACE", timedelta(0))
    for number in range(1, 7):
        with open_for_writing(folder, retention=Retention(20, 0.0)) as writer:
            frame = make_status("01-upper", number)
            writer.commit(put(folder, "validate/highd/01", number, frame, dataset="highd", subset="01-upper"))
        publish_lake(folder, bucket)
    assert read_status(bucket, "1") == [("01-upper", 1)]


def test_an_old_object_that_no_state_needs_is_sent_again(folder, bucket, monkeypatch):
    """Another process may be about to delete it."""
    publish_lake(folder, bucket)
    with open_for_writing(folder) as writer:
        commit = load(folder).commits["validate/highd/01-upper"]
        writer.remove([commit.key])
    publish_lake(folder, bucket)
    with open_for_writing(folder) as writer:
        writer.commit(commit)
    monkeypatch.setattr(f"{LAKE}.object_folder.GRACE", timedelta(seconds=-10))
    monkeypatch.setattr(publication, "sweep_objects", lambda _address: 0)
    assert publish_lake(folder, bucket).files == len(commit.all_files)


def test_a_probe_that_a_killed_process_left_blocks_no_place(folder, bucket):
    ObjectStore(bucket).put_new(".probe-0123", b"")
    publish_lake(folder, bucket)
    assert read_status(bucket) == read_status(folder)


def test_nothing_is_written_to_a_place_of_others(folder, bucket, monkeypatch):
    """Not even to try whether the store honours conditions."""
    ObjectStore(bucket).put_new("paper.txt", b"")
    monkeypatch.setattr(ObjectStore, "put_new", None)
    with pytest.raises(LakeError, match=r"holds other objects, such as paper\.txt"):
        publish_lake(folder, bucket)
