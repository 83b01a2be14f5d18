"""Lakes on the stores of Google and Azure, against fakes of both: what is asked of them, and the answers."""

import pytest
from small_lake import make_status, put, write_round

from tracklake.pipeline.lake import load, open_for_writing
from tracklake.pipeline.lake.errors import AlreadyStoredError, MissingObjectError, SwapConflictError
from tracklake.pipeline.lake.object_store import ObjectStore, refuse_unconditional
from tracklake.pipeline.lake.publication import fetch_lake, publish_lake
from tracklake.pipeline.lake.transfers import send_commits
from tracklake.pipeline.lake.working_copy import hold_copy, locate_origin

ODD = ".files/tracks/dataset=a%2Fb/subset=ü x/part-1.parquet"


def test_an_object_is_created_once_and_replaced_by_its_tag_only(cloud):
    store = ObjectStore(cloud)
    refuse_unconditional(store)
    assert [*store.list()] == []
    first = store.put_new(ODD, b"1")
    with pytest.raises(AlreadyStoredError):
        store.put_new(ODD, b"2")
    second = store.swap(ODD, b"2", first)
    for stale in (first, None):
        with pytest.raises(SwapConflictError):
            store.swap(ODD, b"3", stale)
    assert store.get(ODD) == (b"2", second)
    store.delete([ODD])
    for call in (store.get, lambda path: store.download(path, path)):
        with pytest.raises(MissingObjectError):
            call(ODD)
    with pytest.raises(SwapConflictError):
        store.swap(ODD, b"3", second)


def test_objects_are_listed_in_pages_and_those_that_are_gone_are_no_error(cloud):
    store = ObjectStore(cloud)
    names = [f"a/{number}" for number in range(7)]
    for name in [*names, "ab"]:
        store.put_new(name, name.encode())
    assert sorted((item.path, item.bytes) for item in store.list("a")) == [(name, 3) for name in names]
    store.delete([names[6], "a/gone", *names[:5]])
    assert sorted(item.path for item in store.list()) == [names[5], "ab"]
    store.delete(["a/gone"])
    store.delete([])


def test_a_lake_is_published_added_to_and_fetched(cloud, tmp_path):
    write_round(tmp_path / "lake", 3)
    publish_lake(tmp_path / "lake", cloud)
    with hold_copy(locate_origin(cloud, tmp_path / "cache", 1.0)) as root, open_for_writing(root) as writer:
        made = put(root, "validate/highd/02", 6, make_status("02", 6), dataset="highd", subset="02")
        writer.commit(*send_commits(root, [made]))
    assert fetch_lake(cloud, tmp_path / "lake").files == 1
    assert sorted(load(tmp_path / "lake").commits) == ["validate/highd/01-lower", "validate/highd/01-upper", made.key]
    fetch_lake(cloud, tmp_path / "copy")
    assert load(tmp_path / "copy").commits == load(tmp_path / "lake").commits
