"""`tracklake sql` as a newcomer meets it: how much is shown, how many rows there are, what to do when it is wrong."""

import json
import os
import pty
import re
import subprocess
import sys

import duckdb
import polars as pl
import pytest

from tracklake.pipeline.cli import sql


@pytest.fixture
def screen(monkeypatch):
    """Standard output as a terminal of 200 columns."""
    monkeypatch.setattr(sql, "is_screen", lambda: True)


@pytest.mark.usefixtures("screen")
def test_a_terminal_shows_the_first_rows_and_says_how_many_there_are(command, lake):
    total = lake.said["headline"]["entries"]
    # Two columns of one name, and an order, must not matter to the count.
    for query in ("SELECT frame FROM tracks", "SELECT frame, frame, x_m FROM tracks ORDER BY x_m, frame"):
        shown = command.here("sql", query, "--lake", lake.root)
        assert len(shown.out.splitlines()) == 1 + 40
        assert shown.err == f"the first 40 of {total:,} rows; a pipe or --out FILE.csv gives all\n"


def test_a_pipe_gets_all_rows_and_whole_values(command, lake):
    columns = "frame, speed_mps, '\x1b' || repeat('x', 130) || frame % 7 AS s"
    query = f"SELECT {columns} FROM tracks ORDER BY subset, vehicle_id, frame"
    expected = [
        row.split(",") for row in command.here("sql", query, "--lake", lake.root, "--format", "csv").out.split()
    ]
    shown = command.here("sql", query, "--lake", lake.root)
    assert shown.err == f"{lake.said['headline']['entries']:,} rows\n"
    lines = shown.out.splitlines()
    assert lines[0].split() == ["frame", "speed_mps", "s"]
    assert lines[-1].split()[0] == expected[-1][0]
    assert len(lines) == len(expected)
    assert {line.split()[2] for line in lines[1:]} == {f"\\x1b{'x' * 130}{n}" for n in range(7)}
    speeds = [[float(row[1]) for row in rows[1:]] for rows in ([line.split() for line in lines], expected)]
    assert pl.Series(speeds[0], dtype=pl.Float32).equals(pl.Series(speeds[1], dtype=pl.Float32))
    few = command.here("sql", query + " LIMIT 3", "--lake", lake.root).out.splitlines()
    assert [line.split() for line in few] == [line.split() for line in lines[:4]]


@pytest.mark.usefixtures("screen")
def test_columns_for_which_a_terminal_is_too_narrow_are_left_out_in_the_middle(command, lake):
    shown = command.here("sql", "FROM tracks", "--lake", lake.root, COLUMNS="60")
    head, *rows = shown.out.splitlines()
    assert head.split()[:2] == ["dataset", "subset"]
    assert head.split()[-1] == "headway_recorded_m"
    assert head.split().count("…") == 1
    assert max(map(len, (head, *rows))) <= 60
    assert f"; {len(head.split()) - 1} of 20 columns; a wider terminal, a pipe or --out shows all" in shown.err
    plan = command.here("sql", "EXPLAIN FROM tracks", "--lake", lake.root, COLUMNS="30")
    assert "physical_plan" in plan.out


@pytest.mark.parametrize(
    ("widths", "limit", "shown"),
    [
        ([3, 4, 5], 16, [0, 1, 2]),  # 3 + 2 + 4 + 2 + 5
        ([3, 4, 5], 15, [0, 2]),  # 3 + 2 + 1 + 2 + 5 = 13
        ([3, 4, 5], 12, [0]),
        ([90, 1, 1], 5, [0]),
        ([1, 1, 1, 1, 1], 10, [0, 1, 4]),  # 1 2 1 2 1 2 1 = 10
    ],
)
def test_columns_are_chosen_from_both_ends(widths, limit, shown):
    assert sql.choose_columns(widths, limit) == shown


@pytest.mark.parametrize(("rows", "says"), [(0, "0 rows\n"), (1, "1 row\n"), (40, "40 rows\n")])
def test_a_short_result_says_how_many_rows_it_has(command, lake, rows, says):
    shown = command.here("sql", f"SELECT frame FROM tracks LIMIT {rows}", "--lake", lake.root)
    assert (shown.code, len(shown.out.splitlines()), shown.err) == (0, 1 + rows, says)


@pytest.mark.usefixtures("screen")
def test_long_values_are_cut_on_a_terminal_only(command, lake):
    query = "SELECT repeat('x', 119) || 'yz' AS cut, repeat('x', 59) AS whole, 5 AS n"
    (_, row) = command.here("sql", query, "--lake", lake.root).out.splitlines()
    assert row.split() == ["x" * 119 + "…", "x" * 59, "5"]
    (_, row) = command.here("sql", query, "--lake", lake.root, "--format", "csv").out.splitlines()
    assert row == "x" * 119 + "yz," + "x" * 59 + ",5"


