"""Damage to an archive never crashes, and never changes a row: the same tables, or a refusal by name."""

import gzip
import io
import zipfile

import pytest
from archive_files import NGSIM_FILES, find, highd_bytes, names, pack, read, tables
from hypothesis import example, given, settings
from hypothesis import strategies as st
from raw_texts import as_csv, ngsim_row, write

from tracklake.pipeline.sources import SourceError
from tracklake.pipeline.sources.csv import read_head


@pytest.mark.parametrize("cut", [5, 40, -30, -1])
def test_an_archive_that_is_cut_short_is_refused_by_name(tmp_path, cut):
    whole = pack(tmp_path / "made.zip", {"raw.txt": NGSIM_FILES["text"]}).read_bytes()
    write(tmp_path / "in" / "sub" / "cut.zip", whole[:cut])
    write(tmp_path / "in" / "raw.csv", NGSIM_FILES["export"])
    discovery = find(tmp_path / "in")
    assert names(discovery) == [["raw.csv"]]
    (refusal,) = discovery.refusals
    assert refusal.startswith("sub/cut.zip: the archive is damaged or cut short")
    assert refusal.endswith("Expected a whole zip archive. Download it again.")


def test_a_damaged_member_is_refused_by_name_and_the_others_go_through(tmp_path):
    text = NGSIM_FILES["text"]
    path = pack(tmp_path / "a.zip", {"in/bad.txt": text, "in/good.csv": NGSIM_FILES["export"]}, method=0)
    data = path.read_bytes()
    at = data.find(text) + len(text) - 5
    path.write_bytes(data[:at] + b"9" + data[at + 1 :])
    discovery = find(path)
    assert names(discovery) == [["a.zip/in/good.csv"]]
    (refusal,) = discovery.refusals
    assert refusal.startswith("a.zip/in/bad.txt: the compressed file is damaged or cut short (Bad CRC-32")
    assert refusal.endswith("Expected a whole zip archive. Download it again.")


def test_a_damaged_gzip_member_is_refused_when_it_is_read(tmp_path):
    packed = gzip.compress(as_csv([ngsim_row(5, frame) for frame in range(1, 2000)]))
    found = find(pack(tmp_path / "a.zip", {"raw.csv.gz": packed[:-4]}))
    (file,) = found.units[0][1].files
    with pytest.raises(SourceError, match=r"^a\.zip/raw\.csv\.gz: the compressed file is damaged or cut short"):
        found.units[0][0].spill(file, tmp_path / "spilled")


COMMENT = b"as downloaded"


def small_archive(dataset):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.comment = COMMENT
        for name, data in dataset.items():
            archive.writestr(name, data)
    return out.getvalue()


NGSIM_ARCHIVE = small_archive({"in/raw.txt": NGSIM_FILES["text"] + b"1 2\n"})


def damage(data, edits):
    """Flip bits of bytes, or cut (None)."""
    for where, bits in edits:
        at = where % len(data)
        data = data[:at] if bits is None else data[:at] + bytes([data[at] ^ bits]) + data[at + 1 :]
        if not data:
            break
    return data


@pytest.fixture(scope="module")
def undamaged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("undamaged")
    found, _ = read(write(folder / "whole.zip", NGSIM_ARCHIVE), folder)
    assert [(name, len(made)) for name, made in tables(found).items()] == [("us-101-0750", 3)]
    return tables(found)


@given(
    edits=st.lists(
        st.tuples(st.integers(0, 1 << 16), st.one_of(st.integers(1, 255), st.none())), min_size=1, max_size=3
    )
)
@example(edits=[(0, None)])
@settings(max_examples=50, deadline=None)
def test_no_damage_to_an_archive_crashes_or_changes_a_row(undamaged, tmp_path_factory, edits):
    folder = tmp_path_factory.mktemp("fuzz")
    path = write(folder / "damaged.zip", damage(NGSIM_ARCHIVE, edits))
    found, discovery = read(path, folder)
    if not found:
        assert discovery.refusals
        return
    # Damage to a name or a comment may leave the rows alone.
    assert tables(found) == undamaged
    (log,) = found["us-101-0750"].log.iter_rows(named=True)
    assert (log["rows_read"], log["rows_kept"], log["rows_dropped"]) == (5, 4, 1)


@pytest.mark.parametrize("bits", [1, 8, 128])
def test_no_damaged_byte_of_a_recordings_archive_crashes_or_changes_a_byte(tmp_path, bits):
    files = highd_bytes(tmp_path)
    whole = small_archive({f"data/{name}": data for name, data in files.items()})
    directory = whole.find(b"PK\x01\x02")
    starts = [at for at in range(directory) if whole[at : at + 4] == b"PK\x03\x04"]
    assert len(starts) == 3
    # All of the directory and of the members' headers, and some of what is compressed.
    headers = [at for start in starts for at in range(start, start + 55)]
    for at in sorted({*headers, *range(0, directory, 7), *range(directory, len(whole))}):
        discovery = find(write(tmp_path / "damaged.zip", damage(whole, [(at, bits)])))
        found = [file for _, unit in discovery.units for file in unit.files]
        assert {file.filename: read_head(file, 1 << 20) for file in found} == (files if found else {}), at
        assert found or discovery.refusals, at
        assert all(len(refusal) < 1000 for refusal in discovery.refusals), at


def test_an_archive_cut_anywhere_is_refused(tmp_path):
    for length in range(len(NGSIM_ARCHIVE) - len(COMMENT)):
        discovery = find(write(tmp_path / "cut.zip", NGSIM_ARCHIVE[:length]))
        assert not discovery.units
        (refusal,) = discovery.refusals
        assert refusal.startswith("cut.zip")
