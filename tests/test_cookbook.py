"""The cookbook's queries answer something on the generated sample, and its page says what the macros say."""

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from known_drive import make_drive, put_drive

from tracklake.pipeline.lake import connect, query
from tracklake.pipeline.lake.macros import MACROS

PAGE = (Path(__file__).parents[1] / "docs" / "cookbook.md").read_text()
QUESTIONS = re.findall(r"^### ([^\n]+\?)\n\n```sql\n(.*?)```\n\n(.+?)\n\n", PAGE, flags=re.DOTALL | re.MULTILINE)
ANSWERS = {question: sql for question, sql, _ in QUESTIONS}
COMMANDS = [
    line
    for block in re.findall(r"```sh\n(.*?)```", PAGE, flags=re.DOTALL)
    for line in block.splitlines()
    if line.startswith("tracklake ")
]


@pytest.fixture(scope="module")
def asked(lake):
    with connect(lake.root) as connection:
        yield connection


def test_every_question_is_tried():
    assert len(QUESTIONS) >= 20
    assert len(QUESTIONS) == PAGE.count("\n### ") == PAGE.count("```sql\n") == len(ANSWERS)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A lake with the drive of helpers/known_drive.py, which the sample's lake has none of."""
    root = tmp_path_factory.mktemp("drive")
    put_drive(root, make_drive())
    with connect(root) as connection:
        yield connection


@pytest.mark.parametrize("question", ANSWERS)
def test_a_question_gets_an_answer(asked, drive, question):
    found = query(drive if "'drive-1'" in ANSWERS[question] else asked, ANSWERS[question]).pl()
    assert found.height > 0
    assert all(found[name].null_count() < found.height for name in found.columns), "a column without any value"
    # Names of figures say their unit, or count things.
    assert not [name for name in found.columns if name.startswith(("sum(", "count", "avg(", "max(", "min("))]


def test_every_command_runs(command, lake, tmp_path):
    shutil.copytree(lake.root, tmp_path / "lake")
    here = replace(command, folder=tmp_path).here
    for line in COMMANDS:
        done = here(*shlex.split(line, comments=True)[1:])
        assert done.code == 0, done.err
    assert pl.read_parquet(tmp_path / "02-lower.parquet")["subset"].unique().to_list() == ["02-lower"]
    assert pl.read_csv(tmp_path / "critical.csv")["ttc_s"].max() < 2


def test_the_python_of_the_page_runs(lake, tmp_path, monkeypatch):
    (tmp_path / "lake").symlink_to(lake.root, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec("\n".join(re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)), names)
    assert names["headways"].height > 1_000


def test_the_page_and_the_listing_name_every_macro_and_table(command):
    from tracklake.schemas import TABLES

    listed = command.here("sql", "--list").out
    for macro in MACROS:
        assert f"| `{macro.signature}` | {macro.meaning} |" in PAGE
        assert re.search(rf"{re.escape(macro.signature)} +{re.escape(macro.meaning)}", listed)
    assert all(re.search(rf"^  {table.name} +\w", listed, flags=re.MULTILINE) for table in TABLES)


