"""The report's figures, from SQL over a small lake, against values worked out by hand."""

import json
import math
import re

import pytest

from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.rules.registry import ThresholdError
from tracklake.schemas.quality import QUALITY_SCHEMA


def row(rows: list[dict], **wanted) -> dict:
    """The only row that has the wanted values."""
    (found,) = (each for each in rows if all(each[key] == value for key, value in wanted.items()))
    return found


def test_headline(report):
    assert report.quality["headline"] == {
        "datasets": 2,
        "recordings": 2,
        "subsets": 3,
        "vehicles": 4,
        "entries": 7,
        "recorded_s": 70.0,  # one highD recording of 10 s, although it has two carriageways, and 60 s
        "driven_m": 160.0,
        "least_flow_vphpl": 45.0,
        "greatest_flow_vphpl": 90.0,
        "excluded_subsets": 1,
        "vehicles_with_errors": 2,
        "late_starts": 1,
        "eligible_starts": 2,
        "samples": 3,
        "rows_read": 3,
        "rows_dropped": 2,
    }


def test_overview(report):
    subsets = report.quality["subsets"]
    assert [each["subset"] for each in subsets] == ["01-lower", "01-upper", "peachtree-north"]
    assert [each["mean_speed_mps"] for each in subsets] == [25.0, 1.0, 5.0]
    assert [each["flow_vphpl"] for each in subsets] == [90.0, 45.0, None]
    assert [each["vehicles_per_lane_s"] for each in subsets] == [0.1, 0.05, None]
    assert [each["excluded"] for each in subsets] == [False, True, False]
    assert subsets[1]["excluded_reason"] == "1 of 1 vehicles reverse"


def test_findings_per_rule(report):
    rules = {rule["name"]: rule for rule in report.quality["rules"]}
    headway = rules["negative_headway"]
    # The arterial has no gaps: of 3 vehicles and 6 entries that were checked, 1 and 2 break the rule.
    assert headway["total"] == {
        "subsets_checked": 2,
        "subsets_all": 3,
        "runs": 2,
        "vehicles": 1,
        "vehicle_share": pytest.approx(1 / 3),
        "entries": 2,
        "entry_share": pytest.approx(2 / 6),
        "worst": -2.5,
    }
    lower, upper, arterial = headway["subsets"]
    assert (lower["vehicles"], lower["vehicle_share"], lower["entries"], lower["entry_share"]) == (1, 0.5, 2, 0.5)
    assert (upper["vehicles"], upper["vehicle_share"], upper["worst"]) == (0, 0.0, None)
    assert (arterial["vehicles"], arterial["entries"], arterial["subsets_checked"]) == (None, None, 0)
    assert [(each["dataset"], each["vehicles"]) for each in headway["datasets"]] == [("highd", 1), ("ngsim", None)]
    assert rules["backward"]["total"]["vehicle_share"] == 0.25
    # A rule that nothing breaks is a row of zeros, not an absent row.
    assert rules["high_acceleration"]["total"]["vehicles"] == 0
    assert rules["high_acceleration"]["total"]["entry_share"] == 0.0
    # Nor is one that could be checked nowhere a row of zeros: no vehicle has a size, no subset lane markings.
    for name in ("overlap", "implausible_size", "negative_headway_recorded", "outside_lane"):
        assert rules[name]["total"]["vehicles"] is None
        assert rules[name]["total"]["subsets_checked"] == 0


def test_a_rule_was_checked_where_validation_says_so(open_lake, small_lake):
    lower, upper, arterial = small_lake["subset_scores"]
    scores = [{**lower, "rules_unchecked": []}, {**upper, "rules_unchecked": ["overlap"]}, arterial]
    judged = small_lake["subset_status"][:1] + small_lake["subset_status"][2:]
    for status, of_upper in ((small_lake["subset_status"], 1), (judged, 0)):
        lake = open_lake(**{**small_lake, "subset_scores": scores, "subset_status": status})
        rules = {rule["name"]: rule for rule in build_report(lake, {}).quality["rules"]}
        checked = {name: [each["subsets_checked"] for each in rule["subsets"]] for name, rule in rules.items()}
        assert checked["overlap"] == [1, 0, 0]
        assert checked["outside_lane"] == checked["negative_headway"] == [1, of_upper, 0]
        assert checked["backward"] == [1, of_upper, 1]
        assert rules["overlap"]["total"]["vehicles"] == 0


