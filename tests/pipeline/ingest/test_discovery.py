"""What a folder holds: recognised, refused with a next step, or skipped and named."""

import gzip
import hashlib
import json
import os

import pytest
from highd_files import write_recording
from raw_texts import TEXT_NAMES, as_csv, as_text, ngsim_row, write

from tracklake.pipeline.ingest.discovery import Digests, discover
from tracklake.pipeline.ingest.removal import Folder
from tracklake.pipeline.sources import RawFile, SourceError

ROWS = [ngsim_row(5, frame) for frame in range(1, 4)]


def sha256(file):
    return hashlib.sha256(file.path.read_bytes()).hexdigest()


def find(source, dataset=None):
    return discover(source, dataset=dataset, digest=sha256)


def names(discovery):
    return [(source.name, [file.name for file in unit.files]) for source, unit in discovery.units]


def test_a_folder_of_mixed_datasets(tmp_path):
    write_recording(tmp_path / "highd" / "data")
    write(tmp_path / "ngsim" / "export.csv", as_csv(ROWS, bom=True, end="\r\n"))
    write(tmp_path / "ngsim" / "trajectories-0750am-0805am.txt", as_text(ROWS))
    write(tmp_path / "ngsim" / "no-ending", as_csv(ROWS[:2], TEXT_NAMES, header=()))
    write(tmp_path / "ngsim" / "packed.CSV.GZ", gzip.compress(as_csv(ROWS[:1])))
    write(tmp_path / "README.txt", b"Some words about the data.\n")
    write(tmp_path / "map.png", b"\x89PNG")
    discovery = find(tmp_path)
    assert names(discovery) == [
        ("highd", [f"highd/data/01_{kind}.csv" for kind in ("recordingMeta", "tracksMeta", "tracks")]),
        ("ngsim", ["ngsim/export.csv"]),
        ("ngsim", ["ngsim/no-ending"]),
        ("ngsim", ["ngsim/packed.CSV.GZ"]),
        ("ngsim", ["ngsim/trajectories-0750am-0805am.txt"]),
    ]
    assert not discovery.refusals
    assert sorted(discovery.skipped) == ["README.txt", "map.png"]
    only = find(tmp_path / "highd", dataset="highd")
    assert [name for name, _ in names(only)] == ["highd"]


def test_one_file(tmp_path):
    path = write(tmp_path / "export.csv", as_csv(ROWS))
    assert names(find(path)) == [("ngsim", ["export.csv"])]


def test_an_unknown_table_is_refused_and_the_others_go_through(tmp_path):
    write(tmp_path / "a" / "results.csv", b"\xef\xbb\xbfdate,value\r\n2020,1\r\n")
    write(tmp_path / "b.csv", as_csv(ROWS))
    discovery = find(tmp_path)
    assert names(discovery) == [("ngsim", ["b.csv"])]
    (refusal,) = discovery.refusals
    assert refusal.startswith("a/results.csv, line 1: not a known trajectory file. Expected ")
    assert "Got 'date,value'." in refusal
    assert refusal.endswith("Move the file out of the folder, or restore its header.")


@pytest.mark.parametrize("data", [b"", b"\n\n", b"  \r\n"])
def test_an_empty_file_is_refused(tmp_path, data):
    (refusal,) = find(write(tmp_path / "export.csv", data)).refusals
    assert refusal.startswith("export.csv: empty file. Expected ")
    assert refusal.endswith("Download it again.")


def test_a_binary_file_called_csv_is_refused_in_one_short_line(tmp_path):
    (refusal,) = find(write(tmp_path / "export.csv", bytes(range(256)) * 300)).refusals
    assert refusal.startswith("export.csv, line 1: not a known")
    assert len(refusal) < 1200
    assert "\n" not in refusal


def test_prose_alone_is_no_recording(tmp_path):
    write(tmp_path / "notes.txt", b"Some words.\n")
    with pytest.raises(SourceError, match=r"no raw recordings in it\. Expected .* Got notes\.txt\. Give the folder"):
        find(tmp_path)
    # Given as the source itself, it was meant to be data.
    (refusal,) = find(tmp_path / "notes.txt").refusals
    assert refusal.startswith("notes.txt, line 1: not a known trajectory file")


def test_an_empty_folder_and_no_folder(tmp_path):
    with pytest.raises(SourceError, match="Got an empty folder"):
        find(tmp_path)
    with pytest.raises(SourceError, match=r"nowhere: no such file or folder\. Give the folder"):
        find(tmp_path / "nowhere")


def test_hidden_files_and_folders_are_skipped_but_a_hidden_source_is_not(tmp_path):
    source = tmp_path / ".cache" / "data"
    write(source / ".git" / "x.csv", as_csv(ROWS))
    write(source / ".hidden.csv", as_csv(ROWS))
    write(source / "seen" / "x.csv", as_csv(ROWS))
    assert names(find(source)) == [("ngsim", ["seen/x.csv"])]


