"""The report's pages in a headless browser: they load without errors at every width, fold, sort and filter."""

from pathlib import Path

import pytest
from browser import Browser
from page_elements import SCRIPT

from tracklake.quality_reports.pages.comparison import render_comparison
from tracklake.quality_reports.pages.lake_differences import Side, compare
from tracklake.quality_reports.pages.rendering import DASH
from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.pages.subsets import render_pages

RECORDINGS = 60
SCREEN = 800


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """One browser for all checks."""
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def large(open_lake, small_lake, tmp_path_factory) -> Path:
    """The folder of a report on 60 recordings of two carriageways; vehicles grow from 2 with the recording's number."""
    tables = {}
    for name, rows in small_lake.items():
        of_highd = [row for row in rows if row.get("subset", row.get("recording", "01"))[:2] == "01"]
        tables[name] = [rename(row, number) for number in range(1, RECORDINGS + 1) for row in of_highd]
        if "subset" not in rows[0] and "recording" not in rows[0]:
            tables[name] = rows
    for row in tables["subsets"]:
        row["vehicles"] += int(row["recording"])
    tables["ingest_log"] = [
        {**small_lake["ingest_log"][0], "file": f"{number:02d}_tracks.csv", "rows_dropped": number % 2}
        for number in range(3 * RECORDINGS)
    ]
    tables["split_recipes"] = [
        {"split": split, "parameters": "{}", "trains": trains, "claims_no_leakage": trains, "meaning": "an example"}
        for split, trains in (("flow-balanced", True), ("csp-2018", False))
    ]
    folder = tmp_path_factory.mktemp("report")
    lake = open_lake(**tables)
    report = build_report(lake, {"lake": "large"})
    compared = compare(Side(open_lake(**small_lake), {"lake": "small"}), Side(lake, {"lake": "large"}))
    for name, page in {"index.html": report.html, "compare.html": render_comparison(compared), **report.others}.items():
        (folder / name).write_text(page, encoding="utf-8")
    return folder


def rename(row: dict, number: int) -> dict:
    """A row of recording 01 as one of another recording."""
    return {
        name: f"{number:02d}{value[2:]}" if name in ("subset", "recording") else value for name, value in row.items()
    }


@pytest.mark.parametrize(("width", "dark"), [(400, True), (1280, False), (1920, True)])
def test_an_overview_of_120_subsets_takes_ten_screens_at_most(browser, large, width, dark):
    browser.open(large / "index.html", width=width, height=SCREEN, dark=dark)
    assert browser.run("document.documentElement.scrollHeight") <= 10 * SCREEN
    assert browser.run("document.documentElement.scrollWidth") <= width, "the page does not scroll sideways"
    assert browser.run("getComputedStyle(document.body).backgroundColor") == (
        "rgb(20, 23, 26)" if dark else "rgb(255, 255, 255)"
    )
    assert browser.errors == []


def test_a_section_unfolds_where_the_address_leads(browser, large):
    browser.open(large / "index.html")
    opened = "document.querySelector('#speeds > details').open"
    assert browser.run(opened) is False
    browser.run("document.querySelector('nav a[href=\"#speeds\"]').click()")
    assert browser.run(f"new Promise(done => setTimeout(() => done({opened}), 50))") is True
    contents = "document.querySelector('nav').getBoundingClientRect().top"
    assert browser.run(f"scrollTo(0, 500), {contents}") == 0, "the contents stay in view"
    everything = "[...document.querySelectorAll('details')].every(each => each.open)"
    browser.run("[...document.querySelectorAll('nav button')][0].click()")
    assert browser.run(everything) is True
    browser.run("[...document.querySelectorAll('nav button')][0].click()")
    assert browser.run(everything) is False
    browser.run("dispatchEvent(new Event('beforeprint'))")
    assert browser.run(everything) is True, "paper shows everything"
    assert browser.errors == []


def test_tables_are_sorted_and_filtered(browser, large):
    browser.open(large / "index.html")
    rows = "[...document.querySelector('#overview table').tBodies[0].rows]"
    names = f"{rows}.filter(row => !row.hidden).map(row => row.cells[0].textContent.trim())"
    heads = "[...document.querySelector('#overview table').tHead.rows[0].cells]"
    vehicles = f"{heads}.find(head => head.textContent.trim() === 'Vehicles')"
    assert browser.run(f"{names}.length") == 2 * RECORDINGS
    browser.run(f"{vehicles}.querySelector('button').click()")
    # Recording n has n + 2 vehicles on the lower and n + 1 on the upper carriageway.
    assert browser.run(names)[:3] == ["60-lower", "59-lower", "60-upper"]
    assert browser.run(f"{vehicles}.getAttribute('aria-sort')") == "descending"
    browser.run(f"{vehicles}.querySelector('button').click()")
    assert browser.run(names)[:2] == ["01-upper", "01-lower"]
    browser.run(f"{heads}[0].querySelector('button').click()")
    assert browser.run(names)[-1] == "60-upper", "names are sorted as names, and not as numbers"
    browser.run(
        "{const input = document.querySelector('#overview .filter input'); input.value = '0 upper';"
        "input.dispatchEvent(new Event('input'))}"
    )
    assert {name[3:] for name in browser.run(names)} == {"upper"}
    assert browser.errors == []


