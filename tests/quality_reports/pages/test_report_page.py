"""The page: safe against hostile names, self-contained, well formed; and how it words single values."""

import re
from datetime import datetime
from decimal import Decimal
from pathlib import Path

import duckdb
import pytest
from page_elements import HOSTILE, parse, spoil_texts

from tracklake.quality_reports.pages.rendering import DASH, flatten, format_cell, format_duration
from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.plots import charts as plots
from tracklake.quality_reports.summaries import plain, read_statement
from tracklake.schemas.references import REFERENCES
from tracklake.schemas.text import make_visible


def test_no_name_injects_markup(open_lake, small_lake):
    scores = [{"model": HOSTILE, "part": HOSTILE, "rows": [{"seconds": 1, "rmse_m": 1.0, "n": 1}]}]
    report = build_report(
        open_lake(**spoil_texts(small_lake)),
        {"lake": HOSTILE, "created": HOSTILE, HOSTILE: {HOSTILE: HOSTILE}},
        scores=scores,
    )
    elements = parse(report.html).elements
    tags = {tag for tag, _ in elements}
    assert not tags & {"script", "img", "iframe", "object", "embed", "link", "base", "form"}
    assert not [name for _, attributes in elements for name in attributes if name.startswith("on")]
    assert "&lt;script&gt;alert(1)" in report.html
    assert "\u202e" not in re.sub(r"<svg.*?</svg>", "", report.html, flags=re.DOTALL), "would rearrange the line"
    assert "\x00" not in report.html


def test_the_page_is_well_formed_and_fetches_nothing(report):
    elements = parse(report.html).elements
    assert {tag for tag, _ in elements} & {"link", "script", "img", "iframe"} == set()
    beside = {"files.html", "rejects.html"}
    for tag, attributes in elements:
        for name in ("src", "srcset", "xlink:href", "action", "poster"):
            assert name not in attributes, (tag, attributes)
        if "href" in attributes:
            # A link fetches nothing before a reader follows it.
            inside = attributes["href"].startswith(("#", "subsets/", "https://doi.org/"))
            assert inside or attributes["href"] in beside
    references = {each.address for each in REFERENCES}
    namespaces = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert set(re.findall(r"https?://[^\s\"'<>)]+", report.html)) <= namespaces | references
    assert "url(" not in report.html
    assert "@import" not in report.html
    ids = [attributes["id"] for _, attributes in elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = {attributes["href"] for tag, attributes in elements if tag == "a"}
    pages = {"subsets/01-lower.html", "subsets/01-upper.html", "subsets/peachtree-north.html"}
    assert {link for link in links if not link.startswith("#")} - references == pages | beside
    assert {link[1:] for link in links - pages - references - beside} <= set(ids)


def test_every_colour_of_a_plot_follows_the_theme(report):
    style = re.search(r"<style>(.*?)</style>", report.html, flags=re.DOTALL).group(1)
    drawings = "".join(re.findall(r"<svg.*?</svg>", report.html, flags=re.DOTALL))
    used = set(re.findall(r"(?:fill|stroke)=\"([^\"]+)\"", drawings)) - {"none", "transparent"}
    assert plots.BLUE in used
    for colour in used:
        assert f'[fill="{colour}"]' in style, f"{colour} would be the same on light and dark"


def test_every_axis_has_its_unit(report):
    for title in (
        "recorded speed (m/s, below in km/h)",
        "share of entries (%)",
        "x of the first entry (m)",
        "vehicles per lane and second",
    ):
        assert title in report.html


def test_every_statement_says_what_a_row_is():
    folder = Path(plots.__file__).parents[1] / "sql"
    names = sorted(path.stem for path in folder.glob("*.sql"))
    assert len(names) >= 15
    for name in names:
        assert read_statement(name).startswith("-- "), name
        assert len(duckdb.extract_statements(read_statement(name))) == 1, f"{name}: one statement per file"


@pytest.mark.parametrize(
    ("value", "kind", "text"),
    [
        (None, "f2", DASH),
        (1234567, "int", "1,234,567"),
        (0.0, "percent", "0.00 %"),
        (0.00001, "percent", "< 0.01 %"),
        (0.1234, "percent", "12.34 %"),
        (-1.25, "f1", "\N{MINUS SIGN}1.2"),
        (-0.001, "f2", "0.00"),
        (True, "bool", "yes"),
        (["a", "b"], "text", "a, b"),
        (61.0, "duration", "61.0 s"),
        (-27.5, "speed", "\N{MINUS SIGN}27.50 <small>\N{MINUS SIGN}99.0</small>"),
        (10.0, "speed_below", '10.00 <small class="below">36.0</small>'),
        (None, "speed", DASH),
    ],
)
def test_cells(value, kind, text):
    assert format_cell(value, kind) == text


def test_durations():
    assert format_duration(900) == "15 min"
    assert format_duration(7260) == "2 h 01 min"
    assert format_duration(None) == DASH


def test_characters_that_are_not_seen_are_shown():
    assert make_visible("a\x00b\tc\u202ed\u200be é") == "a\\x00b\\tc\\u202ed\\u200be é"


def test_settings_are_flattened():
    nested = {"a": {"b": 1, "c": [1, 2]}, "d": [{"e": None}]}
    assert flatten(nested) == [("a.b", "1"), ("a.c", "1, 2"), ("d[0].e", DASH)]


def test_plain_values():
    value = {"p": Path("a/b"), "t": (1, float("inf")), "d": Decimal("0.5"), "w": datetime(2026, 1, 2), "s": {2, 1}}
    assert plain(value) == {"p": "a/b", "t": [1, None], "d": 0.5, "w": "2026-01-02T00:00:00", "s": [1, 2]}
    with pytest.raises(TypeError, match="object"):
        plain(object())
