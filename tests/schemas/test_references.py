"""References: in one place, named in texts as they are listed, and linked by the generated pages."""

import re
from pathlib import Path

import pytest

from tracklake.quality_reports.rules.registry import RULES
from tracklake.schemas.protocols import MEANINGS
from tracklake.schemas.published_results import PUBLISHED
from tracklake.schemas.references import HAMALAINEN, REFERENCES, find_references, link_references
from tracklake.schemas.references_markdown import write_references
from tracklake.training.models import MODELS

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_has_a_heading_for_every_link_and_the_whole_reference():
    page = write_references()
    assert (DOCS / "references.md").read_text() == page
    assert "Papers in Resource Analysis 23, Saint Mary's University of Minnesota." in page
    for reference in REFERENCES:
        assert f"## {reference.name}\n" in page
        assert reference.text in page


def test_anchors_are_those_of_the_headings():
    # A heading's anchor is its text in lower case, blanks as hyphens, without other punctuation.
    assert HAMALAINEN.anchor == "hamalainen-2020"
    anchors = {reference.name: reference.anchor for reference in REFERENCES}
    assert anchors["Bar-Shalom, Li and Kirubarajan (2001)"] == "bar-shalom-li-and-kirubarajan-2001"
    assert len(set(anchors.values())) == len(REFERENCES)


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_links_to_references_lead_somewhere(page):
    known = {reference.anchor for reference in REFERENCES}
    assert set(re.findall(r"references\.md#([\w-]+)", page.read_text())) <= known


def test_texts_are_linked_by_name():
    assert link_references("after Edie (1963).") == "after [Edie (1963)](references.md#edie-1963)."
    assert [reference.name for reference in find_references("Choi et al. (2021) and Hamalainen (2020)")] == [
        "Hamalainen (2020)",
        "Choi et al. (2021)",
    ]


def test_rules_protocols_models_and_published_rows_name_their_sources():
    rules = {rule.name: rule.source for rule in RULES}
    for name in ("negative_headway_recorded", "high_acceleration", "low_constant_speed", "backward"):
        assert HAMALAINEN.name in rules[name]
    assert HAMALAINEN.name in MEANINGS["highd-flow-balanced"]
    assert all(find_references(model.source) for model in MODELS.values() if model.source)
    for line in PUBLISHED:
        assert any(each.text in line.reference or each.name in line.reference for each in REFERENCES), line
