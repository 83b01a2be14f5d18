"""Reports on many subsets: sums by site and day, the worst subsets, and pages on demand."""

from typing import Any

import pytest

from tracklake.pipeline.lake import Manifest, connect, load
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner
from tracklake.quality_reports import groups
from tracklake.quality_reports.pages.report import build_report
from tracklake.quality_reports.verdicts import rank_verdicts
from tracklake.schemas.quality_tracks import SubsetGroup


@pytest.fixture
def few(monkeypatch) -> None:
    """Three subsets are many, of which two are listed."""
    monkeypatch.setattr(groups, "MANY_SUBSETS", 3)
    monkeypatch.setattr(groups, "SHOWN_SUBSETS", 2)


@pytest.mark.parametrize(
    ("recording", "day"),
    [
        ("i-24-20221130-0600", "2022-11-30"),
        ("2022-11-30_2", "2022-11-30"),
        ("us-101-0750", None),
        ("01", None),
        ("120221130", None),
    ],
)
def test_the_day_is_that_in_the_name_of_a_recording(recording, day):
    assert groups.find_day(recording) == day


def find_names(value: Any) -> set[str]:
    """The subsets that any row names."""
    if isinstance(value, dict):
        own = {value["subset"]} if isinstance(value.get("subset"), str) else set()
        return own.union(*(find_names(each) for each in value.values()))
    return set().union(*(find_names(each) for each in value)) if isinstance(value, list) else set()


@pytest.mark.usefixtures("few")
def test_many_subsets_are_summed_by_site_and_day_and_the_worst_are_listed(lake, monkeypatch):
    with connect(lake.root) as connection:
        short = build_report(connection, {})
        monkeypatch.setattr(groups, "MANY_SUBSETS", 1000)
        whole = build_report(connection, {})
    names = {row["subset"] for row in whole.quality["subsets"]}
    assert len(names) > 3
    worst = [row["subset"] for row in rank_verdicts(whole.quality["verdicts"])[:2]]
    assert find_names(short.quality) == set(worst) < names
    assert len(short.json) < len(whole.json) / 2
    # Totals stay, and the sums by site and day are the same.
    assert short.quality["headline"] == whole.quality["headline"]
    assert [rule["total"] for rule in short.quality["rules"]] == [rule["total"] for rule in whole.quality["rules"]]
    assert all(row.keys() == SubsetGroup.__annotations__.keys() for row in short.quality["groups"])
    sums, head = short.quality["groups"], whole.quality["headline"]
    for name in ("subsets", "recordings", "vehicles", "entries", "late_starts", "samples"):
        assert sum(row[name] for row in sums) == (head[name] or 0), name
    levels = ("usable", "usable_with_care", "not_usable", "not_checked")
    assert sum(row[level] for row in sums for level in levels) == head["subsets"]
    rows = {(row["dataset"], row["site"]): row for row in sums}
    for (dataset, site), row in rows.items():
        own = [s for s in whole.quality["subsets"] if (s["dataset"], s["site"]) == (dataset, site)]
        mean = sum(s["mean_speed_mps"] * s["entries"] for s in own) / sum(s["entries"] for s in own)
        assert row["mean_speed_mps"] == pytest.approx(mean)
    assert "groups" not in whole.quality
    assert "All subsets by site and day" not in whole.html
    assert "All subsets by site and day" in short.html
    assert "tracklake report --subset NAME" in short.html
    missing = names - {*worst}
    assert not any(f">{name}<" in short.html for name in missing)


@pytest.mark.usefixtures("few")
def test_pages_of_many_subsets_are_drawn_on_demand_and_kept(lake):
    manifest = load(lake.root)
    commits = {key: commit for key, commit in manifest.commits.items() if commit.stage != "pages"}
    undrawn = Manifest(manifest.lake_id, 1, commits)
    first = manifest.of_stage("ingest")[0]

    def plan(planned: Manifest, **settings: Any) -> list[str]:
        return [job.tail for job in Planner(lake.root, planned, Settings(lake=lake.root, **settings)).plan("pages")]

    assert plan(undrawn) == []
    assert plan(undrawn, pages_of=[first.info["subsets"][0]["subset"]]) == [first.tail]
    assert plan(manifest) == [commit.tail for commit in manifest.of_stage("pages")]


def test_the_command_refuses_a_subset_that_is_not_there(command, lake):
    done = command.here("report", "--lake", lake.root, "--subset", "01-uper")
    assert done.code == 2
    assert "--subset 01-uper: no subset of" in done.err
    assert "did you mean" in done.err
