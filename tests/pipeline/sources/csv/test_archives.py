"""Zip archives: read as the folders they stand for, and refused by name where they cannot be."""

import tracemalloc
import zipfile
from hashlib import sha256
from pathlib import Path

import polars as pl
import pytest
from archive_files import KINDS, NGSIM_FILES, ROWS, find, highd_bytes, names, pack, read, spread, tables
from polars.testing import assert_frame_equal
from raw_texts import TEXT_NAMES, as_csv, check_accounts, tracks_of, write

from tracklake.pipeline.ingest import discovery as discovery_module
from tracklake.pipeline.ingest.discovery import Digests, discover
from tracklake.pipeline.sources import RawFile, SourceError
from tracklake.pipeline.sources.csv import fetch_lines, hash_raw, read_head

PACKINGS = ("gzip", "an archive each", "one archive", "stored", "gzip in zip", "mixed")


@pytest.mark.parametrize("inner", ["", "highD-dataset-v1.0/data/", "highD\\data\\", "./a/"])
@pytest.mark.parametrize("packing", PACKINGS)
def test_a_highd_recording_is_the_same_however_it_is_packed(tmp_path, packing, inner):
    files = highd_bytes(tmp_path)
    plain, _ = read(spread(tmp_path / "plain", "plain", files, ""), tmp_path / "a")
    again, discovery = read(spread(tmp_path / "again", packing, files, inner), tmp_path / "b")
    assert not discovery.refusals
    assert list(again) == ["01"]
    assert tables(again) == tables(plain)
    # The seven rows of the hand-written recording, one of them twice, and a line that is too short.
    (tracks,) = again["01"].log.filter(pl.col("dialect") == "highd-tracks").iter_rows(named=True)
    assert (tracks["rows_read"], tracks["rows_kept"], tracks["rows_dropped"]) == (9, 7, 2)
    check_accounts(again["01"], entries_from=[tracks["file"]])
    assert again["01"].rejects.select("line", "text").rows()[-1] == (10, "1,2")


@pytest.mark.parametrize("inner", ["", "us-101/trajectories/"])
@pytest.mark.parametrize("packing", PACKINGS)
def test_ngsim_files_are_the_same_however_they_are_packed(tmp_path, packing, inner):
    files = {f"{number}-{name}.txt": data for number, (name, data) in enumerate(NGSIM_FILES.items())}
    plain, before = read(spread(tmp_path / "plain", "plain", files, ""), tmp_path / "a")
    again, discovery = read(spread(tmp_path / "again", packing, files, inner), tmp_path / "b")
    assert not discovery.refusals
    assert len(discovery.units) == len(before.units) == len(NGSIM_FILES)
    assert list(again) == list(plain) == ["us-101-0750"]
    assert tracks_of(again["us-101-0750"]).height == 4
    assert_frame_equal(tracks_of(again["us-101-0750"]), tracks_of(plain["us-101-0750"]))
    assert again["us-101-0750"].log["rows_read"].sum() == 4 * len(NGSIM_FILES)


@pytest.mark.parametrize("dialect", NGSIM_FILES)
def test_each_ngsim_dialect_is_the_same_in_an_archive(tmp_path, dialect):
    data = NGSIM_FILES[dialect] + NGSIM_FILES[dialect].splitlines(keepends=True)[-1] + b"1 2\n"
    plain, _ = read(write(tmp_path / "plain" / "raw.txt", data), tmp_path / "a")
    again, _ = read(pack(tmp_path / "again" / "raw.zip", {"in/raw.txt": data}), tmp_path / "b")
    assert tables(again) == tables(plain)
    ((recording, canonical),) = again.items()
    assert recording == "us-101-0750"
    assert canonical.log.select("rows_read", "rows_kept", "rows_dropped").rows() == [(6, 4, 2)]


def test_a_whole_delivery(tmp_path):
    top = "highD-dataset-v1.0"
    members = {f"{top}/": b"", f"{top}/data/": b"", f"{top}/Format.pdf": b"%PDF", f"{top}/LICENSE": b"Some words.\n"}
    for number in ("01", "02"):
        members |= {f"{top}/data/{name}": data for name, data in highd_bytes(tmp_path, number).items()}
        members[f"{top}/data/{number}_highway.png"] = b"\x89PNG"
        members[f"__MACOSX/{top}/data/._{number}_tracks.csv"] = b"\0\5\26\7"
        members[f"{top}/data/._{number}_tracks.csv"] = b"\0\5\26\7"
        members[f"{top}/.git/{number}_tracks.csv"] = b"x"
    discovery = find(pack(tmp_path / "in" / "highD.zip", members))
    assert names(discovery) == [
        [f"highD.zip/{top}/data/{number}_{kind}.csv" for kind in KINDS] for number in ("01", "02")
    ]
    assert not discovery.refusals
    pictures = [f"highD.zip/{top}/data/{number}_highway.png" for number in ("01", "02")]
    assert sorted(discovery.skipped) == sorted([f"highD.zip/{top}/Format.pdf", f"highD.zip/{top}/LICENSE", *pictures])


