"""`tracklake sql` as a newcomer meets it: how much is shown, how many rows there are, what to do when it is wrong."""

import os
import pty
import re
import subprocess
import sys

import polars as pl
import pytest


def test_a_long_result_is_cut_and_says_how_long_it_is(command, lake):
    total = lake.said["headline"]["entries"]
    # Two columns of one name, and an order, must not matter to the count.
    for query in ("FROM tracks", "SELECT frame, frame, x_m FROM tracks ORDER BY x_m, frame"):
        shown = command.here("sql", query, "--lake", lake.root)
        assert len(shown.out.splitlines()) == 1 + 40
        assert shown.err == f"the first 40 of {total:,} rows; --format csv, json or parquet gives all\n"


@pytest.mark.parametrize(("rows", "says"), [(0, "0 rows\n"), (1, "1 row\n"), (40, "40 rows\n")])
def test_a_short_result_says_how_many_rows_it_has(command, lake, rows, says):
    shown = command.here("sql", f"SELECT frame FROM tracks LIMIT {rows}", "--lake", lake.root)
    assert (shown.code, len(shown.out.splitlines()), shown.err) == (0, 1 + rows, says)


def test_long_values_are_cut_for_people_only(command, lake):
    query = "SELECT repeat('x', 119) || 'yz' AS cut, repeat('x', 119) || 'y' AS whole, 5 AS n"
    (_, row) = command.here("sql", query, "--lake", lake.root).out.splitlines()
    assert row.split() == ["x" * 119 + "…", "x" * 119 + "y", "5"]
    (_, row) = command.here("sql", query, "--lake", lake.root, "--format", "csv").out.splitlines()
    assert row == "x" * 119 + "yz," + "x" * 119 + "y,5"


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
    wrong = command.here("sql", "--list", "trakcs")
    assert wrong.code == 2
    assert "no table or macro 'trakcs'; did you mean tracks?" in wrong.err


def test_a_wrong_name_gets_duckdbs_guess_and_what_there_is(command, lake):
    done = command.here("sql", "FROM tracc('02-lower', 1)", "--lake", lake.root)
    assert (done.code, done.out) == (1, "")
    assert 'Did you mean "track' in done.err
    assert "\nTables: tracks, vehicles, " in done.err
    assert "\nMacros: flow_density(subset, seconds), " in done.err


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
