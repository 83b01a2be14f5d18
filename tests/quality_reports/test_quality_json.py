"""docs/quality_json.md is derived from the declared types, and lists exactly the keys of the sample lake's document."""

import json
import random
import re
from pathlib import Path

import pytest
from mutations import mutate

from tracklake.pipeline.lake import LakeError
from tracklake.pipeline.stages.report import read_quality
from tracklake.schemas.quality import QUALITY_SCHEMA, Quality
from tracklake.schemas.quality_markdown import SECTIONS, write_quality_page

PAGE = (Path(__file__).parents[2] / "docs" / "quality_json.md").read_text()
ROW = re.compile(
    r"^\| `(?P<key>[^`]+)` \| (?P<kind>integer|number|text|boolean)(?P<null> or null)? \| (?P<unit>[^|]*) \| .+ \|$",
    re.MULTILINE,
)
KINDS = {"integer": (int,), "number": (int, float), "text": (str,), "boolean": (bool,)}


def documented() -> dict[str, tuple[str, bool]]:
    """(kind, whether it may be null) of every documented key."""
    rows = [(row["key"], (row["kind"], bool(row["null"]))) for row in ROW.finditer(PAGE)]
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


def test_the_page_is_current():
    assert write_quality_page() == PAGE, "run `make docs`"


def test_every_row_of_the_tables_is_understood():
    rows = [line for line in PAGE.splitlines() if line.startswith("| `")]
    assert len(rows) == len(ROW.findall(PAGE)) > 200


def test_units_follow_from_names_unless_declared():
    units = {row["key"]: row["unit"] for row in ROW.finditer(PAGE)}
    assert (units["subsets[].flow_vphpl"], units["subsets[].vehicles_per_lane_s"]) == ("veh/h/lane", "veh/lane/s")
    assert units["subset_scores[].worst_jerk_mps3"] == "m/s³"
    assert units["subset_scores[].share_without_error"] == "0 to 1"
    assert units["recordings[].seconds"] == "s"
    assert units["speeds.per_second[].seconds"] == units["headline.vehicles"] == ""


def test_every_key_has_a_section_and_a_meaning():
    assert {key for _, _, keys in SECTIONS for key in keys} == set(Quality.__annotations__)
    assert [row["key"] for row in ROW.finditer(PAGE) if row[0].endswith("|  |")] == []


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


def test_every_documented_key_is_in_the_document(found):
    empty = always_empty(found)
    missing = []
    for key in documented():
        # The sample has neither: test_drive_page.py and test_groups.py compare them.
        if key.startswith(("drives.", "groups[")):
            continue
        # Keys inside a list or mapping that is empty everywhere cannot be checked.
        holders = [key[: match.start()] for match in re.finditer(r"\[\]|\.\*", key)]
        holder_is_empty = any(pattern(holder).fullmatch(path) for holder in holders for path in empty)
        if not holder_is_empty and not any(pattern(key).fullmatch(path) for path in found):
            missing.append(key)
    assert missing == []


def test_few_lists_are_empty_everywhere(found):
    """The test above cannot check keys inside empty lists."""
    assert always_empty(found) <= {
        "subsets[].columns_missing",
        "splits.left_out",
        "reconstruction.unkept_bounds",
        "published.figures",
        "published.left_out",
        "provenance.data",
        "provenance.thresholds",
        "provenance.thresholds_elsewhere",
        "provenance.settings.on_ramp_lanes",
        "provenance.settings.safety_thresholds",
    }


def test_the_version_is_the_documents(found):
    assert found["schema"] == [QUALITY_SCHEMA]
    assert f"`{QUALITY_SCHEMA}`" in PAGE


def test_a_changed_document_is_refused_with_its_name_or_read(tmp_path, report):
    file, draw, refusals = tmp_path / "reports" / "quality.json", random.Random(0), []
    file.parent.mkdir()
    file.write_text(report.json)
    whole = read_quality(tmp_path)
    assert whole == json.loads(report.json)
    for _ in range(60):
        file.write_text(json.dumps(mutate(whole, draw)))
        try:
            read_quality(tmp_path)
        except LakeError as refused:
            refusals.append(str(refused))
    assert len(refusals) > 20
    again = f"delete it and run `tracklake report --lake {tmp_path}`"
    assert all(message.startswith(f"{file}: ") and message.endswith(again) for message in refusals)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{}", "`schema`: Field required"),
        ("[" * 100_000, "nested in more than 50 levels"),
        ("[]", "Input should be a valid dictionary"),
        ("\0", "Expecting value"),
    ],
)
def test_what_is_no_such_document_is_refused(tmp_path, text, says):
    (tmp_path / "reports").mkdir()
    (tmp_path / "reports" / "quality.json").write_text(text)
    with pytest.raises(LakeError, match=re.escape(says)):
        read_quality(tmp_path)
