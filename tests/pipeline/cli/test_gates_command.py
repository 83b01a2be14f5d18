"""`tracklake check --fail-on`: gates on a lake, their exit code, and what is written for programs."""

import json
import shutil
from xml.etree import ElementTree

import pytest
from small_recordings import write_highd

from tracklake.pipeline.lake import connect, load
from tracklake.quality_reports.gates.metrics import METRIC_BY_NAME, METRICS, SCOPES, collect_metrics


@pytest.fixture(scope="module")
def rows(lake):
    """Values of all metrics of the shared lake."""
    with connect(lake.root) as connection:
        return collect_metrics(connection, [metric.name for metric in METRICS])


def test_metrics_are_those_of_the_tables(lake, rows):
    """Shares of a recording, a dataset and the lake are sums over entries, added up one by one."""
    with connect(lake.root) as connection:
        facts = connection.sql(
            "SELECT dataset, recording, subset, subsets.entries, vehicles, share_without_error AS sound, excluded "
            "FROM subsets JOIN subset_scores USING (dataset, subset)"
        ).fetchall()
        read = connection.sql("SELECT dataset, recording, rows_read, rows_dropped FROM ingest_log").fetchall()
        overlaps = connection.sql("SELECT dataset, subset, entries FROM findings WHERE rule = 'overlap'").fetchall()
        drawn = connection.sql("SELECT dataset, subset FROM samples").fetchall()
    assert len(facts) >= 4
    by_key = {(row["scope"], row["dataset"], row["recording"], row["subset"]): row for row in rows}
    assert len(by_key) == len(rows)
    of_carriageways = {key: row for key, row in by_key.items() if key[0] != "drive"}  # drives: test_drives.py
    for (scope, *key), row in of_carriageways.items():
        own = [fact for fact in facts if all(part in (None, mine) for part, mine in zip(key, fact[:3], strict=True))]
        assert row["entries"] == sum(fact[3] for fact in own)
        assert row["vehicles"] == sum(fact[4] for fact in own)
        wrong = sum(fact[3] * (1 - fact[5]) for fact in own)
        assert row["error_share"] == pytest.approx(wrong / row["entries"], abs=1e-9)
        assert row["excluded_subsets"] == sum(fact[6] for fact in own)
        subsets = {(fact[0], fact[2]) for fact in own}
        assert (row["samples"] or 0) == sum((dataset, subset) in subsets for dataset, subset in drawn)
        if scope != "subset":
            files = [file for file in read if all(part in (None, mine) for part, mine in zip(key, file, strict=False))]
            counted = row["rows_read"], row["rows_dropped"]
            assert counted == (sum(file[2] for file in files), sum(file[3] for file in files))
        if scope != "recording":
            assert row["overlap.entries"] == sum(entries for *place, entries in overlaps if tuple(place) in subsets)


def test_every_metric_has_values_in_its_scopes(rows):
    for metric in METRICS:
        found = {row["scope"] for row in rows if row.get(metric.name) is not None}
        of_drives = metric.name.startswith("drive")  # of a drive: test_drives.py
        assert found & {*metric.scopes} or of_drives or metric.name.endswith(".worst"), metric.name
        assert [scope for scope in SCOPES if scope in metric.scopes] == list(metric.scopes), "from the smallest on"


