"""Figures about reconstructed tracks, counted by hand, and where the pages show them."""

import pytest

from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.reconstruction import collect_reconstruction, describe_reconstruction

UPPER, LOWER, STREET = (("highd", "01-upper"), ("highd", "01-lower"), ("ngsim", "street"))


def row(key, **values):
    return {"dataset": key[0], "subset": key[1], **values}


def quality(key, **changed):
    usual = {
        "vehicles": 3, "vehicles_reconstructed": 3, "entries": 90, "imputed_entries": 10, "constrained_entries": 5,
        "noise_x_m": 0.2, "noise_y_m": 0.1, "noise_is_set": False, "weight_x_s6": 1.0, "weight_y_s6": 1.0,
        "median_moved_m": 0.1, "moved_over_half_m_share": 0.1, "moved_over_2_m_share": 0.0, "bounds_not_kept": 1,
    }  # fmt: skip
    return row(key, **{**usual, **changed})


def finding(key, vehicle, rule, severity="error", entries=2):
    frames = {"first_frame": 1, "last_frame": entries, "entries": entries}
    return row(key, vehicle_id=vehicle, rule=rule, severity=severity, worst=1.0, **frames)


def scores(key, entries, *unchecked):
    shares = ("share_without_error", "share_without_warning", "vehicles_without_error", "vehicles_without_warning")
    return row(key, entries=entries, rules_unchecked=list(unchecked), spacings=0, **dict.fromkeys(shares, 1.0))


@pytest.fixture
def lake(open_lake):
    """Two carriageways, and a street whose tracks were left out."""
    return open_lake(
        reconstruction_quality=[
            quality(UPPER),
            quality(
                LOWER, entries=10, imputed_entries=0, moved_over_half_m_share=0.5, noise_x_m=0.4, bounds_not_kept=0
            ),
            quality(STREET, vehicles_reconstructed=0, entries=0, imputed_entries=0, noise_x_m=None, noise_y_m=None),
        ],
        reconstruction_skips=[row(STREET, reason="arterial", vehicles=3, entries=30, left_out="everything")],
        unkept_bounds=[
            row(UPPER, vehicle_id=1, bound="jerk", first_frame=frame, last_frame=frame + 1, entries=2, worst=worst)
            for frame, worst in ((1, 16.0), (5, -40.0))
        ],
        subset_scores=[scores(UPPER, 90), scores(LOWER, 10, "overlap"), scores(STREET, 30)],
        reconstructed_subset_scores=[
            scores(UPPER, 100, "headway_mismatch"),
            scores(LOWER, 10, "overlap", "headway_mismatch"),
            scores(STREET, 30, "headway_mismatch"),
        ],
        findings=[
            finding(UPPER, 1, "overlap", entries=9),
            finding(UPPER, 2, "position_jump"),
            finding(UPPER, 2, "high_jerk", "warning"),
            finding(LOWER, 7, "position_jump", entries=1),
            finding(UPPER, 3, "headway_mismatch", "info"),
            finding(STREET, 1, "backward"),
        ],
        reconstructed_findings=[finding(UPPER, 1, "overlap", entries=5), finding(STREET, 1, "backward")],
    )


def test_figures_by_hand(lake):
    figures = collect_reconstruction(lake)
    (highd,) = figures["datasets"]
    assert [own["subset"] for own in figures["subsets"]] == ["01-lower", "01-upper"]
    assert {name: highd[name] for name in ("subsets", "vehicles", "entries", "imputed_entries", "bounds_not_kept")} == {
        "subsets": 2, "vehicles": 6, "entries": 100, "imputed_entries": 10, "bounds_not_kept": 1,
    }  # fmt: skip
    assert highd["imputed_share"] == pytest.approx(10 / 110)
    assert highd["moved_over_half_m_share"] == pytest.approx((90 * 0.1 + 10 * 0.5) / 100)
    assert highd["noise_x_m"] == pytest.approx(0.3)
    assert (highd["vehicles_with_errors_before"], highd["vehicles_with_errors_after"]) == (3, 1)
    assert figures["unkept_bounds"] == [
        row(UPPER, bound="jerk", runs=2, vehicles=1, entries=4, worst=-40.0),
    ]
    assert [skip["reason"] for skip in figures["skips"]] == ["arterial"]


def test_rules_are_compared_where_they_were_checked_on_both(lake):
    rules = {(own["rule"], own["dataset"], own["subset"]): own for own in collect_reconstruction(lake)["rules"]}
    overlap = rules["overlap", None, None]
    assert (overlap["entries_before"], overlap["entries_after"]) == (9, 5)
    assert (overlap["entry_share_before"], overlap["entry_share_after"]) == (0.1, 0.05)
    jump = rules["position_jump", "highd", None]
    assert (jump["vehicles_before"], jump["vehicles_after"]) == (2, 0)
    assert jump["entry_share_before"] == pytest.approx(3 / 100)
    assert ("overlap", *LOWER) not in rules
    assert "headway_mismatch" not in {rule for rule, *_ in rules}
    assert rules["backward", None, None]["entries_before"] == 0, "tracks that were left out are not compared"


def test_a_lake_without_reconstructed_tracks_has_no_such_figures(open_lake):
    assert collect_reconstruction(open_lake()) is None
    assert collect_reconstruction(open_lake(reconstruction_quality=[quality(STREET, vehicles_reconstructed=0)])) is None


def test_figures_without_validation_say_nothing_of_errors(open_lake):
    figures = collect_reconstruction(
        open_lake(reconstruction_quality=[quality(UPPER, imputed_entries=0, noise_y_m=5e-11)])
    )
    assert figures["rules"] == []
    assert describe_reconstruction(figures["datasets"][0]) == (
        "noise 0.20 m along the road, under 0.01 m across it (estimated); 10.0 % of the entries moved more than 0.5 m; "
        "1 bound could not be kept"
    )


def test_a_sentence_says_what_to_conclude(lake):
    assert describe_reconstruction(collect_reconstruction(lake)["datasets"][0]) == (
        "noise 0.30 m along the road, 0.10 m across it (estimated); 14.0 % of the entries moved more than 0.5 m; 9.1 % "
        "of the entries fill gaps; 1 bound could not be kept; 3 of 6 vehicles have an error as recorded, 1 as "
        "reconstructed"
    )


def test_samples_of_other_tracks_are_marked(open_lake, small_lake):
    lake = open_lake(**small_lake)
    marked = build_report(lake, {"settings": {"tracks_from": "reconstructed"}}).html
    assert "<strong>Of reconstructed tracks</strong>" in marked
    assert "<strong>Of recorded" not in build_report(lake, {"settings": {"tracks_from": "recorded"}}).html