def test_speed_distribution(report):
    summary = report.quality["speeds"]["summary"]
    lower = row(summary, subset="01-lower")
    # Of 10, 20, 30, 40: quantile q lies at 3 q between the sorted values; the sample variance is 500 / 3.
    assert lower["min_mps"] == 10.0
    assert lower["p2_5_mps"] == pytest.approx(10.75)
    assert lower["median_mps"] == 25.0
    assert lower["p97_5_mps"] == pytest.approx(39.25)
    assert lower["max_mps"] == 40.0
    assert lower["mean_mps"] == 25.0
    assert lower["std_mps"] == pytest.approx(math.sqrt(500 / 3))
    assert row(summary, dataset="highd", subset=None)["mean_mps"] == 17.0
    assert row(summary, subset="peachtree-north")["std_mps"] is None
    histogram = report.quality["speeds"]["histogram"]
    assert [(each["dataset"], each["speed_mps"], each["entries"]) for each in histogram] == [
        *(("highd", speed, 1) for speed in (-1, 3, 10, 20, 30, 40)),
        ("ngsim", 5, 1),
    ]
    assert row(histogram, speed_mps=5)["share"] == 1.0
    assert row(histogram, speed_mps=40)["share"] == pytest.approx(1 / 6)


def test_starts(report):
    starts = report.quality["starts"]
    lower = row(starts["subsets"], subset="01-lower")
    assert (lower["cutoff_m"], lower["late"], lower["late_share"], lower["early"]) == (2.0, 1, 0.5, 1)
    assert (lower["windows"], lower["by_regression"]) == (1, 0)
    assert lower["median_estimated_s"] == 2.0  # 50 frames at 25 Hz
    assert lower["window_s"] == 3.0  # frames 25 to 99
    upper = row(starts["subsets"], subset="01-upper")
    assert (upper["cutoff_m"], upper["late_share"], upper["windows"]) == (None, None, 0)
    assert [(each["subset"], each["start_x_m"], each["judged"], each["vehicles"]) for each in starts["positions"]] == [
        ("01-lower", 0, "on time", 1),
        ("01-lower", 30, "late", 1),
        ("01-upper", 2, "not judged", 1),
    ]


def test_samples_and_drops(report):
    (lower,) = report.quality["samples"]["subsets"]
    assert (lower["samples"], lower["vehicles"], lower["dropped"], lower["kept_share"]) == (3, 2, 5, 0.375)
    assert (lower["lane_change_left"], lower["lane_change_right"], lower["brake"]) == (1, 0, 1)
    assert lower["mean_neighbors"] == pytest.approx(1 / 3)
    assert (lower["collisions"], lower["all_collisions"], lower["crowded_out"]) == (2, 5, 1)
    drops = [(each["reason"], each["entries"], each["share"]) for each in report.quality["samples"]["drops"]]
    assert drops == [("history", 4, 0.5), ("future", 1, 0.125)]


def test_splits(report):
    (train,) = report.quality["splits"]["balance"]
    assert (train["part"], train["samples"], train["sample_share"], train["relaxed"]) == ("train", 3, 1.0, True)
    (member,) = report.quality["splits"]["members"]
    assert (member["subset"], member["part"], member["block_s"]) == ("01-lower", "train", 10.0)


def test_parts_stand_in_their_order(open_lake, small_lake):
    balance = small_lake["split_balance"][0]
    lake = open_lake(split_balance=[{**balance, "part": part} for part in ("eval", "train", "val")])
    assert [each["part"] for each in build_report(lake, {}).quality["splits"]["balance"]] == ["train", "val", "eval"]


def test_ingestion(report):
    (file,) = report.quality["ingestion"]["files"]
    assert (file["rows_read"], file["rows_kept"], file["rows_dropped"]) == (3, 1, 2)
    assert file["dropped_by_reason"] == [{"reason": "too few fields", "rows": 2}]
    rejects = report.quality["ingestion"]["rejects"]
    assert [each["line"] for each in rejects] == list(range(2, 12)), "the first ten of a file"
    assert {each["rejects_in_file"] for each in rejects} == {13}


def test_completeness_stands_beside_what_was_announced(report):
    rows = report.quality["completeness"]
    assert len(rows) == 5
    entries = row(rows, recording="01", measure="entries")
    assert (entries["expected"], entries["found"], entries["difference"], entries["rows_dropped"]) == (8, 6, -2, 1)
    assert (entries["found_share"], entries["agrees"]) == (0.75, False)
    assert row(rows, measure="vehicles_incomplete")["found_share"] is None, "0 are expected"
    unknown = row(rows, recording="peachtree")
    assert (unknown["expected"], unknown["found"], unknown["difference"], unknown["agrees"]) == (None,) * 4
    section = re.search(r'<section id="completeness">.*?</section>', report.html, flags=re.DOTALL).group()
    assert re.sub(r"\s+", " ", section).count("2 of 4 figures agree") == 1
    shown = re.findall(r'<th scope="row" class="text">(.*?)</th>\s*<td class="text">(.*?)</td>', section)
    # The trucks agree and are only counted.
    assert shown == [("01", "vehicles"), ("01", "entries"), ("01", "vehicles_incomplete"), ("peachtree", "entries")]
    assert "75.00 %" in section


def test_a_long_reject_is_cut(open_lake):
    reject = {"dataset": "ngsim", "file": "f", "line": 1, "reason": "r", "text": "x" * 5000}
    (shown,) = build_report(open_lake(rejects=[reject]), {}).quality["ingestion"]["rejects"]
    assert (shown["text"], shown["cut"]) == ("x" * 300, True)