def test_sums_stay_first_and_published_rows_beneath_theirs(browser, tmp_path):
    page = build_report_page(
        [
            ("sum", "all", "9"),
            ("", "b", "1,200.00 <small>4,320.0</small>"),
            ("follows", "published", "7"),
            ("", "a", DASH),
            ("", "c", "\u22123.5"),
        ]
    )
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    browser.open(tmp_path / "page.html")
    names = "[...document.querySelectorAll('tbody th')].map(cell => cell.textContent)"
    button = "document.querySelectorAll('thead button')[1].click()"
    browser.run(button)
    assert browser.run(names) == ["all", "b", "published", "c", "a"]
    browser.run(button)
    assert browser.run(names) == ["all", "c", "b", "published", "a"], "what is unknown stays last"
    assert browser.errors == []


def build_report_page(rows: list[tuple[str, str, str]]) -> str:
    """A page of one table, with the script that every page has."""
    body = "".join(f'<tr class="{kind}"><th>{name}</th><td class="n">{value}</td></tr>' for kind, name, value in rows)
    table = f'<div class="box"><table><thead><tr><th>Name</th><th class="n">Value</th></tr></thead><tbody>{body}'
    return f'<meta charset="utf-8">{table}</tbody></table></div><script>{SCRIPT.read_text(encoding="utf-8")}</script>'


def test_without_a_script_everything_is_shown(browser, large):
    browser.open(large / "index.html", script=False)
    assert browser.run("[...document.querySelectorAll('details')].every(each => each.open)") is True
    assert browser.run("document.querySelectorAll('thead button').length") == 0


OVERFLOWING = """
    [...document.querySelectorAll("body *:not(svg *)")].filter((element) =>
        element.clientWidth > 0 && element.scrollWidth > element.clientWidth + 1
        && getComputedStyle(element).overflowX === "visible").map((element) => element.outerHTML.slice(0, 80))
"""
"""Elements whose content reaches beyond them and that do not scroll."""


@pytest.mark.parametrize("kind", ["index", "splits", "files", "rejects", "compare", "page"])
def test_every_kind_of_page_loads_and_fits_at_every_width(browser, large, scene, kind):
    path = scene if kind == "page" else large / f"{kind}.html"
    for width in (400, 1280, 1920):
        for dark in (False, True):
            browser.open(path, width=width, height=SCREEN, dark=dark)
            at = f"{kind} at {width} px, {'dark' if dark else 'light'}"
            assert browser.run("document.documentElement.scrollWidth") <= width, at
            assert browser.run(OVERFLOWING) == [], at
            assert browser.errors == [], at


@pytest.fixture(scope="module")
def scene(open_lake, small_lake, tmp_path_factory) -> Path:
    """The page of 01-lower for 20 s at 25 Hz: vehicle 2 drives 1 m behind the front of vehicle 1, which is 4 m long."""
    where = {"dataset": "highd", "subset": "01-lower"}
    tracks = [
        {**where, "vehicle_id": vehicle, "frame": frame, "time_s": (frame - 1) / 25, "x_m": frame * 0.4 - vehicle,
         "y_m": 2.0, "lane": 1, "speed_mps": 10.0, "accel_mps2": 0.0}
        for vehicle in (1, 2)
        for frame in range(1, 501)
    ]  # fmt: skip
    vehicles = [
        {**where, "vehicle_id": vehicle, "length_m": 4.0, "width_m": 1.8, "start_x_m": 0.0, "end_x_m": 200.0}
        for vehicle in (1, 2)
    ]
    overlap = {**where, "rule": "overlap", "severity": "error", "first_frame": 250, "last_frame": 255, "entries": 6}
    subsets = [{**row, "first_frame": 1, "last_frame": 500} for row in small_lake["subsets"]]
    findings = [{**overlap, "vehicle_id": vehicle, "worst": 1.0} for vehicle in (1, 2)]
    lake = open_lake(**{**small_lake, "tracks": tracks, "vehicles": vehicles, "subsets": subsets, "findings": findings})
    folder = tmp_path_factory.mktemp("scene")
    (folder / "page.html").write_text(dict(render_pages(lake, {}))["01-lower.html"], encoding="utf-8")
    return folder / "page.html"