def test_the_same_bytes_twice_are_named(tmp_path):
    write(tmp_path / "a.csv", as_csv(ROWS))
    write(tmp_path / "b.csv", as_csv(ROWS))
    discovery = find(tmp_path)
    assert names(discovery) == [("ngsim", ["a.csv"])]
    assert discovery.refusals == ("b.csv: the same bytes as a.csv, which was read; remove one of the two.",)


def test_a_highd_recording_without_its_meta_file_leaves_the_others_alone(tmp_path):
    write_recording(tmp_path)
    write_recording(tmp_path, number="02")[0].unlink()
    discovery = find(tmp_path)
    assert [unit.recording for _, unit in discovery.units] == ["01"]
    assert "02_recordingMeta.csv missing beside" in discovery.refusals[0]


def test_a_damaged_archive_is_refused_by_name_and_the_others_go_through(tmp_path):
    write(tmp_path / "sub" / "cut.csv.gz", gzip.compress(as_csv(ROWS))[:8])
    write(tmp_path / "good.csv", as_csv(ROWS))
    discovery = find(tmp_path)
    assert names(discovery) == [("ngsim", ["good.csv"])]
    (refusal,) = discovery.refusals
    assert refusal.startswith("sub/cut.csv.gz: the compressed file is damaged or cut short")
    assert refusal.endswith("Download it again.")


def test_a_file_that_may_not_be_read_is_refused(tmp_path, monkeypatch):
    write(tmp_path / "a.csv", as_csv(ROWS))
    write(tmp_path / "b.csv", as_csv(ROWS[:2]))

    def deny(file):
        if file.name == "a.csv":
            raise PermissionError(13, "Permission denied", str(file.path))
        return as_csv(ROWS)

    monkeypatch.setattr("tracklake.pipeline.ingest.discovery.read_head", deny)
    discovery = find(tmp_path)
    assert names(discovery) == [("ngsim", ["b.csv"])]
    assert discovery.refusals[0].startswith("a.csv: cannot be read (Permission denied)")


def test_digests_are_remembered_until_the_file_changes(tmp_path):
    path = write(tmp_path / "a.csv", b"one")
    digests = Digests(tmp_path)
    file = RawFile(path, "a.csv")
    first = digests(file)
    assert first == hashlib.sha256(b"one").hexdigest()
    digests.save()
    stat = path.stat()
    path.write_bytes(b"two")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    # Same size and time: not read again.
    assert Digests(tmp_path)(file) == first
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    assert Digests(tmp_path)(file) == hashlib.sha256(b"two").hexdigest()


@pytest.mark.parametrize("cut", [0, 1, 2, "hash"])
def test_a_hash_that_is_cut_short_is_computed_again(tmp_path, cut):
    path = write(tmp_path / "a.csv", b"one")
    stat = path.stat()
    whole = [stat.st_size, stat.st_mtime_ns, "0" * 64]
    damaged = [*whole[:2], 7] if cut == "hash" else whole[:cut]
    write(tmp_path / ".hashes.json", json.dumps({str(path.resolve()): damaged}).encode())
    assert Digests(tmp_path)(RawFile(path, "a.csv")) == hashlib.sha256(b"one").hexdigest()


@pytest.mark.parametrize(
    "remembered", [b"", b"\xff\xfe", b"[]", b"{", b"[" * 100_000, json.dumps({"x": 1, "/y": [1]}).encode()]
)
def test_a_damaged_memory_of_digests_is_forgotten(tmp_path, remembered):
    write(tmp_path / ".hashes.json", remembered)
    path = write(tmp_path / "a.csv", b"one")
    assert Digests(tmp_path)(RawFile(path, "a.csv")) == hashlib.sha256(b"one").hexdigest()


@pytest.fixture
def closed(tmp_path, monkeypatch):
    """A folder that no user, not even root, may list, and in which nothing can be looked at."""
    write(tmp_path / "closed" / "b.csv", as_csv(ROWS[:2]))
    real_scan, real_lstat = os.scandir, os.lstat

    def deny(call):
        def call_or_deny(path, *rest, **options):
            if str(path).startswith(str(tmp_path / "closed")):
                raise PermissionError(13, "Permission denied", str(path))
            return call(path, *rest, **options)

        return call_or_deny

    monkeypatch.setattr(os, "scandir", deny(real_scan))
    monkeypatch.setattr(os, "lstat", deny(real_lstat))
    return tmp_path / "closed"


def test_a_folder_that_cannot_be_read_is_refused_and_the_others_go_through(tmp_path, closed):
    write(tmp_path / "a.csv", as_csv(ROWS))
    discovery = find(tmp_path)
    assert names(discovery) == [("ngsim", ["a.csv"])]
    assert discovery.refusals == (
        "closed: cannot be read (Permission denied). Give yourself the right to read it, or move it away.",
    )
    # What the lake holds of it is not lost, so that --prune leaves it.
    lost = {"path": str(tmp_path / "gone.csv"), "file": "gone.csv", "sha256": "0"}
    kept = {"path": str(closed / "b.csv"), "file": "closed/b.csv", "sha256": "0"}
    folder = Folder(tmp_path, discovery)
    assert (folder.is_lost(lost), folder.is_lost(kept)) == (True, False)
