"""docs/quality_json.md says what is in quality.json: every key of the sample lake's document, and no other."""

import json
import re
from pathlib import Path

import pytest

from tracklake.quality_reports.summaries import QUALITY_SCHEMA

PAGE = (Path(__file__).parents[2] / "docs" / "quality_json.md").read_text()
ROW = re.compile(
    r"^\| `(?P<key>[^`]+)` \| (?P<kind>integer|number|text|boolean)(?P<null> or null)? \| .+ \|$", re.MULTILINE
)
KINDS = {"integer": (int,), "number": (int, float), "text": (str,), "boolean": (bool,)}


def expand(key: str) -> list[str]:
    """`a.{b,c}` as `a.b` and `a.c`."""
    group = re.search(r"\{([^}]*)\}", key)
    if group is None:
        return [key]
    return [one for each in group[1].split(",") for one in expand(key[: group.start()] + each + key[group.end() :])]


def documented() -> dict[str, tuple[str, bool]]:
    """(kind, whether it may be null) of every documented key."""
    rows = [(key, (row["kind"], bool(row["null"]))) for row in ROW.finditer(PAGE) for key in expand(row["key"])]
    assert len(dict(rows)) == len(rows), "a key is documented once"
    return dict(rows)


def pattern(key: str) -> re.Pattern[str]:
    """`*` stands for any name, which may hold dots."""
    return re.compile(re.escape(key).replace(r"\*", r"[^\[\]]+?"))


def walk(value, path: str = ""):
    """(path, value) of everything that is neither list nor mapping; of an empty one, itself."""
    if isinstance(value, dict) and value:
        for name, each in value.items():
            yield from walk(each, f"{path}.{name}" if path else name)
    elif isinstance(value, list) and value:
        for each in value:
            yield from walk(each, f"{path}[]")
    else:
        yield path, value


def always_empty(found: dict[str, list]) -> set[str]:
    """Lists and mappings with nothing in them, wherever they stand."""
    hollow = {path for path, values in found.items() if all(isinstance(value, list | dict) for value in values)}
    return {path for path in hollow if not any(other.startswith((f"{path}[", f"{path}.")) for other in found)}


@pytest.fixture(scope="module")
def found(lake) -> dict[str, list]:
    """The values of quality.json by path."""
    by_path: dict[str, list] = {}
    for path, value in walk(json.loads((lake.root / "reports" / "quality.json").read_text())):
        by_path.setdefault(path, []).append(value)
    return by_path


def test_every_row_of_the_tables_is_understood():
    rows = [line for line in PAGE.splitlines() if line.startswith("| `")]
    assert len(rows) == len(ROW.findall(PAGE)) > 100
    assert expand("a.{b[],c}.{d,e}_m") == ["a.b[].d_m", "a.b[].e_m", "a.c.d_m", "a.c.e_m"]


def test_every_key_is_documented_with_the_kind_that_it_has(found):
    page = {pattern(key): declared for key, declared in documented().items()}
    wrong = []
    for path, values in found.items():
        declared = [each for key, each in page.items() if key.fullmatch(path)]
        full = [value for value in values if not isinstance(value, list | dict)]
        if len(declared) > 1 or (full and not declared):
            wrong.append(f"{path}: {'documented twice' if declared else 'not documented'}")
        for kind, nullable in declared:
            wrong += [
                f"{path}: {value!r} is no {kind}"
                for value in full
                if not ((value is None and nullable) or (type(value) in KINDS[kind]))
            ]
    assert wrong == []


def test_every_documented_key_is_there(found):
    empty = always_empty(found)
    missing = []
    for key in documented():
        # Of a list or mapping that is empty wherever it stands, what would be in it is not seen.
        holders = [key[: match.start()] for match in re.finditer(r"\[\]|\.\*", key)]
        holder_is_empty = any(pattern(holder).fullmatch(path) for holder in holders for path in empty)
        if not holder_is_empty and not any(pattern(key).fullmatch(path) for path in found):
            missing.append(key)
    assert missing == []


def test_hardly_anything_goes_unseen(found):
    """Or the test above would find every key there."""
    assert always_empty(found) <= {
        "subsets[].columns_missing",
        "splits.left_out",
        "provenance.thresholds",
        "provenance.thresholds_elsewhere",
        "provenance.settings.on_ramp_lanes",
    }


def test_the_version_is_the_documents(found):
    assert found["schema"] == [QUALITY_SCHEMA]
    assert f"`{QUALITY_SCHEMA}`" in PAGE