def test_gates_have_an_exit_code_of_their_own(command, lake, tmp_path):
    junit = tmp_path / "out" / "junit.xml"
    junit.parent.mkdir()
    done = command.here(
        *("check", "--lake", lake.root, "--json", "--junit", junit),
        *(
            "--fail-on",
            "error_share > 100%",
            "--fail-on",
            "entries > 0 and dataset == highd",
            "--fail-on",
            "entries < 0",
        ),
    )
    assert done.code == 4
    assert "2 gates did not pass" not in done.err
    assert "1 of 3 gates did not pass" in done.err
    said = json.loads(done.out)
    assert (said["damaged"], said["outdated"]) == ([], [])
    assert [gate["state"] for gate in said["gates"]] == ["passed", "failed", "passed"]
    failed = said["gates"][1]["judged"]
    assert failed
    assert all(each["name"].startswith("highd/") and each["state"] == "failed" for each in failed)
    suite = ElementTree.parse(junit).getroot()[0]
    cases = [(case.get("classname"), len(case)) for case in suite]
    assert cases[0] == ("files", 0)
    assert cases.count(("entries > 0 and dataset == highd", 1)) == len(failed)
    assert (int(suite.get("tests")), int(suite.get("failures")), suite.get("errors")) == (len(cases), len(failed), "0")


def test_gates_that_pass_and_checks_without_gates_end_with_0(command, lake):
    done = command.here("check", "--lake", lake.root, "--no-checksums", "--fail-on", "error_share > 100%")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("passed: error_share > 100% (")
    assert command.here("check", "--lake", lake.root, "--no-checksums").code == 2
    assert command.here("check", "--lake", lake.root, "--fail-on", "eror_share > 1").code == 2
    listed = command.here("check", "--list-metrics")
    assert listed.code == 0
    assert [metric.name for metric in METRICS if "." not in metric.name and metric.name not in listed.out] == []


@pytest.mark.usefixtures("plain_flows")
def test_what_has_not_run_and_what_is_outdated_is_said(command, lake, tmp_path):
    write_highd(tmp_path / "raw", "01")
    root = tmp_path / "lake"
    assert command.here("ingest", tmp_path / "raw", "--lake", root, "--quiet").code == 0
    unknown = command.here("check", "--lake", root, "--fail-on", "error_share > 0.05", "--junit", tmp_path / "j.xml")
    assert unknown.code == 4
    assert "unknown: error_share > 0.05" in unknown.err
    assert "error_share is not known: it needs `tracklake validate`" in unknown.err
    assert "note: validate is not up to date" in unknown.err
    assert ElementTree.parse(tmp_path / "j.xml").getroot()[0].get("errors") == "2"
    strict = {"TRACKLAKE_THRESHOLDS": '{"high_acceleration_mps2": 0.5}'}
    outdated = command.here("check", "--lake", lake.root, "--no-checksums", "--fail-on", "error_share > 1", **strict)
    assert outdated.code == 0
    assert "note: validate is not up to date: gates are judged on what it made last" in outdated.err
    # A second recording, of which nothing is checked: what the lake has together is not known.
    for stage in ("validate", "repair", "samples"):
        assert command.here(stage, "--lake", root, "--quiet").code == 0
    write_highd(tmp_path / "raw", "02")
    assert command.here("ingest", tmp_path / "raw", "--lake", root, "--quiet").code == 0
    with connect(root) as connection:
        found = collect_metrics(connection, [metric.name for metric in METRICS])
    needed = [each for each in METRICS if "lake" in each.scopes and "validate" in each.needs]
    needed += [METRIC_BY_NAME[name] for name in ("late_share", "samples", "kept_share")]
    whole = next(row for row in found if row["scope"] == "lake")
    assert len(needed) > 20
    assert [each.name for each in needed if whole.get(each.name) is not None] == []
    verdicts = {row["scope"]: row.get("verdict") for row in found if row["recording"] != "01"}
    assert verdicts == {"lake": None, "dataset": None, "recording": None, "subset": None}
    target = root / load(root).live("findings")[0].path
    target.write_bytes(target.read_bytes() + b"x")
    damaged = command.here("check", "--lake", root, "--fail-on", "error_share > 0.05")
    assert damaged.code == 1
    assert "note: gates are not judged where files are damaged" in damaged.err
    assert "are judged on what" not in damaged.err
    (root / "manifest.json").unlink()
    shutil.rmtree(root / ".files")
    assert command.here("check", "--lake", root, "--fail-on", "error_share > 0.05").code == 1