def test_a_file_knows_its_folder_and_name_in_an_archive_or_not():
    plain = RawFile(Path("/raw/data/01_tracks.csv"), "data/01_tracks.csv")
    assert (plain.folder, plain.filename) == ("/raw/data", "01_tracks.csv")
    for member in ("data/01_tracks.csv", "data\\01_tracks.csv", "/data/01_tracks.csv"):
        packed = RawFile(Path("/raw/a.zip"), "a.zip/data/01_tracks.csv", member=member)
        assert (packed.folder, packed.filename) == ("/raw/a.zip/data", "01_tracks.csv")
        assert RawFile.from_dict(packed.to_dict()) == packed
    assert RawFile(Path("/raw/a.zip"), "a.zip/x.csv", member="x.csv").folder == "/raw/a.zip"


def test_a_plain_file_and_its_copy_in_an_archive(tmp_path):
    source = tmp_path / "source"
    write(source / "export.csv", NGSIM_FILES["export"])
    pack(source / "export.zip", {"export.csv": NGSIM_FILES["export"]})
    discovery = find(source)
    assert names(discovery) == [["export.csv"]]
    assert discovery.refusals == (
        "export.zip/export.csv: the same bytes as export.csv, which was read; remove one of the two.",
    )


def test_a_second_set_of_highd_files_in_an_archive(tmp_path):
    files = highd_bytes(tmp_path)
    source = spread(tmp_path / "source", "one archive", files, "")
    for name, data in files.items():
        write(source / name, data)
    discovery = find(source)
    assert names(discovery) == [[f"01_{kind}.csv" for kind in KINDS]]
    (refusal,) = discovery.refusals
    assert refusal.startswith("recording 01: a second set of files (all.zip/01_")


def test_what_an_archive_lacks_may_lie_beside_it_but_complete_recordings_are_not_mixed(tmp_path):
    files = highd_bytes(tmp_path)
    source = tmp_path / "source"
    pack(source / "all.zip", files)
    # A part of another delivery, which begins with "a" and so comes first.
    pack(source / "a part.zip", {"01_tracks.csv": files["01_tracks.csv"]})
    discovery = find(source)
    assert names(discovery) == [[f"all.zip/01_{kind}.csv" for kind in KINDS]]
    (refusal,) = discovery.refusals
    assert "01_recordingMeta.csv and 01_tracksMeta.csv missing beside a part.zip/01_tracks.csv" in refusal
    (source / "all.zip").unlink()
    for kind in KINDS[:2]:
        write(source / f"01_{kind}.csv", files[f"01_{kind}.csv"])
    assert names(find(source)) == [["01_recordingMeta.csv", "01_tracksMeta.csv", "a part.zip/01_tracks.csv"]]


def set_flag(data, flag):
    """The archive with a bit set in the flags of every member, in its own header and in the directory."""
    changed = bytearray(data)
    for magic, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(magic)
        while at >= 0:
            changed[at + offset] |= flag
            at = data.find(magic, at + 1)
    return bytes(changed)


def test_members_that_cannot_be_read_are_refused_once_for_all_and_the_others_go_through(tmp_path):
    source = tmp_path / "source"
    locked = pack(source / "locked.zip", {f"{n}_tracks.csv": b"x" for n in range(3)} | {"a.png": b""})
    locked.write_bytes(set_flag(locked.read_bytes(), 1))
    pack(source / "odd.zip", {"data/export.csv": NGSIM_FILES["export"]}, method=zipfile.ZIP_BZIP2)
    nested = pack(tmp_path / "inner.zip", {"raw.txt": NGSIM_FILES["text"]}).read_bytes()
    pack(source / "nested.zip", {"inner.zip": nested, "raw.txt": NGSIM_FILES["text"]})
    with pytest.warns(UserWarning, match="Duplicate name"):
        pack(source / "twice.zip", [("a.csv", b"x"), ("a.csv", b"y"), ("b.csv", NGSIM_FILES["named"])])
    discovery = find(source)
    assert sorted(names(discovery)) == [["nested.zip/raw.txt"], ["twice.zip/b.csv"]]
    assert discovery.skipped == ("locked.zip/a.png",)
    assert sorted(discovery.refusals) == [
        "locked.zip/0_tracks.csv and 2 more: encrypted. Expected an archive without a password. "
        "Unpack locked.zip and give the folder.",
        "nested.zip/inner.zip: an archive inside an archive, which is not read. Expected the raw files. "
        "Unpack nested.zip and give the folder.",
        "odd.zip/data/export.csv: compressed by method 12. Expected 0 (stored) or 8 (deflated). "
        "Unpack odd.zip and give the folder.",
        "twice.zip/a.csv and 1 more: 2 members have this name. Expected one. Unpack twice.zip and give the folder.",
    ]


