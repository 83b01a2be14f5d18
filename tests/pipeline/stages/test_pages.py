"""The report's stages in this process: which pages are written again, the overview's links, and the thresholds."""

import json
import re
import shutil
from pathlib import Path

import polars as pl
import pytest
from small_recordings import write_highd
from stage_runs import find_outstanding, plan_stage, run_stage

from tracklake.pipeline.ingest import ingest
from tracklake.pipeline.ingest.discovery import Digests, discover
from tracklake.pipeline.ingest.removal import remove_recordings
from tracklake.pipeline.lake import Commit, load, open_for_writing, write_table
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import build_jobs, group_jobs
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.schemas import SPLITS

pytestmark = pytest.mark.usefixtures("empty_charts")

LOW = {"high_acceleration_mps2": 1.0}


def find_jobs(root: Path, stage: str, **settings) -> list[str]:
    """Keys of what the stage would make."""
    return find_outstanding(root, stage, Settings(**settings))


def make(root: Path, stage: str, *keys: str, **settings) -> list[str]:
    """Make what is not made (only some of it), as the flows do; returns its keys."""
    return [commit.key for commit in run_stage(root, stage, Settings(**settings), *keys)]


def put_split(root: Path, part_of_02: str) -> None:
    """A split of both recordings: 01 trains."""
    parts = {"01": "train", "02": part_of_02}
    rows = [
        {"split": "s", "dataset": "highd", "subset": f"{number}-{way}", "block": 0, "first_frame": 1, "last_frame": 500}
        | {"part": parts[number]}
        for number in parts
        for way in ("lower", "upper")
    ]
    frame = pl.DataFrame([{name: row.get(name) for name in SPLITS.dtypes} for row in rows], schema=SPLITS.dtypes)
    with open_for_writing(root) as writer:
        files = {SPLITS.name: write_table(root, SPLITS, frame, {}, part_of_02, where="here")}
        writer.commit(Commit(key="split", fingerprint=part_of_02, files=files))


@pytest.fixture(scope="module")
def whole(empty_charts, tmp_path_factory) -> Path:
    """Two recordings, validated, with their pages and the overview."""
    del empty_charts
    raw, root = (tmp_path_factory.mktemp("pages") / name for name in ("raw", "lake"))
    for number in ("01", "02"):
        write_highd(raw, number)
    with open_for_writing(root) as writer:
        for job in ingest.plan(discover(raw, digest=Digests(root)), writer.manifest):
            writer.commit(ingest.build(root, job))
    put_split(root, "train")
    for stage in ("validate", "pages", "report"):
        make(root, stage)
    return root


@pytest.fixture
def lake(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "lake")


def pages(root: Path) -> dict[str, int]:
    """The files there are, and when each was written."""
    return {file.name: file.stat().st_mtime_ns for file in (root / "reports").glob("subsets/*")}


def links(root: Path) -> set[str]:
    """The pages that the overview leads to."""
    return set(re.findall(r'href="subsets/([^"]+)"', (root / "reports" / "index.html").read_text()))


def thresholds(root: Path) -> tuple[float, dict, dict]:
    """The thresholds of high acceleration in quality.json: the rule's, the overrides, those of other recordings."""
    quality = json.loads((root / "reports" / "quality.json").read_text())
    (rule,) = (rule for rule in quality["rules"] if rule["name"] == "high_acceleration")
    provenance = quality["provenance"]
    return rule["thresholds"][0]["value"], provenance["thresholds"], provenance["thresholds_elsewhere"]


NAMES = {f"{number}-{way}.html" for number in ("01", "02") for way in ("lower", "upper")}


def test_only_pages_whose_recording_changed_are_written_again(lake: Path):
    assert find_jobs(lake, "pages") == find_jobs(lake, "report") == []
    before = pages(lake)
    assert set(before) == links(lake) == NAMES
    # A model's run is news to the overview only.
    (lake / "models" / "mine").mkdir(parents=True)
    (lake / "models" / "mine" / "metrics.json").write_text("{}")
    assert (find_jobs(lake, "pages"), find_jobs(lake, "report")) == ([], ["report"])
    # So is another part of the split to the pages that are not of it.
    put_split(lake, "eval")
    assert make(lake, "pages") == ["pages/highd/02"]
    assert ">eval<" in (lake / "reports" / "subsets" / "02-upper.html").read_text()
    make(lake, "validate", "validate/highd/01", thresholds=LOW)
    assert make(lake, "pages") == ["pages/highd/01"]
    assert {name: written > before[name] for name, written in pages(lake).items()} == dict.fromkeys(NAMES, True)
    (lake / "reports" / "subsets" / "02-upper.html").write_text("spoilt")
    assert make(lake, "pages") == ["pages/highd/02"]


