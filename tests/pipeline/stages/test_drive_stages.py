"""The stages of drives that the report needs: a page per drive, and the overview that leads to it."""

import pytest
from known_drive import make_drive, put_drive

from tracklake.pipeline.lake import load, open_for_writing
from tracklake.pipeline.settings import Settings
from tracklake.pipeline.stages.planner import Planner, build_job
from tracklake.pipeline.stages.readers import LakeReader
from tracklake.pipeline.stages.registry import STAGE_BY_NAME
from tracklake.pipeline.stages.report import read_quality
from tracklake.schemas import DRIVE_FINDINGS


@pytest.fixture
def root(tmp_path):
    put_drive(tmp_path, make_drive())
    return tmp_path


def run(root, *names: str) -> list[str]:
    """Run what is outstanding of some stages, and return the keys of the jobs."""
    done = []
    for name in names:
        with open_for_writing(root) as writer:
            jobs, _ = Planner(root, load(root), Settings()).find_outstanding(name)
            for job in jobs:
                writer.commit(build_job(STAGE_BY_NAME[name], root, job, Settings()))
                done.append(job.key)
    return done


def test_a_page_is_drawn_again_only_where_the_drive_changed(root):
    assert run(root, "drive_pages") == ["drive_pages/v2v/drive-1"]
    page = root / "reports" / "drives" / "drive-1.html"
    assert "2 stations, 110 messages" in page.read_text()
    assert run(root, "drive_pages") == []
    put_drive(root, make_drive("Drive-1"))
    assert run(root, "drive_pages") == ["drive_pages/v2v/Drive-1", "drive_pages/v2v/drive-1"]
    assert len(list(page.parent.iterdir())) == 3, "names differ where letters' case is ignored"


def test_the_overview_of_a_lake_with_drives_alone_leads_to_their_pages(root):
    (root / "reports" / "drives").mkdir(parents=True)
    (root / "reports" / "drives" / "gone.html").write_text("of a drive that was removed")
    assert run(root, "drive_pages", "report") == ["drive_pages/v2v/drive-1", "report"]
    assert 'href="drives/drive-1.html"' in (root / "reports" / "index.html").read_text()
    assert [file.name for file in (root / "reports" / "drives").iterdir()] == ["drive-1.html"]
    (facts,) = read_quality(root)["drives"]["drives"]
    assert (facts["drive"], facts["stations"]) == ("drive-1", 2)
    assert run(root, "drive_pages", "report") == []


@pytest.mark.parametrize(("thresholds", "expected"), [({}, 0.1), ({"message_latency_s": 0.3, "overlap_m": 9.0}, 0.3)])
def test_a_drives_findings_follow_from_its_own_thresholds(root, thresholds, expected):
    """Thresholds of rules over tracks are no concern of it, and do not make it stale."""
    stage, settings = STAGE_BY_NAME["drive_findings"], Settings(thresholds=thresholds)
    assert stage.describe_settings(settings)["thresholds"]["message_latency_s"] == expected
    reader = LakeReader(root, load(root)).open_subset("v2v", "drive-1")
    found = dict(stage.build(reader, settings).tables[DRIVE_FINDINGS].select("rule", "entries").iter_rows())
    assert found == {"message_loss": 3} | ({"message_latency": 1} if expected == 0.1 else {})
    assert "message_latency_s" not in STAGE_BY_NAME["validate"].describe_settings(settings)["thresholds"]
