"""Pages of drives, and the overview of a lake with drives: what they say, well formed, safe against hostile names."""

import re
from dataclasses import asdict

import pytest
from page_elements import HOSTILE, parse, spoil_texts
from pydantic import TypeAdapter

from tracklake.quality_reports.pages.drives import render_drive
from tracklake.quality_reports.pages.report import build_report
from tracklake.schemas.quality import Quality
from tracklake.schemas.quality_markdown import write_quality_page
from tracklake.training.onboard.collisions import WarningScore
from tracklake.training.onboard.scores import OnboardScore, list_published

LINE = "2 stations, 110 messages, 8.3 % lost"


@pytest.fixture(scope="module")
def page(open_lake, small_drive) -> str:
    return render_drive(open_lake(**small_drive), "drive-1", {"lake": "lake"}, {"message_latency_s": 0.2})


def test_the_page_shows_every_part_of_a_drive(page):
    elements = parse(page).elements
    assert LINE in page
    ids = [attributes["id"] for _, attributes in elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    links = {attributes["href"] for tag, attributes in elements if tag == "a"}
    assert {link[1:] for link in links if link.startswith("#")} <= set(ids)
    labels = [attributes.get("aria-label") for tag, attributes in elements if tag == "svg"]
    assert labels.count("Vehicles around the ego from above") == 5
    assert {"Share of lost messages by distance", "Errors of positions by distance"} <= set(labels)
    assert 'class="empty"' not in page
    assert "message_latency_s</code>&nbsp;= 0.2 s <span" in page, "thresholds are those that were used"
    assert re.search(
        r"vehicle 1: 30\.2 m ahead, 0\.0 m to the right, 72 km/h \(20\.0 m/s\), V2V and LiDAR, 0\.20 m", page
    )


def test_true_outlines_include_vehicles_that_never_sent(open_lake, small_drive, page):
    def count_outlines(html: str) -> int:
        return html.count('stroke-dasharray="3 2"')

    known = [row for row in small_drive["surrounding_truth"] if row["vehicle_id"] is not None]
    assert len(known) < len(small_drive["surrounding_truth"])
    fewer = render_drive(open_lake(**{**small_drive, "surrounding_truth": known}), "drive-1", {})
    assert count_outlines(page) == count_outlines(fewer) + 5, "one vehicle never sends, at five moments"


def test_a_drive_without_anything_around_it_says_so(open_lake, small_drive):
    bare = {name: small_drive[name] for name in ("drives", "stations")}
    bare["drives"] = [{**bare["drives"][0], "origin": "recorded"}]
    page = render_drive(open_lake(**bare), "drive-1", {})
    assert page.count('class="empty"') == 5
    assert "recorded on a road: no truth to compare with" in page
    assert "has not been checked" in page


def test_no_name_of_a_drive_injects_markup(open_lake, small_drive):
    spoilt = spoil_texts(
        {name: rows for name, rows in small_drive.items() if name in ("stations", "bsm", "drive_findings")}
    )
    lake = {**small_drive, **spoilt, "drives": [{**small_drive["drives"][0], "recording": HOSTILE}]}
    for name in spoilt:
        lake[name] = [{**row, "dataset": "v2v", "subset": "drive-1"} for row in lake[name]]
    page = render_drive(open_lake(**lake), "drive-1", {"lake": HOSTILE})
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert(1)" in page


def test_the_overview_of_drives_alone_shows_nothing_of_carriageways(open_lake, small_drive):
    report = build_report(open_lake(**small_drive), {"lake": "lake"})
    elements = parse(report.html).elements
    sections = [attributes["id"] for tag, attributes in elements if tag == "section"]
    assert sections == ["drives", "ingestion", "provenance", "references"]
    assert "1 drive of instrumented vehicles in the lake" in re.sub(r"\s+", " ", report.html)
    assert LINE in report.html
    assert 'href="drives/drive-1.html"' in report.html
    assert "The lake holds no recordings" not in report.html
    TypeAdapter(Quality).validate_python(report.quality)


def test_drives_stand_beside_carriageways_and_change_nothing_of_them(open_lake, small_lake, small_drive):
    both = build_report(open_lake(**small_lake, **small_drive), {"lake": "lake"})
    alone = build_report(open_lake(**small_lake), {"lake": "lake"})
    changed = {name for name in alone.quality if both.quality[name] != alone.quality[name]}
    assert changed <= {"provenance"}
    assert both.quality.keys() - alone.quality.keys() == {"drives"}
    assert "drives" not in re.sub(r"<style>.*?</style>", "", alone.html, flags=re.DOTALL)
    assert 'id="drives"' in both.html
    assert 'id="verdicts"' in both.html


def make_scores(model: str) -> dict:
    """The scores of a run as its metrics hold them."""
    rows = [asdict(OnboardScore(model, "all", seconds, 7, 2, mae_m=seconds, cell=0.75)) for seconds in (0.5, 1.0)]
    warned = WarningScore(model, 7, 2, 3, 2, 1, 1, 2, 2, 12.5, 1.2, None)
    return {"model": model, "part": "eval", "rows": rows, "warnings": asdict(warned)}


def test_published_scores_stand_beside_measured_ones_and_are_marked(open_lake, small_drive):
    published = [asdict(row) for row in list_published()]
    lake = open_lake(**small_drive)
    report = build_report(lake, {}, drive_scores=[make_scores("ctrv")], published_drive_scores=published)
    found = [(row["model"], row["origin"], row["seconds"]) for row in report.quality["drives"]["scores"]]
    assert found[:2] == [("ctrv", "measured", 0.5), ("ctrv", "measured", 1.0)]
    assert {origin for _, origin, _ in found[2:]} == {"published"}
    rows = re.findall(
        r'<tr class="(excluded)?"><th scope="row">[\w+ -]+</th><td>(measured|published)</td>', report.html
    )
    assert rows[0] == ("", "measured")
    assert set(rows[1:]) == {("excluded", "published")}
    without = build_report(lake, {}, published_drive_scores=published)
    assert without.quality["drives"]["scores"] == []
    assert "own recordings, which are not in this lake" not in without.html


def test_every_key_of_the_figures_is_documented(open_lake, small_drive):
    page = write_quality_page()
    drives = build_report(open_lake(**small_drive), {}, drive_scores=[make_scores("ctrv")]).quality["drives"]
    for name, rows in drives.items():
        assert rows
        documented = set(re.findall(rf"`drives\.{name}\[\]\.(\w+)", page))
        assert {key for row in rows for key in row} == documented