def test_what_was_left_out_is_said(report):
    reasons = {(tuple(each["subsets"]), each["reason"].split(":")[0]) for each in report.quality["left_out"]}
    assert reasons == {
        (("peachtree-north",), "arterial"),
        (("peachtree-north",), "the source has no gap_m"),
        (("01-upper",), "excluded"),
        (("01-upper",), "no cut-off could be set"),
    }
    assert "arterial: these stages are defined for freeways only" in report.html
    stages = {each["stage"]: (each["possible"], each["done"]) for each in report.quality["stages"]}
    assert stages == {"validate": (3, 3), "repair": (2, 2), "samples": (1, 1), "split": (1, 1)}


def test_provenance_lists_every_source_file(report):
    assert [each["file"] for each in report.quality["provenance"]["source_files"]] == [
        "01_tracks.csv",
        "pe_tracks.csv",
        "peachtree.csv",
    ]
    assert "settings.seed" in report.html


def test_hashes_and_rejected_rows_are_on_pages_of_their_own(report, open_lake):
    sha256, reject = "0123456789abcdef" * 4, "1,2\\x00"
    assert sha256 in report.others["files.html"]
    assert "too few fields: 2" in report.others["files.html"]
    assert report.others["rejects.html"].count(reject) == 10
    for hidden in (sha256, reject):
        assert hidden not in report.html
    assert 'href="rejects.html"' in report.html
    assert build_report(open_lake(), {}).others.keys() == {"files.html"}, "without rejected rows and splits"


def test_thresholds_of_the_provenance_are_the_report_s(open_lake):
    lake = open_lake()
    html = build_report(lake, {"thresholds": {"high_acceleration_mps2": 4.5}}).html
    assert "4.5 m/s²" in html
    assert "(default 3.05)" in html
    with pytest.raises(ThresholdError, match="unknown name"):
        build_report(lake, {"thresholds": {"nonsense": 1.0}})


def test_scores_stand_beside_their_n(open_lake):
    scores = [
        {"model": "constant velocity", "part": "eval", "rows": [{"seconds": 1, "rmse_m": 0.731, "n": 12345}]},
        {"model": "LSTM", "part": "eval", "rows": [{"seconds": 5.0, "rmse_m": float("nan"), "n": 0}]},
    ]
    centred = {"seconds": 1, "rmse_m": None, "rmse_longitudinal_m": 0.417, "n": 5}
    scores.append({"model": "on lane centres", "part": "eval", "rows": [centred]})
    report = build_report(open_lake(), {}, scores=scores)
    assert ">0.42 <small>along</small><" in report.html
    assert report.quality["model_scores"][1]["rows"] == [{"seconds": 5.0, "rmse_m": None, "n": 0}]
    assert ">0.73<" in report.html
    assert ">12,345<" in report.html
    assert 'id="scores"' not in build_report(open_lake(), {}).html


def test_an_empty_lake_renders(open_lake):
    report = build_report(open_lake(), {})
    assert report.quality["headline"]["vehicles"] == 0
    assert report.quality["headline"]["samples"] is None
    assert "The lake holds no recordings." in report.html
    assert "<svg" not in report.html
    assert {rule["total"]["vehicles"] for rule in report.quality["rules"]} == {None}


def test_stages_that_have_not_run_are_said_to(open_lake, small_lake):
    tables = small_lake
    ingested = {name: tables[name] for name in ("tracks", "vehicles", "subsets", "ingest_log", "rejects")}
    report = build_report(open_lake(**ingested), {})
    for command, subsets in (("validate", 3), ("repair", 2), ("samples", 2), ("split", 2)):
        assert f"<code>tracklake {command}</code> has not worked on any of the {subsets} subsets" in report.html
    assert report.quality["headline"]["excluded_subsets"] is None
    assert {rule["total"]["vehicles"] for rule in report.quality["rules"]} == {None}


def test_an_arterial_alone_renders_without_the_freeway_stages(open_lake, small_lake):
    tables = {
        name: [each for each in rows if each["dataset"] == "ngsim"]
        for name, rows in small_lake.items()
        if name not in ("splits", "split_balance")
    }
    report = build_report(open_lake(**tables), {})
    assert report.html.count("No subset of this lake takes part in this stage") == 3
    assert report.quality["speeds"]["histogram"]


def test_quality_json_is_strict_and_says_what_it_is(report):
    def refuse(constant):
        raise AssertionError(constant)

    read = json.loads(report.json, parse_constant=refuse)
    assert read == report.quality
    assert read["schema"] == QUALITY_SCHEMA == "tracklake/quality/1"


@pytest.mark.usefixtures("convert_again")
def test_the_same_lake_gives_the_same_bytes(open_lake, small_lake):
    one, two = (build_report(open_lake(**small_lake), {}) for _ in range(2))
    reversed_rows = build_report(open_lake(**{name: rows[::-1] for name, rows in small_lake.items()}), {})
    assert one.html == two.html == reversed_rows.html
    assert one.json == two.json == reversed_rows.json
