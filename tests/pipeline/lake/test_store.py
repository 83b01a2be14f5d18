"""The two kinds of stores: whole objects, conditional writes, and what an object store must not do or say."""

import threading
from pathlib import Path

import pytest
from object_stores import FORBIDDEN, HEEDLESS, KEY_ID, SECRET

from tracklake.pipeline.lake.errors import AlreadyStoredError, MissingObjectError, StoreError, SwapConflictError
from tracklake.pipeline.lake.object_store import ObjectStore, find_address, find_endpoint, refuse_unconditional
from tracklake.pipeline.lake.store import LocalStore, Store
from tracklake.schemas.errors import UsageError
from tracklake.schemas.files import name_unfinished

ODD = ".files/tracks/dataset=a%2Fb/subset=ü x/part-1.parquet"


@pytest.fixture(params=["folder", "bucket"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    if request.param == "folder":
        return LocalStore(tmp_path / "lake")
    return ObjectStore(request.getfixturevalue("bucket"))


def test_an_object_is_created_once_and_replaced_by_its_tag_only(store):
    first = store.put_new("manifest/a", b"1")
    with pytest.raises(AlreadyStoredError, match="manifest/a"):
        store.put_new("manifest/a", b"2")
    assert store.get("manifest/a") == (b"1", first)
    second = store.swap("manifest/a", b"2", first)
    assert second != first
    for stale in (first, None):
        with pytest.raises(SwapConflictError):
            store.swap("manifest/a", b"3", stale)
    assert store.get("manifest/a") == (b"2", second)
    store.delete(["manifest/a", "manifest/never"])
    with pytest.raises(MissingObjectError):
        store.get("manifest/a")
    with pytest.raises(SwapConflictError):
        store.swap("manifest/a", b"3", second)
    created = store.swap("manifest/a", b"3", None)
    assert store.get("manifest/a") == (b"3", created)


def test_files_go_there_and_come_back_under_odd_names(store, tmp_path):
    here, back = tmp_path / "here", tmp_path / "back"
    here.write_bytes(bytes(range(256)) * 40_000)  # more than one piece
    store.upload(ODD, here)
    store.put_new("manifest.json", b"{}")
    store.download(ODD, back)
    assert back.read_bytes() == here.read_bytes()
    sizes = {item.path: item.bytes for item in store.list()}
    assert sizes == {ODD: here.stat().st_size, "manifest.json": 2}
    (listed,) = store.list(".files/tracks")
    assert listed.path == ODD
    assert listed.modified.utcoffset().total_seconds() == 0
    assert [*store.list("nothing")] == []
    with pytest.raises(MissingObjectError):
        store.download("nothing", tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def test_a_folder_does_not_list_files_that_are_not_whole(tmp_path):
    name_unfinished(tmp_path / "a").write_bytes(b"half")
    LocalStore(tmp_path).put_new("a", b"whole")
    assert [item.path for item in LocalStore(tmp_path).list()] == ["a"]


def test_of_writers_at_once_each_adds_to_what_the_others_wrote(bucket):
    writers, rounds = 4, 5
    ObjectStore(bucket).put_new("count", b"0")

    def count() -> None:
        store = ObjectStore(bucket)
        done = 0
        while done < rounds:
            content, tag = store.get("count")
            try:
                store.swap("count", str(int(content) + 1).encode(), tag)
                done += 1
            except SwapConflictError:
                continue

    threads = [threading.Thread(target=count) for _ in range(writers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert ObjectStore(bucket).get("count")[0] == b"%d" % (writers * rounds)


def test_a_store_with_conditional_writes_is_taken_and_nothing_is_left_there(store):
    refuse_unconditional(store)
    assert [*store.list()] == []


@pytest.mark.usefixtures("bucket")
def test_a_store_that_ignores_conditions_is_refused(object_store_server):
    store = ObjectStore(object_store_server.make_bucket(HEEDLESS))
    with pytest.raises(StoreError, match=r"ignores the condition If-None-Match: \* .*could replace"):
        refuse_unconditional(store)
    assert [*store.list()] == []


def test_a_store_whose_tags_do_not_guard_is_refused(tmp_path):
    class Careless(LocalStore):
        def swap(self, path, data, _tag):
            return self._write(path, data)

    with pytest.raises(StoreError, match="ignores the condition If-Match "):
        refuse_unconditional(Careless(tmp_path))


@pytest.mark.usefixtures("bucket")
def test_a_refusal_repeats_no_credentials(object_store_server):
    store = ObjectStore(object_store_server.make_bucket(FORBIDDEN))
    with pytest.raises(StoreError, match=r"refused \(403 Forbidden, SignatureDoesNotMatch\)") as refused:
        store.put_new("a", b"1")
    causes = [refused.value, refused.value.__cause__]
    assert not any(secret in repr(each) for secret in (KEY_ID, SECRET) for each in causes)


@pytest.mark.usefixtures("bucket")
def test_a_missing_bucket_is_not_a_missing_object():
    with pytest.raises(StoreError, match="there is no such bucket") as missing:
        ObjectStore("s3://no-such-bucket/lake").get("manifest.json")
    assert not isinstance(missing.value, MissingObjectError)


@pytest.mark.parametrize(
    ("lake", "address"),
    [
        ("s3://bucket/lake", "s3://bucket/lake"),
        (Path("s3://bucket/a/b/"), "s3://bucket/a/b"),  # a Path keeps one slash only
        ("GS://bucket", "gs://bucket"),
        ("az://account/container/lake", "az://account/container/lake"),
        ("lake", None),
        ("/data/s3/lake", None),
        (Path("C:/lake"), None),
    ],
)
def test_addresses_are_told_from_folders(lake, address):
    assert find_address(lake) == address


@pytest.mark.parametrize(
    "lake",
    [
        f"s3://{KEY_ID}:password@bucket/lake",
        f"s3://bucket/{KEY_ID}:password@x",
        "s3://bucket/lake?X-Amz-Signature=password",
    ],
)
def test_an_address_with_credentials_is_refused_and_not_repeated(lake):
    with pytest.raises(UsageError, match="Credentials belong in the environment") as refused:
        find_address(lake)
    assert "password" not in str(refused.value)
    assert KEY_ID not in str(refused.value)


@pytest.mark.parametrize(
    "folder", ["a*b", "a[1]", "a%20b", "a%2Fb", "a\\b", "a//b", ".", "../b", "a/./b", "a/..", "a\nb"]
)
def test_a_folder_that_readers_take_in_different_ways_is_refused(folder):
    with pytest.raises(UsageError, match="not all readers would find it"):
        find_address(f"s3://bucket/{folder}")


@pytest.mark.parametrize("folder", ["a b", "ü+日本", "it's", "a.b/..c", "year=2026/a&b", "a/b/"])
def test_a_folder_with_unusual_letters_is_taken(folder):
    assert find_address(f"s3://bucket/{folder}") == f"s3://bucket/{folder}".rstrip("/")


@pytest.mark.parametrize("lake", ["http://host/lake", "ftp://host/lake", "s3://"])
def test_other_addresses_are_refused(lake):
    with pytest.raises(UsageError, match="s3://BUCKET/FOLDER"):
        find_address(lake)


@pytest.mark.parametrize(
    ("endpoint", "plain"),
    [("https://storage.example", False), ("http://localhost:9000", True), ("http://[::1]:9000", True), ("", False)],
)
def test_servers_are_reached_encrypted_or_on_this_machine(monkeypatch, bucket, endpoint, plain):
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    assert find_endpoint(bucket).is_plain == plain


@pytest.mark.parametrize(
    "endpoint",
    [
        f"{KEY_ID}:password@storage.example:9000",
        f"https://{KEY_ID}:password@storage.example",
        "http://storage.example/?token=password",
        f"{KEY_ID}:password",
        "http://[::password",
        "http://storage.example/password",
    ],
)
def test_a_server_whose_address_is_refused_is_not_repeated(monkeypatch, bucket, endpoint):
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    with pytest.raises(UsageError, match="AWS_ENDPOINT_URL: expected an address") as refused:
        find_endpoint(bucket)
    assert "password" not in str(refused.value)
    assert KEY_ID.lower() not in str(refused.value).lower()


@pytest.mark.parametrize("name", ["AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT", "AWS_endpoint"])
@pytest.mark.parametrize("endpoint", ["http://storage.example", "http://127.0.0.1.example", "storage.example"])
def test_a_server_elsewhere_without_encryption_is_refused(monkeypatch, bucket, name, endpoint):
    monkeypatch.setenv(name, endpoint)
    monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
    with pytest.raises(UsageError, match=f"{name}: expected an address that begins with https://"):
        ObjectStore(bucket)