CALLS = {
    "detector_counts": "'02-lower', 100, 5", "edie_cells": "'02-lower', 100, 5",
    "flow_density": "'02-lower', 5", "lane_changes": "'02-lower'", "leader_follower": "'02-lower'",
    "near": "'02-lower', 200, 100, 5, 50", "scene": "'02-lower', 200", "track": "'02-lower', 21",
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_a_macro_reads_one_partition_of_the_lakes_many(asked, name):
    """Every table is read from one file only, as the plan of DuckDB says."""
    plan = asked.sql(f"EXPLAIN (ANALYZE, FORMAT json) FROM {name}({CALLS[name]})").fetchall()[0][1]
    scans = plan.count('"Function": "READ_PARQUET"')
    assert scans >= 1
    assert re.findall(r'"Scanning Files": "(\d+)/\d+"', plan) == ["1"] * scans


# ------------------------------------------------------------------- some answers, by a loop over the sample's lake


def rows_of(lake, sql: str) -> list[dict]:
    with connect(lake.root) as connection:
        return connection.sql(sql).pl().to_dicts()


def test_the_detector_counts_what_a_loop_counts(lake, asked):
    entries = rows_of(lake, "SELECT vehicle_id, frame, x_m, lane, time_s FROM tracks WHERE subset = '02-lower'")
    last: dict[int, dict] = {}
    expected: dict[tuple, int] = {}
    for row in sorted(entries, key=lambda row: (row["vehicle_id"], row["frame"])):
        before = last.get(row["vehicle_id"])
        if before is not None and before["x_m"] < 200 <= row["x_m"]:
            key = (row["lane"], row["time_s"] // 10 * 10)
            expected[key] = expected.get(key, 0) + 1
        last[row["vehicle_id"]] = row
    found = asked.sql(ANSWERS["How many vehicles pass a point?"]).fetchall()
    assert {(lane, start): count for lane, start, count in found} == expected
    assert sum(expected.values()) > 10


def test_platoons_are_who_follows_closely(lake, asked):
    here = rows_of(lake, "SELECT * FROM tracks WHERE subset = '02-lower' AND frame = 200")
    expected = []
    for lane in sorted({row["lane"] for row in here}):
        platoon: list[int] = []
        for row in sorted((row for row in here if row["lane"] == lane), key=lambda row: -row["x_m"]):
            if row["gap_m"] is None or row["gap_m"] > 2 * row["speed_mps"]:
                expected.append(platoon)
                platoon = []
            platoon.append(row["vehicle_id"])
        expected.append(platoon)
    found = asked.sql(ANSWERS["Who drives in platoons?"]).fetchall()
    assert [members for *_, members in found] == [platoon for platoon in expected if len(platoon) > 1]


def test_parts_of_the_split_hold_all_samples_once(asked):
    found = asked.sql(ANSWERS["How do the parts of a split compare?"]).pl()
    # The sample's carriageways are shorter than a block, so that time-blocks, too, lose none.
    held = dict(found.group_by("split").agg(pl.col("samples").sum()).iter_rows())
    ((samples,),) = asked.sql("SELECT count(*) FROM samples").fetchall()
    assert held == dict.fromkeys(("flow-balanced", "time-blocks", "csp-2018", "by-recording-random"), samples)
    assert found.group_by("split", "dataset").agg(pl.col("share").sum()).get_column("share").round(9).eq(1).all()


def test_the_carriageways_flow_is_that_of_all_entries(asked):
    """The same definitions, over all lanes at once."""
    found = asked.sql(ANSWERS["What are flow, density and speed of the whole carriageway?"]).pl()
    entries = asked.sql("SELECT frame, x_m, speed_mps FROM tracks WHERE subset = '02-lower'").pl()
    section = entries["x_m"].max() - entries["x_m"].min()
    first = entries.filter(pl.col("frame") <= 125)  # 25 Hz, frames from 1: 5 s
    metres, seconds = float(first["speed_mps"].cast(pl.Float64).sum()) / 25, first.height / 25
    row = found.row(0, named=True)
    assert row["flow_veh_per_h"] == pytest.approx(3600 * metres / (section * 5), rel=1e-9)
    assert row["density_veh_per_km"] == pytest.approx(1000 * seconds / (section * 5), rel=1e-9)
    assert row["speed_mps"] == pytest.approx(metres / seconds, rel=1e-9)


def test_the_flow_of_a_subset_is_the_mean_of_its_main_lanes(asked):
    """The flow over the whole recording is that of the macro; a short one counts many more vehicles per second."""
    found = asked.sql(
        "SELECT s.subset, any_value(flow_vphpl) AS flow, sum(f.flow_veh_per_h) / any_value(s.lanes) AS mean_of_lanes, "
        "any_value(3600 * vehicles_per_lane_s) AS seen FROM subsets AS s, flow_density(s.subset, 1000000) AS f "
        "WHERE f.lane BETWEEN 1 AND s.lanes GROUP BY ALL"
    ).pl()
    assert found.height >= 5
    for row in found.iter_rows(named=True):
        assert row["flow"] == pytest.approx(row["mean_of_lanes"], rel=1e-9), row["subset"]
        assert row["seen"] > 1.5 * row["flow"], row["subset"]