@pytest.mark.parametrize(("width", "dark"), [(400, True), (1280, False), (1920, True)])
def test_a_finding_is_watched_with_both_vehicles_of_an_overlap_in_view(browser, scene, width, dark):
    browser.open(scene, width=width, height=SCREEN, dark=dark)
    report, clock = (
        "document.querySelector('.player .note').textContent",
        "document.querySelector('output').textContent",
    )
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run(report) == "2 vehicles on the road"
    ends = "((each) => [each.left, each.right])(({}).getBoundingClientRect())"
    left, right = browser.run(ends.format("document.querySelector('.plan')"))
    for number in (0, 1):
        begin, end = browser.run(ends.format(f"document.querySelectorAll('.plan .own path')[{number}]"))
        assert left < begin < end < right, "the plan view shows both, too"
    browser.run("document.querySelector('[data-finding]').click()")
    # 5 s before frame 250, at the scene before: frame 125, 4.96 s after the first.
    assert 4.9 <= float(browser.run(clock).split()[0]) <= 5.3
    said = browser.run(report)
    assert "vehicle 1: 36 km/h (10.0 m/s)" in said
    assert "vehicle 2: 36 km/h (10.0 m/s)" in said
    assert "out of view" not in said
    later = browser.run(f"new Promise(done => setTimeout(() => done({clock}), 600))")
    assert float(later.split()[0]) > 5.2, "it plays"
    assert browser.errors == []


def test_the_player_is_steered_by_keys_and_by_its_slider(browser, scene):
    browser.open(scene)
    clock = "document.querySelector('output').textContent"
    press = "document.querySelector('canvas').dispatchEvent(new KeyboardEvent('keydown', {{key: '{}'}}))"
    start = float(browser.run(clock).split()[0])
    browser.run(press.format("ArrowRight"))
    assert float(browser.run(clock).split()[0]) == pytest.approx(start + 0.2, abs=0.01)
    browser.run(
        "{const slider = document.querySelector('.player input'); slider.value = 50;"
        "slider.dispatchEvent(new Event('input'))}"
    )
    assert float(browser.run(clock).split()[0]) == pytest.approx(start + 10, abs=0.01)
    label = "[...document.querySelectorAll('.player button')][0].textContent"
    browser.run(press.format(" "))
    assert browser.run(label) == "Pause"
    browser.run(press.format(" "))
    assert browser.run(label) == "Play"
    assert browser.errors == []


@pytest.mark.parametrize(("width", "dark"), [(400, True), (1280, False), (1920, True)])
def test_time_space_diagrams_are_zoomed_moved_and_read(browser, scene, width, dark):
    browser.open(scene, width=width, height=SCREEN, dark=dark)
    shown, hint = (f"document.querySelector('.diagrams {name}').textContent" for name in ("output", ".hint"))
    canvas = "document.querySelector('.diagrams canvas')"
    assert browser.run(f"{canvas}.clientHeight") >= 332, "300 pixels and the axes"
    browser.run(f"{canvas}.scrollIntoView({{block: 'center', behavior: 'instant'}})")
    browser.run("new Promise(done => setTimeout(done, 100))")
    # 20 s and 200.6 m, of which vehicle 1 drives 0.4 m per frame and is at 100 m after 10 s, in the middle.
    whole = browser.run(shown)
    assert whole == "0 to 20 s, \u22122 to 199 m"
    at = f"{canvas}.getBoundingClientRect()"
    x, y, w = browser.run(f"(r => [r.left, r.top, r.width])({at})")
    middle = {"x": x + 46 + (w - 54) / 2, "y": y + 8 + 154}
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", **middle)
    said = browser.run(hint)
    assert "36 km/h (10.0 m/s)" in said
    assert "vehicle 1 at " in said or "vehicle 2 at " in said
    assert browser.run(hint).startswith("overlap of vehicle ")
    label = "[...document.querySelectorAll('.diagrams button')]"
    browser.run(f"{label}[1].click()")
    assert browser.run(shown) == "5 to 15 s, \u22122 to 199 m"
    for kind, by in (("mousePressed", 0), ("mouseMoved", (w - 54) / 5), ("mouseReleased", (w - 54) / 5)):
        place = {"x": middle["x"] + by, "y": middle["y"]}
        browser.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **place)
    assert browser.run(shown) == "3 to 13 s, \u22122 to 199 m"
    browser.run(f"{canvas}.dispatchEvent(new WheelEvent('wheel', {{ctrlKey: true, deltaY: -200, cancelable: true}}))")
    assert browser.run(shown) != "3 to 13 s, \u22122 to 199 m"
    browser.run(f"{canvas}.dispatchEvent(new KeyboardEvent('keydown', {{key: '0'}}))")
    assert browser.run(shown) == whole
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.errors == []


def test_without_a_script_a_subset_page_hides_the_player_and_the_diagrams_alone(browser, scene):
    browser.open(scene, script=False)
    hidden = "['.player', '.diagrams', '[data-finding]'].every(each => document.querySelector(each).hidden)"
    assert browser.run(hidden)
    assert browser.run("document.querySelectorAll('.example .plan').length") > 0
