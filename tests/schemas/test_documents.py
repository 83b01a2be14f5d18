"""JSON documents as others may have left them."""

import json

import pytest

from tracklake.pipeline.lake import LakeError, load, open_for_writing
from tracklake.schemas.documents import MAX_DEPTH, parse_json, read_json


def nest(levels: int) -> str:
    return "[" * levels + "]" * levels


def test_documents_are_what_json_makes_of_them(tmp_path):
    value = {"a": [1, None, {"b": "[[[{{{"}], "c": 1.5}
    assert parse_json(json.dumps(value)) == value
    (tmp_path / "a.json").write_text('"\u00fc"', encoding="utf-8")
    assert read_json(tmp_path / "a.json") == "\u00fc"
    assert parse_json(nest(MAX_DEPTH)) is not None


@pytest.mark.parametrize("text", [nest(MAX_DEPTH + 1), nest(100_000), '{"a":' * 100_000, "", "{", "nonsense"])
def test_what_is_no_document_is_a_value_error(text):
    with pytest.raises(ValueError, match=r"nested in more than 50 levels|Expecting|char"):
        parse_json(text)


def test_a_nested_manifest_is_no_manifest(tmp_path):
    with open_for_writing(tmp_path):
        pass
    (tmp_path / "manifest.json").write_text(nest(100_000))
    with pytest.raises(LakeError, match="not a manifest of tracklake"):
        load(tmp_path)
