"""Folders that are replaced whole or not at all."""

from pathlib import Path

import pytest

from tracklake.schemas.files import replace_folder


def fill(folder, text):
    with replace_folder(folder) as aside:
        (aside / text).write_text(text)


def list_all(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_a_folder_appears_with_its_parents_and_replaces_another(tmp_path):
    fill(tmp_path / "a" / "b", "first")
    assert list_all(tmp_path) == ["a", "a/b", "a/b/first"]
    fill(tmp_path / "a" / "b", "second")
    assert list_all(tmp_path) == ["a", "a/b", "a/b/second"]


def test_an_error_while_it_is_written_changes_nothing(tmp_path):
    fill(tmp_path / "a", "first")
    with pytest.raises(IsADirectoryError):
        fill(tmp_path / "a", "..")
    assert list_all(tmp_path) == ["a", "a/first"]


def test_a_folder_that_cannot_be_put_in_its_place_leaves_the_one_before(tmp_path, monkeypatch):
    fill(tmp_path / "a", "first")
    rename = Path.rename

    def refuse_new(path, target):
        if (path / "second").exists():
            raise OSError("no")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refuse_new)
    with pytest.raises(OSError, match="no"):
        fill(tmp_path / "a", "second")
    assert list_all(tmp_path) == ["a", "a/first"]