def test_pages_drawn_together_are_those_drawn_one_by_one(lake: Path):
    def read() -> dict[str, str]:
        created = re.compile(r"\d{4}-\d\d-\d\dT[\d:+]+")
        return {file.name: created.sub("", file.read_text()) for file in (lake / "reports" / "subsets").glob("*")}

    stage, jobs, manifest = STAGE_BY_NAME["pages"], plan_stage(lake, "pages", Settings()), load(lake)
    assert group_jobs(stage, manifest, jobs, workers=2) == [[job] for job in jobs], "work for both"
    assert group_jobs(stage, manifest, jobs, workers=1) == [jobs]
    commits = []
    for group in ([jobs[0]], [jobs[1]]):
        commits += build_jobs(stage, lake, group, Settings())
    alone = read()
    together = build_jobs(stage, lake, jobs, Settings())
    assert read() == alone
    assert [(commit.key, commit.files.keys(), commit.info["pages"]) for commit in together] == [
        (commit.key, commit.files.keys(), commit.info["pages"]) for commit in commits
    ]


def test_a_page_is_of_its_own_subset(lake: Path):
    for name in NAMES:
        page = (lake / "reports" / "subsets" / name).read_text()
        others = NAMES - {name}
        assert name.removesuffix(".html") in page
        assert not [other for other in others if other.removesuffix(".html") in page], name
        # 8 vehicles of 150 frames each.
        assert ">8<" in page
        assert "1,200" in page


def test_the_overview_leads_to_pages_that_are_there_and_others_vanish(lake: Path):
    remove_recordings(lake, ["02"])
    assert (find_jobs(lake, "pages"), find_jobs(lake, "report")) == ([], ["report"])
    (lake / "reports" / "subsets" / f".03-upper.html.{'a' * 32}.tmp").write_text("of a run that was killed")
    (lake / "reports" / "subsets" / "99-upper.html").write_text("of a subset that is not there")
    make(lake, "report")
    assert set(pages(lake)) == links(lake) == {"01-lower.html", "01-upper.html"}
    # One that could not be drawn is not led to; the report is made all the same.
    with open_for_writing(lake) as writer:
        writer.remove({"pages/highd/01"})
    make(lake, "report")
    assert set(pages(lake)) == links(lake) == set()
    assert "01-lower" in (lake / "reports" / "index.html").read_text()
    assert (find_jobs(lake, "pages"), find_jobs(lake, "report")) == (["pages/highd/01"], [])


def test_the_report_tells_the_thresholds_that_validation_used(lake: Path):
    assert thresholds(lake) == (3.05, {}, {})
    # Other settings without validation are not what was found with.
    assert find_jobs(lake, "report", thresholds=LOW) == []
    make(lake, "validate", "validate/highd/02", thresholds=LOW)
    make(lake, "report")
    assert thresholds(lake) == (3.05, {}, {"highd/02": LOW})
    assert "<strong>highd/02</strong>: high_acceleration_mps2 = 1</li>" in (lake / "reports" / "index.html").read_text()
    make(lake, "validate", thresholds=LOW)
    make(lake, "report")
    assert thresholds(lake) == (1.0, LOW, {})
    overview = (lake / "reports" / "index.html").read_text()
    assert "(default 3.05)" in overview
    assert "<strong>highd/02</strong>" not in overview


def test_before_validation_the_report_tells_those_of_the_settings(lake: Path):
    with open_for_writing(lake) as writer:
        writer.remove({"validate/highd/01", "validate/highd/02"})
    (job,) = plan_stage(lake, "report", Settings(thresholds=LOW))
    assert (job.built_from["thresholds"], job.built_from["thresholds_elsewhere"]) == (LOW, {})