def test_an_archive_without_raw_files_is_skipped_unless_the_user_names_it(tmp_path):
    document = pack(tmp_path / "in" / "documents.zip", {"a.pdf": b"%PDF", "notes.txt": b"Some words.\n"})
    empty = pack(tmp_path / "in" / "empty.zip", {})
    write(tmp_path / "in" / "raw.txt", NGSIM_FILES["text"])
    discovery = find(tmp_path / "in")
    assert not discovery.refusals
    assert sorted(discovery.skipped) == [
        "documents.zip", "documents.zip/a.pdf", "documents.zip/notes.txt", "empty.zip"]  # fmt: skip
    (refusal,) = find(document).refusals
    assert refusal.startswith("documents.zip: an archive with no raw recordings in it. Expected highD: ")
    assert refusal.endswith("Got a.pdf, notes.txt. Give the archive as downloaded.")
    assert "Got an empty archive" in find(empty).refusals[0]
    # A spreadsheet that was given the ending of a table was meant to be one.
    sheet = pack(tmp_path / "in" / "sheet.csv", {"[Content_Types].xml": b"<x/>", "xl/workbook.xml": b"<x/>"})
    assert find(sheet.parent).refusals[0].startswith("sheet.csv: an archive with no raw recordings in it")


def test_an_unknown_table_in_an_archive_is_refused_and_a_plain_file_called_zip_is_read(tmp_path):
    source = tmp_path / "in"
    pack(source / "a.zip", {"results.csv": b"date,value\n2020,1\n", "b/raw.csv": NGSIM_FILES["named"]})
    write(source / "plain.zip", NGSIM_FILES["export"])
    discovery = find(source)
    assert names(discovery) == [["a.zip/b/raw.csv"], ["plain.zip"]]
    assert discovery.refusals[0].startswith("a.zip/results.csv, line 1: not a known trajectory file")


def test_an_archive_that_changed_after_it_was_listed(tmp_path):
    path = pack(tmp_path / "a.zip", {"raw.txt": NGSIM_FILES["text"]})
    (file,) = find(path).units[0][1].files
    pack(path, {"other.txt": NGSIM_FILES["text"]})
    with pytest.raises(SourceError, match=r"^a\.zip/raw\.txt: no longer in the archive.* Run again\.$"):
        read_head(file)


def test_the_hash_is_the_members_whatever_the_archives_is(tmp_path):
    text = NGSIM_FILES["text"]
    hashes = [
        hash_raw(find(path).units[0][1].files[0])
        for path in (
            write(tmp_path / "raw.txt", text),
            pack(tmp_path / "a.zip", {"raw.txt": text}),
            pack(tmp_path / "b.zip", {"x/y.txt": text, "z.png": b"z"}, method=zipfile.ZIP_STORED),
        )
    ]
    assert set(hashes) == {sha256(text).hexdigest()}


def test_hashes_of_members_are_remembered_until_the_archive_changes(tmp_path, monkeypatch):
    path = pack(tmp_path / "a.zip", {"a.csv": NGSIM_FILES["export"], "b.csv": NGSIM_FILES["named"]})
    write(tmp_path / "manifest.json", b"{}")
    unpacked = []

    def count(file):
        unpacked.append(file.name)
        return hash_raw(file)

    monkeypatch.setattr(discovery_module, "hash_raw", count)
    monkeypatch.setattr(discovery_module, "_HASHES_OF_PROCESS", {})

    def look():
        # As a new process would: it knows what stands in the lake.
        discovery_module._HASHES_OF_PROCESS.clear()
        digests = Digests(tmp_path)
        found = discover(path, digest=digests)
        digests.save()
        return [file.sha256 for _, unit in found.units for file in unit.files]

    first = look()
    assert first == [sha256(NGSIM_FILES[name]).hexdigest() for name in ("export", "named")]
    assert look() == first
    assert sorted(unpacked) == ["a.zip/a.csv", "a.zip/b.csv"], "each once, by threads that take no turns"
    pack(path, {"a.csv": NGSIM_FILES["export"], "b.csv": NGSIM_FILES["bare"]}, method=zipfile.ZIP_STORED)
    assert look() == [first[0], sha256(NGSIM_FILES["bare"]).hexdigest()]
    assert len(unpacked) == 4


def test_a_member_is_never_held_whole_nor_written_to_disk(tmp_path, monkeypatch):
    line = as_csv(ROWS[:1], TEXT_NAMES, header=())
    path = tmp_path / "big.zip"
    lines = (48 << 20) // len(line)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("raw.csv", "w") as member:
        for _ in range(lines // 1000):
            member.write(line * 1000)
    file = RawFile(path, "big.zip/raw.csv", member="raw.csv")
    monkeypatch.setattr(zipfile.ZipFile, "extract", None)
    before = sorted(tmp_path.iterdir())
    tracemalloc.start()
    hash_raw(file)
    _, hashing = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert hashing < 8 << 20
    assert read_head(file, 100) == (line * 10)[:100]
    assert sorted(tmp_path.iterdir()) == before


def test_single_lines_of_a_member(tmp_path):
    path = pack(tmp_path / "a.zip", {"x/raw.txt": b"one\ntwo\r\nthree"})
    file = RawFile(path, "a.zip/x/raw.txt", member="x/raw.txt")
    assert fetch_lines(file, pl.Series([3, 2])).rows() == [(2, "two"), (3, "three")]