def test_the_ending_of_a_file_chooses_its_format(command, lake, tmp_path):
    readers = {
        "csv": pl.read_csv, "json": pl.read_json, "jsonl": pl.read_ndjson, "ndjson": pl.read_ndjson,
        "parquet": pl.read_parquet, "arrow": pl.read_ipc, "Feather": pl.read_ipc,
    }  # fmt: skip
    for ending, read in readers.items():
        target = tmp_path / f"out.{ending}"
        done = command.here("sql", "SELECT 1 AS x, 'é' AS y", "--lake", lake.root, "--out", target)
        assert (done.code, done.err) == (0, f"1 row in {target}\n")
        assert read(target).rows() == [(1, "é")]
    wrong = command.here("sql", "SELECT 1", "--lake", lake.root, "--out", tmp_path / "out.txt")
    assert wrong.code == 2
    assert "expected a name that ends in .csv, " in wrong.err
    assert not (tmp_path / "out.txt").exists()


def test_json_is_for_programs_also_when_it_fails(command, lake):
    assert json.loads(command.here("sql", "SELECT 1 AS x", "--lake", lake.root, "--json").out) == [{"x": 1}]
    assert "syntax error" in json.loads(command.here("sql", "SELEC", "--lake", lake.root, "--json").out)["error"]
    assert command.here("sql", "SELECT 1", "--lake", lake.root, "--json", "--format", "csv").code == 2


def test_a_catalog_of_ones_own_for_a_lake_that_cannot_be_written_to(command, lake, tmp_path):
    assert command.here("sql", "--lake", lake.root, "--out", tmp_path / "my.duckdb").code == 0
    with duckdb.connect(str(tmp_path / "my.duckdb"), read_only=True) as plain:
        assert plain.sql("SELECT count(*) FROM tracks").fetchone() == (lake.said["headline"]["entries"],)


def test_a_query_needs_neither_pandera_nor_numpy(command, lake):
    """They would take a third of the time of a short query."""
    script = (
        "import sys; from tracklake.pipeline.cli.app import app\n"
        f"try: app(['sql', 'SELECT 1', '--lake', {str(lake.root)!r}])\n"
        "except SystemExit: print(*{'pandera', 'numpy', 'pyarrow', 'prefect', 'filelock'} & sys.modules.keys())"
    )
    done = subprocess.run([sys.executable, "-c", script], env=command.environment, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "", done.stderr


def test_a_file_is_confirmed_with_its_rows(command, lake, tmp_path):
    target = tmp_path / "scene.parquet"
    done = command.here(
        "sql", "FROM scene('02-lower', 200)", "--lake", lake.root, "--format", "parquet", "--out", target
    )
    frame = pl.read_parquet(target)
    assert frame["frame"].unique().to_list() == [200]
    assert (done.out, done.err) == ("", f"{frame.height} rows in {target}\n")


def test_without_a_question_there_is_advice(command):
    done = command.here("sql")
    assert done.code == 2
    assert "--list" in done.err


def test_the_listing_needs_no_lake(command, tmp_path):
    done = command.here("sql", "--list", "--lake", tmp_path / "nowhere")
    assert done.code == 0
    assert "tracks " in done.out
    assert "track(subset, vehicle)" in done.out


def test_the_listing_of_a_name_says_what_its_columns_are(command):
    listed = command.here("sql", "--list", "vehicles").out
    assert re.search(r"^length_m +FLOAT +m +along the direction of travel$", listed, flags=re.MULTILINE)
    assert re.search(r"^starts_late +BOOLEAN +eligible and first seen", listed, flags=re.MULTILINE)
    assert "\ndistance_m: from the point to the vehicle's front centre\n" in command.here("sql", "near", "--list").out
    said = json.loads(command.here("sql", "--list", "vehicles", "--json").out)
    assert {"column": "length_m", "type": "FLOAT", "unit": "m", "meaning": "along the direction of travel"} in said[
        "columns"
    ]
    assert json.loads(command.here("sql", "near", "--list", "--json").out)["macro"].startswith("near(subset, ")
    assert {"tables", "macros"} == json.loads(command.here("sql", "--list", "--json").out).keys()
    wrong = command.here("sql", "--list", "trakcs")
    assert wrong.code == 2
    assert "no table or macro 'trakcs' (`tracklake sql --list` shows all); did you mean tracks?" in wrong.err


def test_a_wrong_name_gets_duckdbs_guess_and_what_there_is(command, lake):
    done = command.here("sql", "FROM tracc('02-lower', 1)", "--lake", lake.root)
    assert (done.code, done.out) == (1, "")
    assert 'Did you mean "track' in done.err
    assert "\nTables: tracks, vehicles, " in done.err
    assert " flow_density(subset, seconds), " in done.err


def test_parquet_is_not_poured_on_a_terminal(command, lake):
    master, terminal = pty.openpty()
    try:
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "tracklake.pipeline.cli.app",
                "sql",
                "SELECT 1 AS one",
                "--lake",
                lake.root,
                "--format",
                "parquet",
            ],
            env=command.environment,
            cwd=command.folder,
            stdout=terminal,
            stderr=subprocess.PIPE,
            text=True,
            timeout=300,
            check=False,
        )
    finally:
        os.close(terminal)
        os.close(master)
    assert done.returncode == 1
    assert "--out FILE" in done.stderr
