"""`tracklake report --compare OTHER_LAKE` as a user meets it."""

import json
import shutil
from pathlib import Path

import pytest
from small_recordings import KINDS

from tracklake.pipeline.lake import connect

THRESHOLD = {"TRACKLAKE_THRESHOLDS": '{"high_acceleration_mps2": 0.8}'}
FOUND = (
    "SELECT subset, count(*), count(DISTINCT vehicle_id), sum(entries) FROM findings "
    "WHERE rule = 'high_acceleration' GROUP BY subset"
)


def high_accelerations(root) -> dict[str, tuple]:
    with connect(root) as lake:
        found = {subset: counts for subset, *counts in lake.sql(FOUND).fetchall()}
        return {subset: found.get(subset, [0, 0, 0]) for (subset,) in lake.sql("SELECT subset FROM subsets").fetchall()}


@pytest.fixture(scope="module")
def pair(make_lake, sample, empty_charts, tmp_path_factory) -> Path:
    """A lake of two subsets of the sample, in which accelerations are found."""
    del empty_charts
    raw = tmp_path_factory.mktemp("pair")
    for kind in KINDS:
        shutil.copy(sample / f"01_{kind}.csv", raw)
    return make_lake(raw).root


@pytest.fixture
def copied(lake, tmp_path):
    return shutil.copytree(lake.root, tmp_path / "copy")


def test_a_copy_is_said_to_be_equal(command, lake, copied):
    done = command.here("report", "--lake", copied, "--compare", lake.root)
    assert (done.code, done.err) == (0, "")
    page = copied / "reports" / "compare.html"
    assert "nothing to do: the lake is up to date\n" in done.out
    assert "\nnothing differs: " in done.out
    assert done.out.endswith(f"comparison  {page}\n")
    assert "Nothing differs" in page.read_text()
    # Nor does it matter that the other has no report.
    shutil.rmtree(copied / "reports")
    done = command.here("report", "--lake", lake.root, "--compare", copied, "--json")
    compared = json.loads(done.out)["comparison"]
    (lake.root / "reports" / "compare.html").unlink()  # the lake is the session's
    assert (done.code, compared["equal"]) == (0, True)


@pytest.mark.thorough
@pytest.mark.usefixtures("plain_flows", "empty_charts")
def test_another_threshold_changes_its_findings_only(command, pair, tmp_path):
    copied = shutil.copytree(pair, tmp_path / "copy")
    assert command.here("validate", "--lake", copied, **THRESHOLD).code == 0
    done = command.here("report", "--lake", copied, "--compare", pair, "--json", **THRESHOLD)
    assert done.code == 0, done.err
    record = json.loads(done.out)
    compared = record["comparison"]
    assert compared["equal"] is False
    assert [(row["name"], row["then"], row["now"]) for row in compared["made_with"]] == [
        ("validate.thresholds.high_acceleration_mps2", 3.05, 0.8)
    ]
    then, now = high_accelerations(pair), high_accelerations(copied)
    expected = {
        subset: [(before, after, after - before) for before, after in zip(then[subset], now[subset], strict=True)]
        for subset in then
        if then[subset] != now[subset]
    }
    assert len(expected) > 1
    assert {row["rule"] for row in compared["rules"]["changed"]} == {"high_acceleration"}
    assert {
        row["subset"]: [tuple(row[name].values()) for name in ("findings", "vehicles", "entries")]
        for row in compared["rules"]["changed"]
    } == expected
    # What is made of the tracks and not of findings is the same; only scores count warnings.
    assert {row["figure"] for row in compared["subsets"]["changed"]} <= {
        "share_without_warning",
        "vehicles_without_warning",
    }
    assert compared["files"]["changed"] == compared["samples"]["changed"] == compared["evaluation"]["changed"] == []
    assert compared["evaluation"]["same"] == 5, "horizons"
    # People get the same on the terminal, and the page.
    done = command.here("report", "--lake", copied, "--compare", pair, **THRESHOLD)
    subset, counts = max(expected.items(), key=lambda item: item[1][1][2])  # more vehicles, so more of all
    (line,) = (line for line in done.out.splitlines() if line.split()[:2] == ["high_acceleration", subset])
    assert line.split()[2:] == [
        text for before, after, more in counts for text in (str(before), str(after), f"+{more}")
    ]
    assert f"+{counts[2][2]}</td>" in (copied / "reports" / "compare.html").read_text()


def test_what_is_no_lake_is_refused_before_any_work(command, pair, tmp_path):
    done = command.here("report", "--lake", pair, "--compare", tmp_path)
    assert done.code == 1
    assert done.err.startswith(f"error: {tmp_path}: no lake here (no manifest.json).")
    assert done.out == ""
    assert not (pair / "reports" / "compare.html").exists()
