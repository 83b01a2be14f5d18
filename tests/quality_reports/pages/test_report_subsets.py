"""The subsets' pages and the tables beside published figures: from SQL over small lakes, by hand."""

import base64
import json
import re
import struct

import pytest
from page_elements import HOSTILE, parse, spoil_texts

from tracklake.quality_reports.pages.appendix import compare_speeds, count_errors
from tracklake.quality_reports.pages.examples import (
    ask_for_examples,
    choose_moment,
    declare_rule,
    describe_examples,
    write_sql,
)
from tracklake.quality_reports.pages.page_names import name_pages
from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.pages.subsets import choose_interval, render_pages
from tracklake.quality_reports.plots.rasters import make_palette
from tracklake.quality_reports.published import list_published
from tracklake.quality_reports.rules.registry import RULES
from tracklake.quality_reports.summaries import query

WHERE = {"dataset": "highd", "subset": "01-lower"}


def render(lake, provenance=None) -> dict[str, str]:
    return dict(render_pages(lake, provenance or {}))


def read_json(html: str, name: str) -> dict:
    """Read the data of one of the page's scripts."""
    (text,) = re.findall(rf'<script type="application/json" id="{name}">([^<]*)</script>', html)
    return json.loads(text)


def words(html: str) -> str:
    """What a reader sees, with single blanks."""
    shown = re.sub(r"<(style|svg)\b.*?</\1>", " ", html, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", shown))


def driving(vehicle: int, frames: range, lane: int | None, x_m: float, speed: float) -> list[dict]:
    """A vehicle at constant speed at 25 Hz: at x_m in its first frame."""
    return [
        {
            **WHERE,
            "vehicle_id": vehicle,
            "frame": frame,
            "time_s": (frame - 1) / 25,
            "x_m": round(x_m + (frame - frames[0]) * speed / 25, 3),
            "y_m": 0.0,
            "lane": lane,
            "speed_mps": speed,
            "accel_mps2": 0.0,
        }
        for frame in frames
    ]


def a_finding(rule: str, vehicle: int, first: int, last: int, worst: float, severity: str = "error") -> dict:
    about = {"rule": rule, "severity": severity, "vehicle_id": vehicle, "first_frame": first, "last_frame": last}
    return {**WHERE, **about, "entries": last - first + 1, "worst": worst}


@pytest.fixture(scope="module")
def road(small_lake) -> dict[str, list[dict]]:
    """The small lake with traffic on 01-lower: vehicle 1 in lane 1 at 20 m/s, 2 from lane 2 to 1 at 10 m/s."""
    tracks = [
        *driving(1, range(1, 51), 1, 0.0, 20.0),
        *driving(2, range(1, 26), 2, 0.0, 10.0),
        *driving(2, range(26, 51), 1, 10.0, 10.0),
    ]
    return {
        **small_lake,
        "tracks": tracks + [row for row in small_lake["tracks"] if row["subset"] != "01-lower"],
        "findings": [
            a_finding("negative_headway", 1, 3, 7, -2.5),
            a_finding("negative_headway", 1, 20, 21, -9.0),
            a_finding("negative_headway", 2, 30, 30, -4.0),
            a_finding("high_acceleration", 2, 10, 11, 5.0, "warning"),
        ],
        "subset_scores": [
            {
                **WHERE,
                "entries": 100,
                "rules_unchecked": ["outside_lane"],
                "share_without_error": 0.92,
                "share_without_warning": 0.9,
                "vehicles_without_error": 0.0,
                "vehicles_without_warning": 0.0,
                "speed_rms_mps": 0.125,
                "spacings": 0,
            }
        ],
        "vehicle_scores": [
            {
                **WHERE,
                "vehicle_id": 1,
                "entries": 50,
                "share_without_error": 0.86,
                "share_without_warning": 0.86,
            },
            {**WHERE, "vehicle_id": 2, "entries": 50, "share_without_error": 1.0, "share_without_warning": 1.0},
        ],
    }


def test_every_subset_has_a_page_and_the_overview_leads_there(open_lake, small_lake):
    lake = open_lake(**small_lake)
    report = build_report(lake, {})
    pages = dict(render_pages(lake, {}))
    assert list(pages) == ["01-lower.html", "01-upper.html", "peachtree-north.html"]
    for name, html in pages.items():
        elements = parse(html).elements
        assert f'href="subsets/{name}"' in report.html
        links = {attributes["href"] for tag, attributes in elements if tag == "a"}
        ids = [attributes["id"] for _, attributes in elements if "id" in attributes]
        assert len(ids) == len(set(ids))
        assert {link for link in links if not link.startswith("#")} == {"../index.html", "../index.html#provenance"}
        assert {link[1:] for link in links if link.startswith("#")} <= set(ids)


def test_pages_fetch_nothing(open_lake, road):
    for html in render(open_lake(**road)).values():
        for tag, attributes in parse(html).elements:
            assert tag not in {"script", "link", "img", "image", "iframe"}
            assert not {"src", "srcset", "xlink:href"} & attributes.keys()
        assert set(re.findall(r"url\(.", html)) <= {"url(#"}, "but to the legend's gradient, in the page"
        assert set(re.findall(r"https?://[^\s\"'<>)]+", html)) <= {
            "http://www.w3.org/2000/svg",
            "http://www.w3.org/1999/xlink",
        }


def test_no_name_injects_markup_into_a_page(open_lake, road):
    lake = open_lake(**spoil_texts(road))
    pages = render(lake, {"lake": HOSTILE, "created": HOSTILE})
    assert len(pages) == 3
    for name, html in pages.items():
        assert re.fullmatch(r"[A-Za-z0-9._~-]+\.html", name)
        elements = parse(html).elements
        assert not {tag for tag, _ in elements} & {"script", "img", "iframe", "object", "embed", "link", "form"}
        assert not [attribute for _, attributes in elements for attribute in attributes if attribute.startswith("on")]
        assert "&lt;script&gt;alert(1)" in html
    lower = next(html for name, html in pages.items() if "01-lower" in html and "negative_headway" in html)
    assert "\u202e" not in re.sub(r"<svg.*?</svg>|<code>.*?</code>", "", lower, flags=re.DOTALL)


def test_an_empty_lake_has_no_pages(open_lake):
    assert render(open_lake()) == {}


def test_a_source_without_lanes_has_one_diagram(open_lake, road):
    unlaned = [{**row, "lane": None} for row in road["tracks"] if row["subset"] == "01-lower"]
    html = render(open_lake(**{**road, "tracks": unlaned}))["01-lower.html"]
    segments = read_json(html, "tracks")["segments"]
    assert {head[0] for head in struct.iter_unpack("<5i", base64.b64decode(segments))} == {-1}
    assert "None is recorded" in html


def test_diagrams_axes_and_units(open_lake, road):
    html = render(open_lake(**road))["01-lower.html"]
    content = read_json(html, "tracks")
    assert {head[0] for head in struct.iter_unpack("<5i", base64.b64decode(content["segments"]))} == {1, 2}
    assert (content["x_m"], content["top_mps"]) == ([0.0, 39.2], 20.0)
    for title in (
        "flow (veh/h/lane)",
        "density (veh/km)",
        "speed (m/s)",
        "time (s)",
        "recorded speed (m/s, below in km/h)",
        "share of entries (%)",
        "x of the first entry (m)",
    ):
        assert title in html, title


def test_only_errors_are_marked(open_lake, road):
    html = render(open_lake(**road))["01-lower.html"]
    marks = read_json(html, "tracks")["marks"]
    assert [mark[4:] for mark in marks] == [["negative_headway", 1], ["negative_headway", 1], ["negative_headway", 2]]
    # Frames 3 to 7, 20 and 21, and 30; a point every 5 frames, in which vehicle 1 drives 4 m and vehicle 2 2 m.
    assert [mark[:4] for mark in marks] == [[1, 1, 3.2, 1], [1, 4, 15.2, 1], [1, 6, 11.6, 1]]


def test_flow_is_edies(open_lake, road):
    # An interval of 5 s of the 10 s recorded; the section is 0 to 39.2 m. Lane 2: 25 entries at 10 m/s.
    asked = {"datasets": [WHERE["dataset"]], "subsets": [WHERE["subset"]], "seconds": [5.0]}
    rows = query(open_lake(**road), "subset_flow", asked)
    lane_2 = next(row for row in rows if row["lane"] == 2 and row["interval"] == 0)
    assert lane_2["flow_veh_per_h"] == pytest.approx(3600 * (25 * 10 / 25) / (39.2 * 5))
    assert lane_2["density_veh_per_km"] == pytest.approx(1000 * (25 / 25) / (39.2 * 5))
    assert lane_2["speed_mps"] == pytest.approx(10.0)
    assert [choose_interval(seconds) for seconds in (10, 75, 150, 899, 900)] == [5, 5, 10, 30, 60]


def test_speeds_and_lane_changes_of_a_subset(open_lake, road):
    lake = open_lake(**road)
    whole, lane_1, lane_2 = (row for row in query(lake, "subset_speeds") if row["subset"] == "01-lower")
    assert (whole["whole"], whole["entries"], whole["mean_mps"]) == (True, 100, 15.0)
    assert (lane_1["lane"], lane_1["entries"], lane_1["mean_mps"]) == (1, 75, pytest.approx((50 * 20 + 250) / 75))
    assert (lane_2["lane"], lane_2["min_mps"], lane_2["max_mps"]) == (2, 10.0, 10.0)
    (change,) = query(lake, "subset_lane_changes")
    assert (change["from_lane"], change["to_lane"], change["direction"]) == (2, 1, "left")
    assert (change["changes"], change["vehicles"]) == (1, 1)


def test_the_worst_of_each_vehicle_comes_first_and_its_sql_shows_its_entries(open_lake, road):
    lake = open_lake(**road)
    rules = [declare_rule(rule, rule.unit) for rule in RULES if rule.name in ("high_acceleration", "negative_headway")]
    found = describe_examples(query(lake, "subset_worst", ask_for_examples(rules)), rules, 25.0)
    assert [(each["rule"], each["vehicle_id"], each["worst"], each["partner"]) for each in found] == [
        ("high_acceleration", 2, 5.0, None),
        ("negative_headway", 1, -9.0, "leader"),
        ("negative_headway", 2, -4.0, "leader"),
    ]
    frames = [row["frame"] for row in lake.execute(found[1]["sql"]).pl().to_dicts()]
    assert frames == [20, 21]


def test_an_overlap_is_listed_once_and_its_scene_drawn_once(open_lake, road):
    pair = [a_finding("overlap", vehicle, 40, 41, 1.5) for vehicle in (1, 2)]
    gap = [{**a_finding("negative_headway", 2, 40, 41, -1.5)}]
    tracks = [{**row, "leader_id": 1 if row["vehicle_id"] == 2 else None} for row in road["tracks"]]
    box = {"length_m": 40.0, "width_m": 2.0, "start_x_m": 0.0, "end_x_m": 40.0}
    sizes = [{**WHERE, "vehicle_id": vehicle, **box} for vehicle in (1, 2)]
    html = render(open_lake(**{**road, "tracks": tracks, "vehicles": sizes, "findings": pair + gap}))["01-lower.html"]
    assert html.count('<figure class="example"') == 2
    assert html.count('<svg class="plan"') == 1
    assert 'The scene is drawn <a href="#example-1">above</a>' in html
    assert "Frame 40: vehicle 1: 72 km/h (20.0 m/s) at 31 m, lane 1; vehicle 2: 36 km/h (10.0 m/s) at 16 m" in html
    assert '"vehicles":[1,2]' in html, "the player keeps both in view"


def test_the_moment_shown_is_the_middle_of_the_first_seconds():
    found = {"first_frame": 100, "last_frame": 110, "entries": 11}
    assert choose_moment(found, 125) == 105
    assert choose_moment({**found, "last_frame": 1099, "entries": 1000}, 125) == 162
    assert choose_moment({**found, "entries": 10}, 125) == 100, "a frame in between may be missing"


def test_sql_quotes_names(open_lake, road):
    spoilt = "it's '01'; --"
    tracks = [{**row, "subset": spoilt} for row in road["tracks"] if row["subset"] == "01-lower"]
    sql = write_sql({"dataset": "highd", "subset": spoilt, "vehicle_id": 2, "first_frame": 25, "last_frame": 27})
    shown = open_lake(tracks=tracks).execute(sql).pl()
    assert shown["frame"].to_list() == [25, 26, 27]
    assert set(shown["vehicle_id"]) == {2}


def test_a_page_says_what_is_known_of_its_subset(open_lake, road):
    pages = {name: words(html) for name, html in render(open_lake(**road)).items()}
    lower, upper, arterial = pages["01-lower.html"], pages["01-upper.html"], pages["peachtree-north.html"]
    assert "negative_headway error 2 100.00 % 8 200.00 %" in lower, "8 findings' entries of the 4 that `subsets` tells"
    assert "Entries without error 92.00 % nor with a warning: 90.00 %" in lower
    assert "Speed 0.125 m/s (0.45 km/h)" in lower
    assert "Not checked: outside_lane." in lower
    assert "The least feasible 1 of 1 vehicles" in lower
    assert "Cut-off 2 m; 1 of 2 judged starts are late (50.00 %)" in lower
    assert "The longest 1 of 1" in lower
    assert "31.00 100 40.00 144.0 mean_speed 1 2.00 0.50 25 3.00" in lower, "the repair window of vehicle 2"
    assert "history csp 4" in lower
    assert "1 of 1 vehicles reverse" in upper
    assert "excluded: 1 of 1 vehicles reverse" in upper
    assert "arterial: these stages are defined for freeways only" in arterial
    assert "Starts are judged on freeways only." in arterial
    assert "Not scored" in arterial


def test_pages_get_safe_names_of_their_own():
    names = ["01-upper", "a/b", "..", ".x", "A", "a", "ä b", "x" * 300, "x" * 301, "", "a%2Fb"]
    found = name_pages([{"dataset": "ngsim", "subset": name} for name in names])
    files = list(found.values())
    assert found["ngsim", "01-upper"] == "01-upper.html"
    assert found["ngsim", "a/b"] == "a~2fb.html"
    assert found["ngsim", ".."] == "~2e..html"
    assert len({file.lower() for file in files}) == len(names)
    for file in files:
        assert re.fullmatch(r"(?!\.)[A-Za-z0-9._~-]+\.html", file)
        assert len(file) < 120
    both = name_pages([{"dataset": dataset, "subset": "01"} for dataset in ("highd", "ngsim")])
    assert len(set(both.values())) == 2


def test_speeds_are_averaged_per_vehicle_and_second(open_lake):
    def entry(vehicle, frame, speed):
        return {**WHERE, "vehicle_id": vehicle, "frame": frame, "time_s": frame / 10, "x_m": 0.0, "y_m": 0.0} | {
            "speed_mps": speed
        }

    # Vehicle 1: 10 and 20 in second 0, 40 in second 1; vehicle 2: 5 in second 1. 0.3 * 10 / 10 and the like included.
    tracks = [entry(1, 0, 10.0), entry(1, 9, 20.0), entry(1, 10, 40.0), entry(2, 19, 5.0)]
    whole, subset = build_report(open_lake(tracks=tracks), {}).quality["speeds"]["per_second"]
    assert (whole["subset"], subset["subset"]) == (None, "01-lower")
    for row in (whole, subset):
        assert (row["seconds"], row["min_mps"], row["median_mps"], row["max_mps"], row["mean_mps"]) == (
            3,
            5,
            15,
            40,
            20,
        )


def test_recordings_stand_beside_what_is_announced(report):
    rows = {row["recording"]: row for row in report.quality["recordings"]}
    assert list(rows) == ["01", "peachtree"]
    first = rows["01"]
    assert (first["subsets"], first["vehicles"], first["entries"], first["seconds"]) == (2, 3, 6, 10.0)
    assert (first["vehicles_announced"], first["vehicles_announced_by"]) == (3, "recordingMeta")
    assert (first["entries_announced"], first["entries_found_share"]) == (8, 0.75)
    assert rows["peachtree"]["entries_announced"] is None


def test_the_published_figures_add_up():
    published = list_published()
    whole = {figures["dataset"]: figures for figures in published if figures["recording"] is None}
    parts = [figures for figures in published if figures["dataset"] == "ngsim" and figures["recording"] is not None]
    assert len(parts) == 6
    for name in (
        "vehicles",
        "entries",
        "headway_vehicles",
        "headway_entries",
        "acceleration_entries",
        "slow_vehicles",
    ):
        assert sum(part[name] for part in parts) == whole["ngsim"][name], name
    # As Hamalainen (2020) says of all: 10.51 % of the vehicles with negative headways, 3.30 % at low constant speeds.
    assert f"{whole['ngsim']['headway_vehicles'] / whole['ngsim']['vehicles']:.2%}" == "10.51%"
    assert f"{whole['ngsim']['slow_vehicles'] / whole['ngsim']['vehicles']:.2%}" == "3.30%"


def open_us_101(open_lake, small_lake, *, vehicles=2169, entries=1180598, origin="recorded"):
    """A lake with one entry of the recording, which is said to hold so many vehicles and entries."""
    known = {"dataset": "ngsim", "subset": "us-101-0750"}
    announced = {"dataset": "ngsim", "recording": "us-101-0750", "authority": "published"}
    arterial = next(row for row in small_lake["subsets"] if row["dataset"] == "ngsim")
    facts = {"recording": "us-101-0750", "freeway": True, "columns_missing": [], "origin": origin}
    return open_lake(
        tracks=[{**known, "vehicle_id": 1, "frame": 1, "time_s": 0.0, "x_m": 0.0, "y_m": 0.0, "speed_mps": 5.0}],
        subsets=[{**arterial, **known, **facts}],
        subset_status=[{**known, "backward_vehicles": 0, "excluded": False}],
        findings=[{**a_finding("low_constant_speed", 1, 1, 1, 1.0, "warning"), **known}],
        completeness=[
            {**announced, "measure": "vehicles", "expected": 2169, "found": vehicles},
            {**announced, "measure": "entries", "expected": 1180598, "found": entries},
        ],
    )


def test_published_figures_stand_beneath_complete_recordings(open_lake, small_lake, report):
    assert not [row for row in compare_speeds(report.quality) if row["is_published"]], "no known recording"
    page = build_report(open_us_101(open_lake, small_lake), {})
    speeds = [(row["label"], row["median_mps"]) for row in compare_speeds(page.quality)]
    assert speeds == [("all of ngsim", 5.0), ("us-101-0750", 5.0), ("published", 11.96)], "of one of six recordings"
    *_, found, published = count_errors(page.quality)
    assert (found["slow_vehicles"], found["slow_vehicle_share"]) == (1, 1.0)
    assert (published["slow_vehicles"], published["slow_vehicle_share"]) == (13, 13 / 2169)
    assert (published["headway_entries"], published["headway_entry_share"]) == (1912, 1912 / 1180598)
    assert published["acceleration_vehicles"] is None
    assert '<th scope="row">published</th>' in page.html
    assert "left out" not in page.html.partition('id="speeds"')[2].partition("</section>")[0]
    assert 'class="banner"' not in page.html


@pytest.mark.parametrize(
    ("held", "reason"),
    [
        ({"vehicles": 290, "entries": 155_604}, "the lake holds 290 of 2,169 vehicles and 155,604 of 1,180,598 rows"),
        ({"entries": 1_180_597}, "the lake holds 1,180,597 of 1,180,598 rows"),
        ({"entries": 1_180_600}, "the lake holds 1,180,600 of 1,180,598 rows"),
        ({"origin": "synthetic"}, "it is synthetic"),
    ],
)
def test_an_excerpt_or_a_synthetic_recording_has_no_published_figures_beneath_it(open_lake, small_lake, held, reason):
    page = build_report(open_us_101(open_lake, small_lake, **held), {})
    assert page.quality["published"]["figures"] == []
    assert [row["label"] for row in compare_speeds(page.quality)] == ["all of ngsim", "us-101-0750"]
    assert f"The published figures of us-101-0750 are left out: {reason}." in page.html
    assert ('class="banner"' in page.html) == ("origin" in held)


def test_every_colour_of_our_own_drawings_follows_the_theme(open_lake, road):
    html = render(open_lake(**road))["01-lower.html"]
    style = re.search(r"<style>(.*?)</style>", html, flags=re.DOTALL).group(1)
    drawings = re.findall(r'<svg role="img" aria-label.*?</svg>', html, flags=re.DOTALL)
    used = set(re.findall(r"(?:fill|stroke)=\"([^\"]+)\"", "".join(drawings))) - {"none"}
    assert used >= {"#0072b2", "#d55e00"}
    speeds = {f"#{bytes(colour[:3]).hex()}" for colour in make_palette()}
    for colour in used - speeds:
        assert f'[fill="{colour}"]' in style, f"{colour} would be the same on light and dark"
