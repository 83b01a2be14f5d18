"""Files of an export: all in their place or none, whatever breaks off when."""

from pathlib import Path

import pytest

from tracklake.pipeline.export.folder import ExportError, refuse_taken, write_files
from tracklake.pipeline.lake import LakeError, open_for_writing
from tracklake.schemas.errors import FileAccessError

NAMES = ("a", "b", "c")


def write_new(aside):
    for name in NAMES:
        (aside / name).write_text("new")


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("there", [{}, {"other": "mine"}, {"b": "old", "other": "mine"}])
def test_files_come_beside_what_is_there(tmp_path, there):
    out = tmp_path / "out"
    if there:
        out.mkdir()
    for name, text in there.items():
        (out / name).write_text(text)
    write_files(out, NAMES, write_new)
    assert contents(tmp_path) == {
        f"out/{name}": text for name, text in {**there, **dict.fromkeys(NAMES, "new")}.items()
    }
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_stands_in_the_way_is_found_before_any_work(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ExportError, match=r"file is not a folder that can be written to"):
        refuse_taken(tmp_path / "file" / "out", NAMES, force=True)
    (tmp_path / "out" / "b").mkdir(parents=True)
    with pytest.raises(ExportError, match=r"out: holds folders named b\."):
        refuse_taken(tmp_path / "out", NAMES, force=True)
    refuse_taken(tmp_path / "new" / "out", NAMES, force=False)
    assert contents(tmp_path) == {"file": "mine"}


@pytest.mark.parametrize("nested", [False, True])
def test_what_breaks_off_while_writing_leaves_nothing(tmp_path, nested):
    def fail(aside):
        (aside / "a").write_text("new")
        raise KeyboardInterrupt

    if nested:
        (tmp_path / "out").mkdir()
    with pytest.raises(KeyboardInterrupt):
        write_files(tmp_path / "out", NAMES, fail)
    assert contents(tmp_path) == {}
    assert [path.name for path in tmp_path.iterdir()] == (["out"] if nested else [])


@pytest.mark.parametrize("after", [False, True])
@pytest.mark.parametrize("step", range(1, 6))
def test_a_rename_that_fails_undoes_the_others(tmp_path, monkeypatch, step, after):
    """Five renames: a, the old b, b, the old c, c; each broken off before or just after it."""
    old = {"b": "old b", "c": "old c", "other": "mine"}
    for name, text in old.items():
        (tmp_path / name).write_text(text)
    real, calls = Path.replace, []

    def fail(self, target):
        calls.append(target)
        if len(calls) == step and not after:
            raise OSError(5, "Input/output error")
        real(self, target)
        if len(calls) == step:
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises((FileAccessError, KeyboardInterrupt)):
        write_files(tmp_path, NAMES, write_new)
    assert contents(tmp_path) == old
    monkeypatch.setattr(Path, "replace", real)
    write_files(tmp_path, NAMES, write_new)
    assert contents(tmp_path) == {**old, **dict.fromkeys(NAMES, "new")}


def test_places_that_will_not_do(tmp_path):
    lake, out = tmp_path / "lake", tmp_path / "out"
    with open_for_writing(lake):
        pass
    for inside in (lake, lake / "tracks" / "x"):
        with pytest.raises(LakeError, match="lies in the lake"):
            refuse_taken(inside, NAMES, force=True)
    refuse_taken(out, NAMES, force=False)
    out.mkdir()
    (out / "other").write_text("")
    refuse_taken(out, NAMES, force=False)
    (out / "b").write_text("")
    with pytest.raises(ExportError, match=r"holds b\. Name another folder"):
        refuse_taken(out, NAMES, force=False)
    refuse_taken(out, NAMES, force=True)
    with pytest.raises(ExportError, match="is a file"):
        refuse_taken(out / "b", NAMES, force=True)
